"""A robot's existing hand/eye calibration: its own file with ``cam_T_grip`` or ``flange_T_cam``, or another program's.

A hand/eye calibration is of the flange, or of what the robot takes for its end; the gripper's frame is at the TCP.  So
``flange_T_tcp`` has to be said, in the file or beside its name, and is asked for where it isn't.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from gripmon import __version__
from gripmon.calibrate.documents import HandEyeCalibration
from gripmon.calibrate.hand_eye_formats import ForeignHandEye, read_hand_eye
from gripmon.daemon.config.reference import covariance_of, pose_in, reference_transform
from gripmon.daemon.config.settings import ReferenceSettings, TransformSettings
from gripmon.daemon.config.typed import ConfigError, faults_of, to_settings
from gripmon.daemon.config.yaml_file import GivenFile, kind_of, read_document
from gripmon.model.errors import InputError
from gripmon.model.geometry import invert, to_record
from gripmon.model.records import Array
from gripmon.model.yaml_text import as_yaml

_RIGHT = (
    "a file of gripmon calibrate plane, a hand/eye result of another program, or cam_T_grip: {translation_m: "
    "[x, y, z], rotation_xyzw: [x, y, z, w]}, or flange_T_cam and flange_T_tcp of that form"
)
TCP = "the TCP (between the fingertips, x across the jaws, z out of the gripper)"
_WAY_OUT = "{translation_m: [x, y, z], rotation_xyzw: [x, y, z, w]}, [0, 0, 0] and [0, 0, 0, 1] if it is at that frame"
_FLANGE = ("flange_frame", "flange_T_cam", "flange_T_tcp")
_BESIDE = ("flange_T_tcp", "id", "position_sigma_m", "rotation_sigma_rad", "covariance")
"""What a configuration may say beside the name of such a file."""


@dataclass(frozen=True)
class RobotFile:
    """Such a file's content: ``cam_T_grip``, or ``flange_T_cam`` with ``flange_T_tcp``, and how good it is.  What is
    wrong with a value is an :class:`~gripmon.model.errors.InputError` where the value is asked for.
    """

    path: Path
    values: dict[str, Any]

    @classmethod
    def of(cls, file: GivenFile) -> RobotFile | None:
        """What a file of another program holds, or a robot's own; None if it is neither."""
        hand_eye = read_hand_eye(file.document)
        if hand_eye is not None:
            if hand_eye.doubt:
                raise InputError(f"{file.path}: {hand_eye.doubt}; gripmon calibrate import if it hasn't")
            return cls.foreign(file.path, hand_eye)
        with contextlib.suppress(ConfigError):  # no YAML: whoever reads other files says so
            if "schema" not in file.values and ("cam_T_grip" in file.values or "flange_T_cam" in file.values):
                return cls(file.path, file.values)
        return None

    @classmethod
    def foreign(cls, path: Path, hand_eye: ForeignHandEye) -> RobotFile:
        """Another program's hand/eye transform; without ``flange_T_tcp`` where it doesn't tell it."""
        if hand_eye.covariance is not None and hand_eye.at_tcp:
            return cls(
                path, {"cam_T_grip": _listed(invert(hand_eye.grip_T_cam)), "covariance": list(hand_eye.covariance)}
            )
        at_tcp = _listed(np.eye(4)) if hand_eye.at_tcp else None
        frame, flange_T_cam = hand_eye.gripper_frame, _listed(hand_eye.grip_T_cam)
        return cls(path, {"flange_frame": frame, "flange_T_cam": flange_T_cam, "flange_T_tcp": at_tcp})

    def beside(self, config: Path, given: dict[str, Any]) -> RobotFile:
        """With what a configuration says beside the file's name."""
        values = dict(self.values)
        for key, value in given.items():
            if key not in _BESIDE:
                raise ConfigError(config, f"reference.{key}", "has no place beside hand_eye", " or ".join(_BESIDE))
            if values.get(key) is not None or (key == "flange_T_tcp" and "cam_T_grip" in values):
                raise ConfigError(config, f"reference.{key}", f"is said by {self.path}, too", "one of both")
            if key == "flange_T_tcp":
                _transform(config, value, f"reference.{key}")
            values[key] = value
        return RobotFile(self.path, values)

    @property
    def frame(self) -> str:
        """The frame that the file is of where it doesn't say where the TCP is in it; else empty."""
        known = "cam_T_grip" in self.values or self.values.get("flange_T_tcp") is not None
        return "" if known else str(self.values.get("flange_frame") or "flange")

    def reference(self, where: str = "") -> ReferenceSettings:
        """The reference that it says, of a gripper in front of the camera; ``where`` the place of the TCP may be said,
        if not in the file.
        """
        if "cam_T_grip" in self.values:
            return self._section(self.values, in_front=True)
        flange_T_cam = self._pose("flange_T_cam")
        if self.frame:
            raise tcp_unknown(self.path, self.frame, where)
        return self._of(invert(flange_T_cam) @ self._pose("flange_T_tcp"), in_front=True)

    def of_flange(self) -> ReferenceSettings:
        """The same of the flange, of a file that doesn't say where the TCP is."""
        return self._of(invert(self._pose("flange_T_cam")))

    def _pose(self, key: str) -> Array:
        return _transform(self.path, self.values[key], key)

    def _of(self, cam_T_grip: Array, *, in_front: bool = False) -> ReferenceSettings:
        rest = {key: value for key, value in self.values.items() if key not in _FLANGE}
        return self._section({**rest, "cam_T_grip": _listed(cam_T_grip)}, in_front=in_front)

    def _section(self, values: dict[str, Any], *, in_front: bool) -> ReferenceSettings:
        with faults_of(self.path):
            settings = to_settings(values, ReferenceSettings)
            if in_front:
                reference_transform(settings)
            covariance_of(settings)
        return settings


