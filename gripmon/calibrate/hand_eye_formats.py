"""Hand/eye transforms in other programs' files, recognised by their content: easy_handeye 1 and 2, MoveIt's launch
files, commands of ``static_transform_publisher``, URDF, and gripmon's own JSON.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from xml.etree import ElementTree

import numpy as np

from gripmon.calibrate.foreign import Document, FileValues, InterchangeError
from gripmon.calibrate.static_transforms import (
    FIXED,
    QUATERNION,
    FramePair,
    from_angles,
    published_transforms,
)
from gripmon.model.geometry import invert, make_transform
from gripmon.model.records import Array

_READ = "a hand/eye transform of easy_handeye, MoveIt, static_transform_publisher or URDF"
FARTHEST_M = 5.0
"""Distance of a gripper from its wrist camera beyond which another unit was meant."""
TCP_FRAME = "gripper_tcp"
"""The frame that is called so is at the TCP in what :mod:`gripmon.calibrate.hand_eye_files` has written; a robot's own
of that name may be anywhere, and where the TCP is in another frame, a file of these formats doesn't say.
"""
_WRITTEN_HERE = re.compile(r"\bwritten \S+ by gripmon \S+:")
BODY_AXES = "the axes of a ROS body such as camera_link (x forward, y left, z up) instead of a camera's (z forward)"
_CAMERA = re.compile(r"cam(?:era)?(?:\d|_|$|/)|optical|rgb|colou?r|depth|infra|realsense|zed|oak|d4\d\d|eye", re.I)
_BASE = re.compile(
    r"(?!.*(?:grip|hand|tool|flange|tcp|finger|jaw|robotiq|wsg|schunk|onrobot|rg[26]|[23]f[_\d]))(?:.*[_/])?"
    r"(?:world|map|odom|root|base(?:_link|_footprint)?(?:_inertia)?|link_?0|table|stand|pedestal|torso(?:_lift)?(?:_link)?)$",
    re.I,
)
"""Frames that don't move with a gripper, unless they are called after one."""


@dataclass(frozen=True, slots=True)
class ForeignHandEye:
    """The camera's pose in the gripper's frame, ``grip_T_cam`` (4, 4), as a file of the format ``kind`` has it, and the
    covariance (6·6) of ``cam_T_grip`` if it has that.  ``at_tcp``: whether the file itself says that the gripper's
    frame is at the TCP; ``doubt``: why the camera's may have other axes than a camera's.
    """

    kind: str
    gripper_frame: str
    camera_frame: str
    grip_T_cam: Array
    covariance: tuple[float, ...] | None = None
    at_tcp: bool = False
    doubt: str = ""


def read_hand_eye(document: Document, *, which: str | None = None) -> ForeignHandEye | None:
    """The hand/eye transform in a file; None if the file is of none of these formats.  ``which`` names the camera's
    frame, of several transforms or where neither name looks like a camera's.

    :class:`InterchangeError` for a fixed camera, for a frame with the axes of ROS bodies in place of a camera's, and
    for millimetres.
    """
    file, found = document.file, list(_transforms(document))
    if not found:
        return None
    pair = _joined(file, _chosen(file, found, which), found)
    hand_eye = _turned(file, pair, which)
    if pair.camera is None and _BASE.match(hand_eye.gripper_frame):
        _refuse_fixed(file, hand_eye, which, len(_likely(found)) == 1)
    camera = hand_eye.camera_frame
    apart_m = float(np.linalg.norm(hand_eye.grip_T_cam[:3, 3]))
    if apart_m > FARTHEST_M:
        wrong = f"puts {camera} {apart_m:g} m from {hand_eye.gripper_frame}"
        raise InterchangeError(file, "", wrong, f"metres ({meant(apart_m)})")
    body = _body(invert(hand_eye.grip_T_cam), camera)
    if body:
        wrong = f"ends in {camera}, whose x points along the gripper: {BODY_AXES}"
        right = f"the pose of its optical frame: ros2 run tf2_ros tf2_echo {hand_eye.gripper_frame} OPTICAL_FRAME"
        raise InterchangeError(file, "", wrong, right)
    if body is None:
        doubt = f"{camera} may have {BODY_AXES}; if so, the pose of its optical frame"
        hand_eye = replace(hand_eye, doubt=doubt)
    named = hand_eye.gripper_frame == TCP_FRAME and _WRITTEN_HERE.search(document.text) is not None
    return replace(hand_eye, at_tcp=named if pair.at_tcp is None else pair.at_tcp)


