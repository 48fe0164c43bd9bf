"""Files of ``gripmon calibrate`` that a configuration may name instead of the sections ``camera`` and ``reference``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from gripmon.calibrate import camera_files
from gripmon.calibrate.documents import CalibratedGripper, CameraCalibration, HandEyeCalibration
from gripmon.calibrate.foreign import UnknownFormatError
from gripmon.daemon.config.typed import ConfigError, Fault
from gripmon.daemon.config.yaml_file import is_document, named_file, read_document
from gripmon.model.camera import LensSettings
from gripmon.model.errors import InputError
from gripmon.model.gripper import Gripper
from gripmon.model.provenance import provenance_of
from gripmon.model.response import Response
from gripmon.track.edges.taught import gripper_digest

_INTRINSICS = "a file of gripmon calibrate intrinsics or another program's camera"
_PLANE = "a file of gripmon calibrate plane"
_OR = ", or a section"


@dataclass(frozen=True, slots=True)
class CalibrationFiles:
    """``paths``: the files by configuration key; ``hand_eye``: the content of the reference's file."""

    paths: dict[str, Path] = field(default_factory=dict)
    hand_eye: HandEyeCalibration | None = None

    @property
    def response(self) -> Response | None:
        """How grey levels follow the light, where the reference's images show it."""
        return None if self.hand_eye is None else self.hand_eye.response


def with_sections(path: Path, values: dict[str, Any]) -> tuple[dict[str, Any], CalibrationFiles]:
    """The configuration's values with file names replaced by their sections.  Raises :class:`ConfigError`."""
    values, paths, hand_eye = dict(values), {}, None
    if isinstance(values.get("camera"), str):
        paths["camera"] = named_file(path, "camera", values["camera"], _INTRINSICS, _OR)
        values["camera"] = _as_read(read_camera(paths["camera"]).camera)
    if isinstance(values.get("reference"), str):
        paths["reference"] = named_file(path, "reference", values["reference"], _PLANE, _OR)
        hand_eye = read_document(paths["reference"], HandEyeCalibration)
        values["reference"] = {
            "cam_T_grip": _as_read(hand_eye.cam_T_grip),
            "covariance": list(hand_eye.covariance),
            "with_gripper": hand_eye.with_gripper,
        }
    return values, CalibrationFiles(paths, hand_eye)


def read_camera(path: Path) -> CameraCalibration:
    """A calibrated camera, in a file of gripmon calibrate or of another program.  Raises :class:`ConfigError`, for
    another program's file :class:`~gripmon.model.errors.InputError`.
    """
    foreign = foreign_camera(path)
    if foreign is not None:
        return foreign
    calibration = read_document(path, CameraCalibration)
    count = len(calibration.parameters)
    if len(calibration.covariance) != count * count:
        wrong = f"has {len(calibration.covariance)} values for {count} parameters"
        raise ConfigError(path, "covariance", wrong, f"{count * count} values, row by row")
    return calibration


def foreign_camera(path: Path) -> CameraCalibration | None:
    """The camera in another program's file, exact; None for a file of gripmon's.
    :class:`~gripmon.model.errors.InputError` also where ``gripmon calibrate import`` would only warn.
    """
    if is_document(path) or not path.is_file():
        return None
    try:
        found = camera_files.read_camera(path.read_bytes(), str(path))
    except (OSError, UnknownFormatError):  # the reader of gripmon's own files says why it can't be read
        return None
    if found.warnings:
        raise InputError(f"{path}: {found.warnings[0]}; gripmon calibrate import with --model brown_conrady or fisheye")
    return CameraCalibration(
        camera=found.camera, parameters=(), covariance=(), warnings=(f"{found.kind}: its uncertainty is unknown",),
        provenance=provenance_of(f"read from {path.name}, a file of {found.kind}", [path]),
    )  # fmt: skip


def mismatch(
    made_camera: LensSettings | None, made: CalibratedGripper | None, camera: LensSettings, gripper: Gripper
) -> Fault | None:
    """Why a hand/eye calibration, made with a camera and a gripper as far as it tells, doesn't belong to these; None if
    it does.
    """
    if made_camera not in (None, camera):
        return Fault("camera", "isn't the configuration's camera", "the hand/eye calibration made with the same camera")
    if made is not None and made.sha256 != gripper_digest(gripper):
        name = made.name
        same = " with other contents" if name == gripper.name else ""
        wrong = f"is {name}{same}, the configuration has {gripper.name}"
        right = "the hand/eye calibration made with the same gripper file; gripmon calibrate plane makes it again"
        if made.sha256 == gripper_digest(gripper, name):
            wrong, right = f"{wrong}, the same except for its name", f"name: {name} in the gripper file"
        return Fault("gripper", wrong, right)
    return None


def _as_read(value: msgspec.Struct) -> Any:
    """As if read from a file, with lists."""
    return msgspec.json.decode(msgspec.json.encode(value))
