"""Hand/eye transforms for other programs, by format name.

A robot's tree runs from arm to camera, whereas ``cam_T_grip`` gives the gripper in the camera frame.  So the camera's
pose in the gripper's frame is written (origin at the TCP, x across the jaws, z out of the gripper), or with
``gripper_in_camera`` the gripper's pose in the camera frame.  :mod:`gripmon.calibrate.hand_eye_formats` reads them.
"""

from __future__ import annotations

import json
import math
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from gripmon.calibrate.hand_eye_formats import TCP_FRAME
from gripmon.model.geometry import from_record, invert, to_record
from gripmon.model.records import Array, Transform
from gripmon.model.yaml_text import as_yaml

HAND_EYE_FORMATS = ("ros-static", "urdf", "easy_handeye2", "json")
_FRAME = re.compile(r"[^/\s\"'<>&][^\s\"'<>&]*")


@dataclass(frozen=True, slots=True)
class HandEye:
    """The data to export: ``cam_T_grip`` with its 6 x 6 covariance (as published), and the frames' names.

    ``at_tcp``: whether the gripper's frame is at the TCP; ``name`` is the calibration's; the marker's frame and the
    robot's base appear in an easy_handeye2 file only for completeness.
    """

    cam_T_grip: Transform
    covariance: tuple[float, ...]
    gripper_frame: str = TCP_FRAME
    camera_frame: str = "camera_optical_frame"
    gripper_in_camera: bool = False
    at_tcp: bool = True
    name: str = "gripmon"
    robot_base_frame: str = "base_link"
    tracking_marker_frame: str = "calibration_plate"

    def __post_init__(self) -> None:
        for key in ("gripper_frame", "camera_frame", "robot_base_frame", "tracking_marker_frame", "name"):
            value = getattr(self, key)
            if not _FRAME.fullmatch(value):
                raise ValueError(
                    f"{key}: {value!r} isn't a frame's name; without blanks, quotes, angle brackets, and no / in front"
                )
        if self.gripper_frame == TCP_FRAME and not self.at_tcp:
            raise ValueError(f"gripper_frame: {TCP_FRAME} isn't at the TCP, as it is in gripmon's files; another name")
        if self.gripper_frame == self.camera_frame:
            raise ValueError(f"both frames are called {self.camera_frame}; two names")

    @property
    def frames(self) -> tuple[str, str]:
        """Parent and child."""
        pair = self.gripper_frame, self.camera_frame
        return pair[::-1] if self.gripper_in_camera else pair

    @property
    def parent_T_child(self) -> Array:
        """(4, 4), from the child's coordinates to the parent's."""
        cam_T_grip = from_record(self.cam_T_grip)
        return cam_T_grip if self.gripper_in_camera else invert(cam_T_grip)


def write_hand_eye(hand_eye: HandEye, kind: str, notes: Sequence[str]) -> str:
    """The text in one of :data:`HAND_EYE_FORMATS`, with ``notes`` as comments.  ValueError if it can't be expressed."""
    notes = [" ".join(note.split()) for note in notes]
    writer = {"ros-static": _ros_static, "urdf": _urdf, "easy_handeye2": _easy_handeye2, "json": _json}[kind]
    return writer(hand_eye, notes)


def _ros_static(hand_eye: HandEye, notes: Sequence[str]) -> str:
    """A shell script with one command, which publishes the transform while it runs."""
    (x, y, z), quaternion = _parts(hand_eye)
    parent, child = hand_eye.frames
    words = ["ros2", "run", "tf2_ros", "static_transform_publisher"]
    values = dict(zip(("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw"), (x, y, z, *quaternion), strict=True))
    for option, value in values.items():
        words += [option, repr(value)]
    words += ["--frame-id", parent, "--child-frame-id", child]
    return "".join(f"# {note}\n" for note in notes) + shlex.join(words) + "\n"