def _likely(found: Sequence[FramePair]) -> list[FramePair]:
    """Those that end in a camera's last frame by their names; all ends where no name is a camera's."""
    above = {one.parent for one in found if _CAMERA.search(one.child) or not _CAMERA.search(one.parent)}
    ends = [one for one in found if one.child not in above]
    return (
        [one for one in ends if _CAMERA.search(one.child)]
        or [one for one in found if _CAMERA.search(one.parent)]  # the gripper in the camera's frame
        or ends
        or list(found)
    )


def _chosen(file: str, found: Sequence[FramePair], which: str | None) -> FramePair:
    """The transform that ends in the camera's frame: the one with that name, or the only likely one."""
    chosen = likely = _likely(found)
    if which is not None:
        chosen = [one for one in found if which == one.child] or [one for one in found if which == one.parent]
    if len(chosen) != 1:
        right = f"gripmon calibrate import with --camera {' or '.join(one.child for one in likely)}"
        wrong = f"holds {len(found)} transforms" if chosen else f"holds no frame {which}"
        raise InterchangeError(file, "", wrong, right)
    return chosen[0]


def _joined(file: str, pair: FramePair, found: Sequence[FramePair]) -> FramePair:
    """The transform from the first frame above that isn't the camera's own: what lies between is its mount."""
    chain = [pair]
    while pair.camera is None and _CAMERA.search(chain[0].parent):
        above = [one for one in found if one.child == chain[0].parent and one not in chain]
        if len(above) > 1:
            wrong = f"holds {len(above)} transforms that lead to {chain[0].parent}"
            raise InterchangeError(file, "", wrong, "one parent for each frame")
        if not above:
            break
        chain = [*above, *chain]
    if len(chain) == 1:
        return pair
    return replace(pair, parent=chain[0].parent, parent_T_child=lambda: _product(one.parent_T_child() for one in chain))


def _product(transforms: Iterable[Array]) -> Array:
    return reduce(np.matmul, transforms)


def _turned(file: str, pair: FramePair, which: str | None) -> ForeignHandEye:
    """From the gripper to the camera, whichever of both is the parent."""
    own = [bool(_CAMERA.search(name)) for name in pair.frames]
    if pair.camera is None and all(own):
        wrong = f"leads from {pair.parent} to {pair.child}, both of them a camera's by their names"
        right = "also how the camera is mounted: transforms from the gripper's frame on"
        raise InterchangeError(file, "", wrong, right)
    known = pair.camera or (pair.frames[own.index(True)] if any(own) else which)
    if which not in (None, known):
        raise InterchangeError(file, which or "", "isn't the camera's frame", f"{known}, as the file says")
    cameras = [name == known for name in pair.frames]
    if cameras[0] == cameras[1]:
        right = f"gripmon calibrate import with --camera {pair.child}, or {pair.parent} if that is the camera's"
        raise InterchangeError(file, "", f"leads from {pair.parent} to {pair.child}: which is the camera's?", right)
    gripper, camera = pair.frames[:: -1 if cameras[0] else 1]
    parent_T_child = pair.parent_T_child()
    grip_T_cam = invert(parent_T_child) if cameras[0] else parent_T_child
    return ForeignHandEye(pair.kind, gripper, camera, grip_T_cam, pair.covariance)


def _refuse_fixed(file: str, hand_eye: ForeignHandEye, which: str | None, alone: bool) -> None:
    """Unless ``which`` repeats what the file says: where it had to choose, it says nothing about the other frame."""
    gripper, camera = hand_eye.gripper_frame, hand_eye.camera_frame
    if not (alone and _CAMERA.search(camera)):
        way_out = "a file with this transform alone, to a frame that is called camera"
    elif which is None:
        way_out = f"gripmon calibrate import with --camera {camera}"
    else:
        return
    wrong = f"leads from {gripper} to {camera}"
    raise InterchangeError(file, "", wrong, f"{FIXED}; if {gripper} moves with the camera: {way_out}")


def _body(cam_T_grip: Array, name: str) -> bool | None:
    """Whether the frame's axes are x forward; None where its name says so, but they don't.  A gripper's z points
    along that x, and its origin lies there; of a frame that is called a body's (``camera_link``) one of both is enough,
    since an effector's own z may not point out of it.
    """
    out, at = cam_T_grip[:3, 2], cam_T_grip[:3, 3]
    turned, lies = lies_along_x(out), lies_along_x(at)
    called = "optical" not in name.lower() and re.search(r"_(?:link|frame)$", name.lower()) is not None
    if (turned and (lies or "optical" not in name.lower())) or (lies and called):
        return True
    return None if called else False


