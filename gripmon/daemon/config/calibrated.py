"""Files of ``gripmon calibrate`` that a configuration names where it may also have a section: camera and reference."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from gripmon.calibrate.documents import CameraCalibration, HandEyeCalibration
from gripmon.daemon.config.errors import ConfigError
from gripmon.daemon.config.typed import Fault, SettingsError, to_settings
from gripmon.daemon.config.yaml_file import read_yaml
from gripmon.model.camera import LensSettings
from gripmon.model.gripper import Gripper
from gripmon.track.edges.taught import gripper_digest

_T = TypeVar("_T")
_WHAT = {
    "camera": "a file of gripmon calibrate intrinsics",
    "reference": "a file of gripmon calibrate plane",
}


@dataclass(frozen=True, slots=True)
class CalibrationFiles:
    """``paths``: the files by key of the configuration; ``hand_eye``: what the reference's says."""

    paths: dict[str, Path] = field(default_factory=dict)
    hand_eye: HandEyeCalibration | None = None


def with_sections(path: Path, values: dict[str, Any]) -> tuple[dict[str, Any], CalibrationFiles]:
    """The configuration's values with the sections that the files stand for.  Raises :class:`ConfigError`."""
    values, paths, hand_eye = dict(values), {}, None
    if isinstance(values.get("camera"), str):
        paths["camera"] = _file(path, "camera", values["camera"])
        values["camera"] = _as_read(read_camera(paths["camera"]).camera)
    if isinstance(values.get("reference"), str):
        paths["reference"] = _file(path, "reference", values["reference"])
        hand_eye = read_hand_eye(paths["reference"])
        values["reference"] = {"cam_T_grip": _as_read(hand_eye.cam_T_grip), "covariance": list(hand_eye.covariance)}
    return values, CalibrationFiles(paths, hand_eye)


def read_camera(path: Path) -> CameraCalibration:
    """A calibrated camera.  Raises :class:`ConfigError`."""
    calibration = _read(path, CameraCalibration)
    count = len(calibration.parameters)
    if len(calibration.covariance) != count * count:
        wrong = f"has {len(calibration.covariance)} values for {count} parameters"
        raise ConfigError(path, "covariance", wrong, f"{count * count} values, row by row")
    return calibration


def read_hand_eye(path: Path) -> HandEyeCalibration:
    """A hand/eye calibration.  Raises :class:`ConfigError`."""
    return _read(path, HandEyeCalibration)


def mismatch(hand_eye: HandEyeCalibration, camera: LensSettings, gripper: Gripper) -> Fault | None:
    """Why a hand/eye calibration isn't one of this camera and this gripper."""
    if hand_eye.camera != camera:
        return Fault("camera", "isn't the configuration's camera", "the hand/eye calibration made with the same camera")
    if hand_eye.gripper.sha256 != gripper_digest(gripper):
        same = " with other contents" if hand_eye.gripper.name == gripper.name else ""
        wrong = f"is {hand_eye.gripper.name}{same}, the configuration has {gripper.name}"
        return Fault("gripper", wrong, "the hand/eye calibration made with the same gripper file")
    return None


def _as_read(value: msgspec.Struct) -> Any:
    """As it stands in a file, with lists."""
    return msgspec.json.decode(msgspec.json.encode(value))


def _file(path: Path, key: str, name: str) -> Path:
    there = path.parent / name
    if not there.is_file():
        raise ConfigError(
            path, key, f"there is no file {there}", f"{_WHAT[key]}, its path relative to this file, or a section"
        )
    return there


def _read(path: Path, kind: type[_T]) -> _T:
    values = read_yaml(path)
    tag = kind.__struct_config__.tag  # type: ignore[attr-defined]
    if values.get("schema") != tag:
        raise ConfigError(path, "schema", *wrong_schema(values, str(tag)))
    try:
        return to_settings(values, kind)
    except SettingsError as error:
        raise ConfigError(path, error.fault.key, error.fault.wrong, error.fault.right) from None


_LOOKS_LIKE = {"points": "a gripper file", "gripper": "a configuration", "corners": "a file with corners"}


def wrong_schema(values: dict[str, Any], tag: str) -> tuple[str, str]:
    """What is wrong with a file that isn't of the wanted kind, and what would be right."""
    schema = values.get("schema")
    if schema is not None:
        return f"is {schema!r}", tag
    looks = next((f"; this looks like {what}" for key, what in _LOOKS_LIKE.items() if key in values), "")
    return f"is missing{looks}", f"a file with schema: {tag}"
