"""Cameras from and for other programs, and hand/eye transforms for them, by format name; a lens that a format doesn't
support becomes the nearest one.

A robot's tree runs from arm to camera, whereas ``cam_T_grip`` gives the gripper in the camera frame.  So the camera's
pose in the gripper's frame is written (origin at the TCP, x across the jaws, z out of the gripper), or with
``gripper_in_camera`` the gripper's pose in the camera frame.
"""

from __future__ import annotations

import json
import math
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from scipy.optimize import least_squares

from gripmon.calibrate.formats import (
    InterchangeError,
    number_text,
    read_kalibr,
    read_mrcal,
    read_ros,
    write_kalibr,
    write_mrcal,
    write_ros,
)
from gripmon.calibrate.opencv_files import SYNTAXES, read_opencv, write_opencv
from gripmon.model.camera import BrownConradyLens, Camera, LensSettings, make_camera
from gripmon.model.geometry import from_record, invert, to_record
from gripmon.model.lenses import BrownMap
from gripmon.model.records import Array, Transform

FORMATS = ("ros", "kalibr", "opencv", "mrcal")
LARGEST_FIT_PX = 1.0
"""Largest error of a fit that still counts as a calibration (px)."""
_BROWN_COUNTS = {"ros": (4, 5, 8, 12), "kalibr": (4,), "opencv": (4, 5, 8, 12), "mrcal": (4, 5, 8, 12)}
_FITTED_COUNTS = {"ros": (5, 8), "kalibr": (4,), "opencv": (5, 8), "mrcal": (5, 8)}
_FISHEYE = ("ros", "kalibr", "opencv")


@dataclass(frozen=True, slots=True)
class Exported:
    """A file's bytes, and warnings about them."""

    data: bytes
    warnings: tuple[str, ...] = ()


def format_of(data: bytes, file: str) -> str:
    """The format of a file, by its content; only the file name's suffix identifies OpenCV's JSON."""
    head = data[:65536].lstrip(b"\xef\xbb\xbf \t\r\n")
    text = head.decode(errors="replace")
    if b"LENSMODEL_" in data:
        return "mrcal"
    if text.startswith(("%YAML:", "<?xml", "<opencv_storage")) or "opencv-matrix" in text:
        return "opencv"
    if "distortion_coeffs" in text and "camera_model" in text:
        return "kalibr"
    if "image_width" in text and "camera_matrix" in text:
        return "opencv" if Path(file).suffix == ".json" else "ros"
    raise InterchangeError(file, "", "is in no format that is recognised", f"--format {' or '.join(FORMATS)}")


def read_camera(
    data: bytes,
    file: str,
    kind: str,
    which: str | None = None,
    size_px: tuple[int, int] | None = None,
    fisheye: bool | None = None,
) -> LensSettings:
    """The camera in a file's bytes.  Options for what a file may leave open: ``which`` of several cameras, the image's
    size, and whether the lens is a fisheye.  :class:`InterchangeError` for a missing camera, for one that no monitor
    can use, and for options that this format doesn't need.
    """
    given = {"--camera": which, "--size": size_px, "--fisheye": fisheye}
    useful = {"kalibr": {"--camera"}, "opencv": {"--size", "--fisheye"}}.get(kind, set())
    for option, value in given.items():
        if value is not None and option not in useful:
            raise InterchangeError(file, "", f"{option} has no meaning for a {kind} file", "leave it out")
    if kind == "kalibr":
        return read_kalibr(data, file, which)
    if kind == "opencv":
        return read_opencv(data, file, size_px, fisheye)
    return read_mrcal(data, file) if kind == "mrcal" else read_ros(data, file)


