"""A robot's existing hand/eye calibration: its own file with ``cam_T_grip`` or ``flange_T_cam``, or another program's.

A hand/eye calibration is of the flange, or of what the robot takes for its end; the gripper's frame is at the TCP.  So
``flange_T_tcp`` has to be said, in the file or beside its name, and is asked for where it isn't.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from gripmon import __version__
from gripmon.calibrate.documents import HandEyeCalibration
from gripmon.calibrate.hand_eye_formats import ForeignHandEye, read_hand_eye
from gripmon.daemon.config.checks import covariance_of, reference_transform
from gripmon.daemon.config.settings import ReferenceSettings, TransformSettings
from gripmon.daemon.config.typed import ConfigError, SettingsError, to_settings
from gripmon.daemon.config.yaml_file import GivenFile, kind_of, read_document
from gripmon.model.errors import InputError
from gripmon.model.geometry import from_record, invert, to_record
from gripmon.model.records import Array, Transform
from gripmon.model.yaml_text import as_yaml

_RIGHT = (
    "a file of gripmon calibrate plane, a hand/eye result of another program, or cam_T_grip: {translation_m: "
    "[x, y, z], rotation_xyzw: [x, y, z, w]}, or flange_T_cam and flange_T_tcp of that form"
)
_FLANGE = ("flange_frame", "flange_T_cam", "flange_T_tcp")
TCP = "the TCP (between the fingertips, x across the jaws, z out of the gripper)"
_WAY_OUT = "{translation_m: [x, y, z], rotation_xyzw: [x, y, z, w]}, [0, 0, 0] and [0, 0, 0, 1] if it is at that frame"
_BESIDE = ("flange_T_tcp", "id", "position_sigma_m", "rotation_sigma_rad", "covariance")
"""What a configuration may say beside the name of such a file."""


def reference_text(path: Path) -> tuple[bytes, str]:
    """The file's content as for ``gripmon teach --reference``, and a summary in words.

    ``cam_T_grip`` is ``inverse(flange_T_cam) flange_T_tcp``; ``position_sigma_m`` and ``rotation_sigma_rad`` are
    optional.  Raises :class:`~gripmon.model.errors.InputError`.
    """
    file = GivenFile(path, _RIGHT)
    if file.own:
        read_document(file, HandEyeCalibration)
        return file.data, "a file of gripmon calibrate plane"
    settings = robot_reference(path, robot_values(file))
    x, y, z = (1e3 * v for v in settings.cam_T_grip.translation_m)
    text = f"# {path.name}, by gripmon setup (gripmon {__version__})\n{as_yaml(msgspec.to_builtins(settings))}"
    return text.encode(), f"TCP at {x:.1f}, {y:.1f}, {z:.1f} mm in the camera frame"


def named_reference(config: Path, file: GivenFile, beside: dict[str, Any]) -> ReferenceSettings:
    """The reference of a configuration that names a robot's file, with what it says ``beside`` the name.
    :class:`~gripmon.model.errors.InputError`.
    """
    values = robot_values(file)
    for key, value in beside.items():
        if key not in _BESIDE:
            raise ConfigError(config, f"reference.{key}", "has no place beside hand_eye", " or ".join(_BESIDE))
        if values.get(key) is not None or (key == "flange_T_tcp" and "cam_T_grip" in values):
            raise ConfigError(config, f"reference.{key}", f"is said by {file.path}, too", "one of both")
        if key == "flange_T_tcp":
            _transform(config, value, f"reference.{key}")
        values[key] = value
    where = f"{config}: reference: {{hand_eye: {file.path.name}, flange_T_tcp: …}}"
    return robot_reference(file.path, values, where)


def robot_values(file: GivenFile) -> dict[str, Any]:
    """The keys of a robot's file, also of another program's.  :class:`~gripmon.model.errors.InputError` if it is
    neither.
    """
    hand_eye = read_hand_eye(file.document)
    if hand_eye is not None:
        return reference_values(sure(file.path, hand_eye))
    values = file.values
    if not is_robot_reference(values):
        kind = kind_of(values)
        wrong = "contains no hand/eye calibration" if kind is None else f"is {kind}"
        raise ConfigError(file.path, "", wrong, _RIGHT)
    return values


def sure(path: Path, hand_eye: ForeignHandEye) -> ForeignHandEye:
    """Another program's hand/eye transform; :class:`~gripmon.model.errors.InputError` if its axes are in doubt."""
    if hand_eye.doubt:
        raise InputError(f"{path}: {hand_eye.doubt}; gripmon calibrate import if it hasn't")
    return hand_eye