def meant(distance_m: float) -> str:
    """The question about a distance beyond :data:`FARTHEST_M`."""
    return f"{distance_m:g} mm were meant?" if distance_m < 1000.0 * FARTHEST_M else "another unit was meant?"


def lies_along_x(cam_t_tcp: Array) -> bool:
    """Whether a place (3,) lies before a ROS body rather than before a camera, along x instead of z."""
    x, y, z = cam_t_tcp.tolist()
    return bool(x > max(abs(y), abs(z)))


def _transforms(document: Document) -> Iterator[FramePair]:
    if "static_transform_publisher" in document.text and (published := list(published_transforms(document))):
        yield from published
        return
    if document.text.lstrip().startswith("<"):
        yield from _joints(document)
        return
    try:
        values = document.values(_READ)
    except InterchangeError:  # no YAML: whoever reads cameras says so
        return
    content = values.content
    if "transformation" in content or ("transform" in content and "parameters" in content):
        yield _easy_handeye(values)
    elif {"parent_frame", "child_frame", "parent_T_child", "cam_T_grip"} <= content.keys():
        yield _own_json(values)


def _easy_handeye(values: FileValues) -> FramePair:
    """Version 1 has ``transformation`` (x … qw), ``eye_on_hand``; version 2 ``transform``, ``calibration_type``."""
    first = "transformation" in values.content
    told = values.below("parameters") if "parameters" in values.content else values
    on_hand = told.flag("eye_on_hand", True) if first else told.content.get("calibration_type") == "eye_in_hand"
    frames = [str(told.content.get(f"{name}_frame", name)) for name in ("robot_effector", "tracking_base")]
    if not on_hand:
        raise values.fault("", f"leads from the robot's base to {frames[1]}", FIXED)
    if first:
        shift = turn = values.below("transformation")
        keys = QUATERNION
    else:
        shift, turn = (values.below("transform").below(part) for part in ("translation", "rotation"))
        keys = ("x", "y", "z", "w")
    pose = turn.pose([shift.number(axis) for axis in "xyz"], [turn.number(key) for key in keys])
    return FramePair("easy_handeye" if first else "easy_handeye2", frames[0], frames[1], lambda: pose, frames[1])


def _own_json(values: FileValues) -> FramePair:
    part = values.below("cam_T_grip")
    shift = part.numbers("translation_m", (3,), "x, y, z")
    pose = part.pose(shift, part.numbers("rotation_xyzw", (4,), "x, y, z, w"))
    parent, child = (str(values.value(f"{name}_frame")) for name in ("parent", "child"))
    matrix = values.below("parent_T_child").numbers("matrix", (16,), "4 x 4 numbers")
    # With --gripper-in-camera, the camera's frame is the parent.
    camera, gripper = (parent, child) if np.allclose(np.reshape(matrix, (4, 4)), pose, atol=1e-9) else (child, parent)
    covariance = values.numbers("covariance", (36,), "6 x 6 numbers")
    at_tcp = values.content.get("at_tcp", True)
    if not isinstance(at_tcp, bool):
        raise values.fault("at_tcp", f"is {at_tcp!r}", "true or false")
    return FramePair("json", camera, gripper, lambda: pose, camera, covariance, at_tcp)


def _joints(document: Document) -> Iterator[FramePair]:
    """Fixed joints of a URDF."""
    try:
        root = ElementTree.fromstring(document.text)
    except (ElementTree.ParseError, ValueError):
        return
    for joint in root.iter("joint"):
        parent, child = (joint.find(name) for name in ("parent", "child"))
        if joint.get("type") == "fixed" and parent is not None and child is not None:
            pose = partial(_joint, document.file, joint)
            yield FramePair("urdf", parent.get("link", ""), child.get("link", ""), pose)


def _joint(file: str, joint: ElementTree.Element) -> Array:
    """A joint's transform (4, 4); xacro may insert an origin that isn't in the text."""
    origin = joint.find("origin")
    at = {key: (origin.get(key, "") if origin is not None else "").split() or ["0"] * 3 for key in ("xyz", "rpy")}
    values = FileValues(file, at, "<origin xyz rpy>", f"joint {joint.get('name')}: ")
    if any("}" in part.tag for part in joint):
        raise values.fault("", "holds parts of xacro", "the URDF that xacro makes of it")
    shift, turn = (values.numbers(key, (3,), "3 numbers") for key in ("xyz", "rpy"))
    return make_transform(from_angles(*turn), np.array(shift))