def write_camera(
    camera: LensSettings, kind: str, notes: Sequence[str], *, name: str, file: str, suffix: str = "", fit: bool = False
) -> Exported:
    """A file's bytes.  ``notes`` become comments, ``name`` is the camera's; ``file`` is where it comes from, for
    messages; ``suffix`` of the output file selects OpenCV's syntax: YAML unless it is .xml or .json.

    A lens that the format doesn't support raises :class:`InterchangeError`, or with ``fit`` is written as the nearest
    one that it supports, with a warning about the largest error in the image.
    """
    warnings: list[str] = []
    if not _supports(kind, camera):
        camera, warning = _nearest(camera, kind, file, fit)
        warnings.append(warning)
    if kind == "ros" and len(getattr(camera, "coefficients", ())) == 12:
        warnings.append("rational_polynomial with 12 coefficients: OpenCV takes them, ROS's own text speaks of 8")
    notes = [" ".join(note.split()) for note in (*notes, *warnings)]
    if kind == "opencv":
        data = write_opencv(camera, notes, name, suffix.lower() if suffix.lower() in SYNTAXES else ".yaml")
    else:
        data = {"ros": write_ros, "kalibr": write_kalibr, "mrcal": write_mrcal}[kind](camera, notes, name)
    return Exported(data, tuple(warnings))


def _supports(kind: str, camera: LensSettings) -> bool:
    tag = camera.__struct_config__.tag
    if tag == "fisheye":
        return kind in _FISHEYE
    if tag != "brown_conrady":
        return False
    coefficients = camera.coefficients  # type: ignore[union-attr]
    return len(coefficients) in _BROWN_COUNTS[kind] or (kind == "kalibr" and not any(coefficients[4:]))


def _nearest(camera: LensSettings, kind: str, file: str, fit: bool) -> tuple[LensSettings, str]:
    lens = f"{kind} has no lens like this one ({camera.__struct_config__.tag})"
    try:
        fitted = fit_brown_conrady(camera, _FITTED_COUNTS[kind])
    except ValueError as error:
        raise InterchangeError(
            file, "camera.model", f"{lens}, and none that is near: {error}", "another format"
        ) from None
    off = f"{fitted.largest_px:.2g} px off at most anywhere in the image"
    if fitted.largest_px > LARGEST_FIT_PX:
        raise InterchangeError(file, "camera.model", f"{lens}, and the nearest is {off}", "another format")
    count = len(fitted.camera.coefficients)
    if not fit:
        raise InterchangeError(
            file, "camera.model", lens,
            f"another format, or --fit for the nearest Brown-Conrady ({count} coefficients), {off}",
        )  # fmt: skip
    return fitted.camera, f"the lens was {camera.__struct_config__.tag}; this is the nearest Brown-Conrady, {off}"


GOOD_ENOUGH_PX = 0.001
"""Error below which a fit with fewer coefficients is accepted (px)."""
_STEPS = 20
"""For a refinement with a good start."""
_FITTED, _CHECKED = 41, 101
"""Points along each side of the image: where the lens is fitted, and where it is compared."""


@dataclass(frozen=True, slots=True)
class FittedLens:
    """``camera`` approximates another camera to within ``largest_px`` anywhere in the image."""

    camera: BrownConradyLens
    largest_px: float


def fit_brown_conrady(camera: LensSettings, counts: tuple[int, ...]) -> FittedLens:
    """The Brown-Conrady camera with the fewest of ``counts`` coefficients that is near enough, otherwise the nearest;
    focal lengths and principal point are kept.  ValueError if the image shows directions that no such lens maps.
    """
    original = make_camera(camera)
    best: FittedLens | None = None
    fault = ""
    for count in sorted(counts):
        try:
            fitted = _fit(original, count)
        except ValueError as error:
            fault = str(error)
            continue
        if best is None or fitted.largest_px < best.largest_px:
            best = fitted
        if best.largest_px <= GOOD_ENOUGH_PX:
            break
    if best is None:
        raise ValueError(fault)
    return best