def _urdf(hand_eye: HandEye, notes: Sequence[str]) -> str:
    """A fixed joint between two links of the robot's description."""
    parent, child = hand_eye.frames
    xyz = " ".join(map(repr, hand_eye.parent_T_child[:3, 3].tolist()))
    rpy = " ".join(map(repr, roll_pitch_yaw(hand_eye.parent_T_child[:3, :3])))
    comments = "".join(f"<!-- {_xml_comment(note)} -->\n" for note in notes)
    return (
        f'{comments}<joint name="{parent}_to_{child}" type="fixed">\n'
        f'  <parent link="{parent}"/>\n  <child link="{child}"/>\n'
        f'  <origin xyz="{xyz}" rpy="{rpy}"/>\n</joint>\n'
    )


def _easy_handeye2(hand_eye: HandEye, notes: Sequence[str]) -> str:
    """A ``.calib`` file of the eye-in-hand type: the camera's pose in the effector's frame, here at the TCP."""
    if hand_eye.gripper_in_camera:
        raise ValueError("an easy_handeye2 file has the camera in the effector's frame; without --gripper-in-camera")
    translation, rotation = _parts(hand_eye)
    content = {
        "parameters": {
            "name": hand_eye.name,
            "calibration_type": "eye_in_hand",
            "robot_base_frame": hand_eye.robot_base_frame,
            "robot_effector_frame": hand_eye.gripper_frame,
            "tracking_base_frame": hand_eye.camera_frame,
            "tracking_marker_frame": hand_eye.tracking_marker_frame,
            "freehand_robot_movement": True,
            "move_group_namespace": "/",
            "move_group": "manipulator",
        },
        "transform": {
            "translation": dict(zip("xyz", translation, strict=True)),
            "rotation": dict(zip("xyzw", rotation, strict=True)),
        },
    }
    return "".join(f"# {note}\n" for note in notes) + as_yaml(content)


def _json(hand_eye: HandEye, notes: Sequence[str]) -> str:
    """Both directions, with covariance: of the TCP's position error, then the rotation error, camera axes (m, rad)."""
    parent, child = hand_eye.frames
    content: dict[str, Any] = {
        "parent_frame": parent,
        "child_frame": child,
        "parent_T_child": {
            **msgspec.to_builtins(to_record(hand_eye.parent_T_child)),
            "matrix": hand_eye.parent_T_child.tolist(),
        },
        "cam_T_grip": msgspec.to_builtins(hand_eye.cam_T_grip),
        "covariance": list(hand_eye.covariance),
        "at_tcp": hand_eye.at_tcp,
        "notes": list(notes),
    }
    return json.dumps(content, indent=2, ensure_ascii=False) + "\n"


def _parts(hand_eye: HandEye) -> tuple[list[float], list[float]]:
    record = to_record(hand_eye.parent_T_child)
    return list(record.translation_m), list(record.rotation_xyzw)


def _xml_comment(text: str) -> str:
    """Avoid double hyphens, which would end the comment."""
    return text.replace("--", "- -").replace("--", "- -")


def roll_pitch_yaw(rotation: Array) -> tuple[float, float, float]:
    """Rotation matrix (3, 3) -> angles (rad) about fixed x, y, z, as in URDF: ``R = Rz(yaw) Ry(pitch) Rx(roll)``.

    If the pitch is ±90 degrees, only roll minus (or plus) yaw is defined; the angles still give the same matrix,
    because yaw is computed after roll and pitch.
    """
    r = np.asarray(rotation, dtype=np.float64)
    pitch = math.atan2(-r[2, 0], math.hypot(r[2, 1], r[2, 2]))
    roll = math.atan2(r[2, 1], r[2, 2]) if math.hypot(r[2, 1], r[2, 2]) > 1e-9 else 0.0
    sine, cosine = math.sin(roll), math.cos(roll)
    yaw = math.atan2(sine * r[0, 2] - cosine * r[0, 1], cosine * r[1, 1] - sine * r[1, 2])
    return roll, pitch, yaw