def is_robot_reference(values: dict[str, Any]) -> bool:
    """Whether a document is one for :func:`robot_reference`."""
    return "schema" not in values and ("cam_T_grip" in values or "flange_T_cam" in values)


def reference_values(hand_eye: ForeignHandEye) -> dict[str, Any]:
    """Another program's hand/eye transform as such a file's values; no ``flange_T_tcp`` where it doesn't tell it."""
    if hand_eye.covariance is not None and hand_eye.at_tcp:
        return {"cam_T_grip": _listed(invert(hand_eye.grip_T_cam)), "covariance": list(hand_eye.covariance)}
    at_tcp = _listed(np.eye(4)) if hand_eye.at_tcp else None
    flange_T_cam = _listed(hand_eye.grip_T_cam)
    return {"flange_frame": hand_eye.gripper_frame, "flange_T_cam": flange_T_cam, "flange_T_tcp": at_tcp}


def _listed(transform: Array) -> dict[str, list[float]]:
    record = to_record(transform)
    return {"translation_m": list(record.translation_m), "rotation_xyzw": list(record.rotation_xyzw)}


def frame_without_tcp(values: dict[str, Any]) -> str:
    """The frame that a robot's file is of where it doesn't say where the TCP is in it; else empty."""
    known = "cam_T_grip" in values or values.get("flange_T_tcp") is not None
    return "" if known else str(values.get("flange_frame") or "flange")


def at_flange(path: Path, values: dict[str, Any]) -> ReferenceSettings:
    """The same as :func:`robot_reference`, of the flange.  :class:`~gripmon.model.errors.InputError`."""
    return _checked(path, values, invert(_transform(path, values["flange_T_cam"], "flange_T_cam")))


def tcp_unknown(path: Path, frame: str, where: str = "") -> InputError:
    """The question that a hand/eye calibration of the flange leaves open, and ``where`` to answer it."""
    where = where or "in the file of gripmon calibrate import, flange_T_tcp:"
    return InputError(f"{path}: flange_T_tcp: isn't said: where {TCP} is in {frame}; {where} {_WAY_OUT}")


def robot_reference(path: Path, values: dict[str, Any], where: str = "") -> ReferenceSettings:
    """The reference that a robot's file says, given what was read of it; ``where`` the place of the TCP may be said.
    :class:`~gripmon.model.errors.InputError`.
    """
    if "flange_T_cam" in values and "cam_T_grip" not in values:
        flange_T_cam = _transform(path, values["flange_T_cam"], "flange_T_cam")
        if frame := frame_without_tcp(values):
            raise tcp_unknown(path, frame, where)
        flange_T_tcp = _transform(path, values["flange_T_tcp"], "flange_T_tcp")
        return _checked(path, values, invert(flange_T_cam) @ flange_T_tcp, in_front=True)
    if "cam_T_grip" not in values:
        raise InputError(f"{path}: contains no hand/eye calibration; {_RIGHT}")
    return _checked(path, values, in_front=True)


def _checked(
    path: Path, values: dict[str, Any], cam_T_grip: Array | None = None, *, in_front: bool = False
) -> ReferenceSettings:
    """The file's section, with this pose (4, 4) in place of the flange's; ``in_front``: it is that of a gripper."""
    if cam_T_grip is not None:
        rest = {key: value for key, value in values.items() if key not in _FLANGE}
        values = {**rest, "cam_T_grip": _listed(cam_T_grip)}
    try:
        settings = to_settings(values, ReferenceSettings, "")
        if in_front:
            reference_transform(settings)
        covariance_of(settings)
    except SettingsError as error:
        key = error.fault.key.removeprefix("reference.")
        raise InputError(f"{path}: {key}: {error.fault.wrong}; {error.fault.right}") from None
    return settings


def _transform(path: Path, value: object, key: str) -> Array:
    try:
        found = to_settings(value, TransformSettings, key)
        alone = ReferenceSettings(cam_T_grip=msgspec.structs.replace(found, translation_m=(0.0, 0.0, 0.1)))
        reference_transform(alone)  # checks only the rotation: this position isn't the camera's
    except SettingsError as error:
        wrong = error.fault.key.replace("reference.cam_T_grip", key)
        raise InputError(f"{path}: {wrong}: {error.fault.wrong}; {error.fault.right}") from None
    return from_record(Transform(found.translation_m, found.rotation_xyzw))