def reference_in(file: GivenFile) -> HandEyeCalibration | RobotFile:
    """What a reference's file holds.  :class:`~gripmon.model.errors.InputError` if it is none."""
    if file.own:
        return read_document(file, HandEyeCalibration)
    found = RobotFile.of(file)
    if found is None:
        kind = kind_of(file.values)
        raise ConfigError(file.path, "", "contains no hand/eye calibration" if kind is None else f"is {kind}", _RIGHT)
    return found


def reference_text(path: Path) -> tuple[bytes, str]:
    """The file's content as for ``gripmon teach --reference``, and a summary in words.  :class:`InputError`."""
    file = GivenFile(path, _RIGHT)
    found = reference_in(file)
    if isinstance(found, HandEyeCalibration):
        return file.data, "a file of gripmon calibrate plane"
    settings = found.reference()
    x, y, z = (1e3 * v for v in settings.cam_T_grip.translation_m)
    text = f"# {path.name}, by gripmon setup (gripmon {__version__})\n{as_yaml(msgspec.to_builtins(settings))}"
    return text.encode(), f"TCP at {x:.1f}, {y:.1f}, {z:.1f} mm in the camera frame"


def tcp_unknown(path: Path, frame: str, where: str = "") -> InputError:
    """The question that a hand/eye calibration of the flange leaves open, and ``where`` to answer it."""
    where = where or "in the file of gripmon calibrate import, flange_T_tcp:"
    return InputError(f"{path}: flange_T_tcp: isn't said: where {TCP} is in {frame}; {where} {_WAY_OUT}")


def _transform(path: Path, value: object, key: str) -> Array:
    with faults_of(path):
        return pose_in(to_settings(value, TransformSettings, key), key)


def _listed(transform: Array) -> dict[str, list[float]]:
    record = to_record(transform)
    return {"translation_m": list(record.translation_m), "rotation_xyzw": list(record.rotation_xyzw)}
