"""What a person may set about ROS 2, and the names and frames that follow from it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from gripmon.io.ros2.names import MOST_DOMAIN_ID, NodeName, RosNameError, as_token
from gripmon.io.wire import DEFAULT_ENDPOINT, PublishSettings
from gripmon.io.wire.settings import Endpoint

Frame = Annotated[str, Meta(pattern=r"^[^/\s]\S*$", description="a frame of tf: no blank, no / in front")]


class Ros2Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A node on ``rmw_zenoh``, without ROS and without a bridge."""

    enabled: Annotated[bool, Meta(description="true: also publish for ROS 2 nodes on rmw_zenoh")] = False
    domain_id: Annotated[
        int, Meta(ge=0, le=MOST_DOMAIN_ID, description="ROS_DOMAIN_ID of those nodes; the variable itself isn't read")
    ] = 0
    router: (
        Annotated[
            Endpoint,
            Meta(
                description="the router of ROS 2 (rmw_zenohd), joined as client while publish.mode, listen, connect "
                "and zenoh_config are at their defaults; null: publish holds as it is"
            ),
        ]
        | None
    ) = DEFAULT_ENDPOINT
    node: Annotated[str, Meta(description="name of the node: letters, digits and _")] = "gripmon"
    namespace: (
        Annotated[str, Meta(description="namespace of the node, e.g. / or /arm1; null: /<robot>/<camera_name>")] | None
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
        Annotated[
            Frame,
            Meta(description="the new frame in tf, which nobody else may publish; null: <robot>_<camera_name>_gripmon"),
        ]
        | None
    ) = None
    transform: Annotated[
        Literal["raw", "smoothed"], Meta(description="raw: of each frame by itself; smoothed: averaged over time")
    ] = "raw"
    verdicts: Annotated[
        tuple[Literal["valid", "suspect"], ...],
        Meta(
            min_length=1,
            description="which transforms are published on tf_topic and pose_topic; unknown ones never are, since tf "
            "can't say that it isn't sure",
        ),
    ] = ("valid",)
    tf_topic: Annotated[str, Meta(description="topic of the tf2_msgs/TFMessage")] = "/tf"
    pose_topic: (
        Annotated[
            str,
            Meta(
                description="topic of the geometry_msgs/PoseWithCovarianceStamped; ~/ is below the node; null: "
                "~/cam_T_grip, or ~/grip_T_cam with gripper_from_camera"
            ),
        ]
        | None
    ) = None


class Ros2Fault(ValueError):
    """A setting that can't be: ``key`` below ``ros2``, what is ``wrong``, what would be ``right``."""

    def __init__(self, key: str, wrong: str, right: str) -> None:
        super().__init__(f"ros2.{key}: {wrong}; {right}")
        self.key, self.wrong, self.right = key, wrong, right


@dataclass(frozen=True, slots=True)
class Layout:
    """Names and frames, all of them given."""

    domain_id: int
    node: NodeName
    parent_frame: str
    child_frame: str
    tf_topic: str
    pose_topic: str
    diagnostics_topic: str = "/diagnostics"


def layout_of(settings: Ros2Settings, robot: str, camera: str) -> Layout:
    """What the settings come to for this camera.  Raises :class:`Ros2Fault`."""
    inverse = settings.publish == "gripper_from_camera"
    namespace = f"/{as_token(robot)}/{as_token(camera)}" if settings.namespace is None else settings.namespace
    if settings.parent_frame is None and inverse:
        raise Ros2Fault(
            "parent_frame",
            "is not given, and publish is gripper_from_camera",
            "the gripper's frame in tf, origin at the TCP, x across the jaws, z out of the gripper",
        )
    parent = settings.parent_frame or f"{camera}_optical_frame"
    child = settings.child_frame or f"{robot}_{camera}_gripmon"
    if parent == child:
        raise Ros2Fault("child_frame", f"is {child}, the parent's name, too", "a frame of its own")
    key = "node"
    try:
        node = NodeName(settings.node)
        key = "namespace"
        node = NodeName(settings.node, namespace)
        key = "tf_topic"
        tf_topic = node.expand(settings.tf_topic)
        key = "pose_topic"
        pose_topic = node.expand(settings.pose_topic or ("~/grip_T_cam" if inverse else "~/cam_T_grip"))
    except RosNameError as error:
        wrong, _, right = str(error).partition("; give ")
        raise Ros2Fault(key, wrong, right) from None
    return Layout(settings.domain_id, node, parent, child, tf_topic, pose_topic)


def network_of(publish: PublishSettings, ros2: Ros2Settings) -> PublishSettings:
    """How to join the network: as client of the ROS 2 router, unless ``publish`` says something else."""
    defaults = PublishSettings()
    said = any(getattr(publish, key) != getattr(defaults, key) for key in ("mode", "listen", "connect", "zenoh_config"))
    if not ros2.enabled or ros2.router is None or said:
        return publish
    return msgspec.structs.replace(publish, mode="client", connect=(ros2.router,))


def fault_of(settings: Ros2Settings, publish: PublishSettings, robot: str, camera: str) -> Ros2Fault | None:
    """What is wrong with the section ``ros2`` of a configuration; None if nothing is, or it is off."""
    if not settings.enabled:
        return None
    if not publish.enabled:
        return Ros2Fault("enabled", "is true, but publish.enabled is false", "publish.enabled: true")
    try:
        layout_of(settings, robot, camera)
    except Ros2Fault as fault:
        return fault
    return None
