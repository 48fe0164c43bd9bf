"""A robot's existing hand/eye calibration, as a file for teaching."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from gripmon import __version__
from gripmon.calibrate.documents import HandEyeCalibration
from gripmon.calibrate.hand_eye_formats import ForeignHandEye
from gripmon.daemon.config.checks import covariance_of, reference_transform
from gripmon.daemon.config.settings import ReferenceSettings, TransformSettings
from gripmon.daemon.config.typed import SettingsError, to_settings
from gripmon.daemon.config.yaml_file import read_document, read_yaml
from gripmon.model.errors import InputError
from gripmon.model.geometry import from_record, invert, to_record
from gripmon.model.records import Array, Transform
from gripmon.model.yaml_text import as_yaml

_RIGHT = (
    "a file of gripmon calibrate plane, or cam_T_grip: {translation_m: [x, y, z], rotation_xyzw: [x, y, z, w]}, or "
    "flange_T_cam and flange_T_tcp of that form"
)
_FLANGE = ("flange_T_cam", "flange_T_tcp")


def reference_text(path: Path) -> tuple[bytes, str]:
    """The file's content as for ``gripmon teach --reference``, and a summary in words.

    ``cam_T_grip`` is ``inverse(flange_T_cam) flange_T_tcp``; ``position_sigma_m`` and ``rotation_sigma_rad`` are
    optional.  Raises :class:`~gripmon.model.errors.InputError`.
    """
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; {_RIGHT}")
    values = read_yaml(path)
    if "schema" in values:
        read_document(path, HandEyeCalibration)
        return path.read_bytes(), "a file of gripmon calibrate plane"
    settings = robot_reference(path, values)
    x, y, z = (1e3 * v for v in settings.cam_T_grip.translation_m)
    text = f"# {path.name}, by gripmon setup (gripmon {__version__})\n{as_yaml(msgspec.to_builtins(settings))}"
    return text.encode(), f"TCP at {x:.1f}, {y:.1f}, {z:.1f} mm in the camera frame"


def is_robot_reference(values: dict[str, object]) -> bool:
    """Whether a document is one for :func:`robot_reference`."""
    return "schema" not in values and ("cam_T_grip" in values or all(name in values for name in _FLANGE))


def reference_values(hand_eye: ForeignHandEye) -> dict[str, object]:
    """Another program's hand/eye transform as such a file's values, the TCP at the gripper's frame."""
    if hand_eye.covariance is not None:
        return {"cam_T_grip": _listed(invert(hand_eye.grip_T_cam)), "covariance": list(hand_eye.covariance)}
    return {"flange_T_cam": _listed(hand_eye.grip_T_cam), "flange_T_tcp": _listed(np.eye(4))}


def _listed(transform: Array) -> dict[str, list[float]]:
    record = to_record(transform)
    return {"translation_m": list(record.translation_m), "rotation_xyzw": list(record.rotation_xyzw)}


def robot_reference(path: Path, values: dict[str, object]) -> ReferenceSettings:
    """The reference that a robot's file says, given what was read of it.  :class:`~gripmon.model.errors.InputError`."""
    if all(name in values for name in _FLANGE):
        flange_T_cam, flange_T_tcp = (_transform(path, values.pop(name), name) for name in _FLANGE)
        values["cam_T_grip"] = _listed(invert(flange_T_cam) @ flange_T_tcp)
    elif "cam_T_grip" not in values:
        raise InputError(f"{path}: contains no hand/eye calibration; {_RIGHT}")
    try:
        settings = to_settings(values, ReferenceSettings, "")
        reference_transform(settings)
        covariance_of(settings)
    except SettingsError as error:
        raise InputError(f"{path}: {error.fault.key}: {error.fault.wrong}; {error.fault.right}") from None
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