def _fit(original: Camera, count: int) -> FittedLens:
    xy, uv_px = _seen(original, _FITTED)
    settings = original.settings
    q = (uv_px - [settings.cx_px, settings.cy_px]) / [settings.fx_px, settings.fy_px]
    start = _linear(xy, q, count)
    coefficients = start
    if count == 8:

        def errors(values: Array) -> Array:
            found = BrownMap(_ordered(values)).distort(np.ascontiguousarray(xy.T)).T
            return np.asarray(np.where(np.isfinite(found), found - q, 1.0)).ravel() * settings.fx_px

        coefficients = least_squares(errors, start, x_scale="jac", max_nfev=_STEPS).x
    lens = BrownConradyLens(
        **{key: getattr(settings, key) for key in ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px")},
        coefficients=_ordered(coefficients),
    )
    fitted = make_camera(lens)
    xy, uv_px = _seen(original, _CHECKED)
    apart_px = np.linalg.norm(fitted.distort(xy) - uv_px, axis=1)
    if not np.isfinite(apart_px).all():
        raise ValueError("the fitted lens doesn't map all of the image")
    return FittedLens(lens, float(apart_px.max()))


def _seen(camera: Camera, points: int) -> tuple[Array, Array]:
    """Ideal coordinates (n, 2) and pixels (n, 2) of a grid over the whole image."""
    u, v = np.linspace(0, camera.width_px - 1, points), np.linspace(0, camera.height_px - 1, points)
    uv_px = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    xy = camera.undistort(uv_px)
    if not np.isfinite(xy).all():
        raise ValueError("the image's corners see too far to the side for a lens without fisheye")
    return xy, uv_px


def _linear(xy: Array, q: Array, count: int) -> Array:
    """Radial and tangential terms by least squares: k1 k2 p1 p2 [k3 [k4 k5 k6]], the rational ones multiplied out."""
    x, y = xy.T
    r2 = x * x + y * y
    columns = [
        xy * r2[:, None],
        xy * (r2 * r2)[:, None],
        np.stack([2.0 * x * y, r2 + 2.0 * y * y], axis=1),
        np.stack([r2 + 2.0 * x * x, 2.0 * x * y], axis=1),
        xy * (r2**3)[:, None],
        *(-q * (r2**power)[:, None] for power in (1, 2, 3)),
    ]
    matrix = np.stack([column.ravel() for column in columns[:count]], axis=1)
    scale = np.linalg.norm(matrix, axis=0)
    scale[scale == 0.0] = 1.0
    found: Array = np.linalg.lstsq(matrix / scale, (q - xy).ravel(), rcond=1e-12)[0] / scale
    return found


def _ordered(values: Array) -> tuple[float, ...]:
    return tuple(float(v) for v in values)


HAND_EYE_FORMATS = ("ros-static", "urdf", "easy_handeye2", "json")
_FRAME = re.compile(r"[^/\s\"'<>&][^\s\"'<>&]*")


@dataclass(frozen=True, slots=True)
class HandEye:
    """The data to export: ``cam_T_grip`` with its 6 x 6 covariance (as published), and the frames' names.

    ``name`` is the calibration's; the marker's frame and the robot's base appear in an easy_handeye2 file only for
    completeness.
    """

    cam_T_grip: Transform
    covariance: tuple[float, ...]
    gripper_frame: str = "gripper_tcp"
    camera_frame: str = "camera_optical_frame"
    gripper_in_camera: bool = False
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
    lines = [
        *(f"# {note}" for note in notes),
        "parameters:",
        f"  name: {json.dumps(hand_eye.name)}",
        "  calibration_type: eye_in_hand",
        f"  robot_base_frame: {json.dumps(hand_eye.robot_base_frame)}",
        f"  robot_effector_frame: {json.dumps(hand_eye.gripper_frame)}",
        f"  tracking_base_frame: {json.dumps(hand_eye.camera_frame)}",
        f"  tracking_marker_frame: {json.dumps(hand_eye.tracking_marker_frame)}",
        "  freehand_robot_movement: true",
        "  move_group_namespace: /",
        "  move_group: manipulator",
        "transform:",
        "  translation:",
        *(f"    {axis}: {number_text(v)}" for axis, v in zip("xyz", translation, strict=True)),
        "  rotation:",
        *(f"    {axis}: {number_text(v)}" for axis, v in zip("xyzw", rotation, strict=True)),
    ]
    return "\n".join(lines) + "\n"


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
