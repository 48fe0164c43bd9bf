"""The section ``ros2`` of a configuration: the monitor's node, its frames and topics."""

from __future__ import annotations

import re
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

_TOKEN = "[A-Za-z_][A-Za-z0-9_]*"
_TOKENS = f"{_TOKEN}(/{_TOKEN})*"
Topic = Annotated[str, Meta(pattern=f"^/{_TOKENS}$", description="full name of a topic: /wrist/image_raw")]
OurTopic = Annotated[str, Meta(pattern=f"^(~?/)?{_TOKENS}$", description="name of a topic; ~/x is below the node")]
Domain = Annotated[int, Meta(ge=0, le=232, description="ROS_DOMAIN_ID (no unit); null: the environment's, else 0")]
Frame = Annotated[str, Meta(pattern=r"^[^/\s]\S*$", description="a frame of tf: no blank, no / in front")]


class Ros2Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The monitor as a node of ROS 2."""

    enabled: Annotated[bool, Meta(description="true: also a ROS 2 node, by rclpy")] = False
    domain_id: Domain | None = None
    node: Annotated[str, Meta(pattern=f"^{_TOKEN}$", description="name of the node: letters, digits and _")] = "gripmon"
    namespace: (
        Annotated[str, Meta(pattern=f"^/({_TOKENS})?$", description="/, or /arm1; null: /<robot>/<camera_name>")] | None
    ) = None
    publish: Annotated[
        Literal["camera_from_gripper", "gripper_from_camera"],
        Meta(
            description="camera_from_gripper: cam_T_grip, the gripper as child of the camera; gripper_from_camera: its "
            "inverse, the camera as child of the gripper"
        ),
    ] = "camera_from_gripper"
    parent_frame: (
        Annotated[
            Frame,
            Meta(
                description="frame in tf that the transform hangs below: the camera's optical frame, null: "
                "<camera_name>_optical_frame; with gripper_from_camera the gripper's (origin at the TCP, x across the "
                "jaws, z out), to be given"
            ),
        ]
        | None
    ) = None
    child_frame: (
        Annotated[Frame, Meta(description="a new frame, nobody else's; null: <robot>_<camera_name>_gripmon")] | None
    ) = None
    transform: Annotated[
        Literal["raw", "smoothed"], Meta(description="raw: of each frame by itself; smoothed: averaged over time")
    ] = "raw"
    verdicts: Annotated[
        tuple[Literal["valid", "suspect"], ...],
        Meta(min_length=1, description="verdicts whose transforms are published; unknown never is: tf has no verdict"),
    ] = ("valid",)
    tf_topic: OurTopic = "/tf"
    pose_topic: (
        Annotated[OurTopic, Meta(description="of the pose with covariance; null: ~/cam_T_grip, or ~/grip_T_cam")] | None
    ) = None

    def named(self, robot: str, camera: str) -> Ros2Settings:
        """The same with every name given."""
        return msgspec.structs.replace(
            self,
            namespace=self.namespace or f"/{as_token(robot)}/{as_token(camera)}",
            parent_frame=self.parent_frame or f"{camera}_optical_frame",
            child_frame=self.child_frame or f"{robot}_{camera}_gripmon",
            pose_topic=self.pose_topic or ("~/cam_T_grip" if self.publish == "camera_from_gripper" else "~/grip_T_cam"),
        )

    def fault(self, robot: str, camera: str) -> tuple[str, str, str] | None:
        """Key, what is wrong and what would be right; None if nothing is wrong, or it is off."""
        if self.enabled and self.publish == "gripper_from_camera" and self.parent_frame is None:
            right = "the gripper's frame in tf, origin at the TCP, x across the jaws, z out of the gripper"
            return "ros2.parent_frame", "is not given, and publish is gripper_from_camera", right
        child = (whole := self.named(robot, camera)).child_frame
        if self.enabled and whole.parent_frame == child:
            return "ros2.child_frame", f"is {child}, the parent's name, too", "a frame of its own"
        return None


def as_token(text: str) -> str:
    """A gripmon name as one token of a ROS name: characters that aren't allowed become ``_``."""
    token = re.sub(r"[^A-Za-z0-9_]", "_", text)
    return token if re.match(r"[A-Za-z_]", token) else f"_{token}"
