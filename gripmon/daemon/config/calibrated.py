"""Files of ``gripmon calibrate``, or of other programs, that a configuration may name in place of its sections
``camera`` and ``reference``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from gripmon.calibrate import camera_files
from gripmon.calibrate.documents import CalibratedGripper, CameraCalibration, HandEyeCalibration
from gripmon.calibrate.foreign import UnknownFormatError
from gripmon.daemon.config.robot_file import RobotFile, reference_in
from gripmon.daemon.config.typed import ConfigError, Fault
from gripmon.daemon.config.yaml_file import GivenFile, named_file, read_document, read_settings
from gripmon.model.camera import LensSettings, same_lens
from gripmon.model.errors import InputError
from gripmon.model.gripper import Gripper
from gripmon.model.provenance import provenance_of
from gripmon.model.response import Response
from gripmon.track.edges.taught import gripper_digest

_INTRINSICS = "a file of gripmon calibrate intrinsics or another program's camera"
_PLANE = "a file of gripmon calibrate plane or another program's hand/eye result"
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
    reference = values.get("reference")
    named = {"hand_eye": reference} if isinstance(reference, str) else reference
    if isinstance(named, dict) and "hand_eye" in named:
        paths["reference"], hand_eye, values["reference"] = _named_reference(path, named)
    return values, CalibrationFiles(paths, hand_eye)


def _named_reference(config: Path, section: dict[str, Any]) -> tuple[Path, HandEyeCalibration | None, dict[str, Any]]:
    """The file that ``hand_eye`` of a section names, its content if it is gripmon's, and the section that both say."""
    beside = {key: value for key, value in section.items() if key != "hand_eye"}
    name = section["hand_eye"]
    if not isinstance(name, str):
        raise ConfigError(config, "reference.hand_eye", f"is {name!r}", _PLANE)
    file = GivenFile(named_file(config, "reference", name, _PLANE, _OR))
    if file.own and beside:
        wrong = f"stands beside {name}, a file of gripmon's that says it"
        raise ConfigError(config, f"reference.{next(iter(beside))}", wrong, f"reference: {name}")
    found = reference_in(file)
    if isinstance(found, RobotFile):
        where = f"{config}: reference: {{hand_eye: {file.path.name}, flange_T_tcp: …}}"
        return file.path, None, _as_read(found.beside(config, beside).reference(where))
    keys = ("cam_T_grip", "covariance", "with_gripper")
    return file.path, found, {key: value for key, value in _as_read(found).items() if key in keys}


def read_camera(file: Path | GivenFile) -> CameraCalibration:
    """A calibrated camera, in a file of gripmon calibrate or of another program, or as in a configuration.  Raises
    :class:`ConfigError`, for another program's file :class:`~gripmon.model.errors.InputError`.
    """
    file = file if isinstance(file, GivenFile) else GivenFile(file)
    if file.lens is not None:
        lens: LensSettings = read_settings(file.path, LensSettings, file.lens)  # type: ignore[arg-type]
        made = provenance_of(f"read from {file.path.name}", [file.input])
        return CameraCalibration(camera=lens, parameters=(), covariance=(), provenance=made)
    foreign = foreign_camera(file)
    if foreign is not None:
        return foreign
    calibration = read_document(file, CameraCalibration)
    count = len(calibration.parameters)
    if len(calibration.covariance) != count * count:
        wrong = f"has {len(calibration.covariance)} values for {count} parameters"
        raise ConfigError(file.path, "covariance", wrong, f"{count * count} values, row by row")
    return calibration


def foreign_camera(file: GivenFile) -> CameraCalibration | None:
    """The camera in another program's file, exact; None for a file of gripmon's.
    :class:`~gripmon.model.errors.InputError` also where ``gripmon calibrate import`` would only warn.
    """
    path = file.path
    if file.own:
        return None
    try:
        found = camera_files.read_camera(file.document)
    except UnknownFormatError:  # the reader of gripmon's own files says what it is
        return None
    if found.warnings:
        right = "gripmon calibrate import, if it is right so; --model brown_conrady or fisheye says the lens"
        raise InputError(f"{path}: {found.warnings[0]}; {right}")
    return CameraCalibration(
        camera=found.camera, parameters=(), covariance=(), warnings=(f"{found.kind}: its uncertainty is unknown",),
        provenance=provenance_of(f"read from {path.name}, a file of {found.kind}", [file.input]),
    )  # fmt: skip


def mismatch(
    made_camera: LensSettings | None, made: CalibratedGripper | None, camera: LensSettings, gripper: Gripper
) -> Fault | None:
    """Why a hand/eye calibration, made with a camera and a gripper as far as it tells, doesn't belong to these; None if
    it does.
    """
    if made_camera is not None and not same_lens(made_camera, camera):
        return Fault("camera", "isn't the camera that is given", "the hand/eye calibration made with the same camera")
    if made is not None and made.sha256 != gripper_digest(gripper):
        name = made.name
        same = " with other contents" if name == gripper.name else ""
        wrong = f"is {name}{same}, the one given is {gripper.name}"
        right = "the hand/eye calibration made with the same gripper file; gripmon calibrate plane makes it again"
        if made.sha256 == gripper_digest(gripper, name):
            wrong, right = f"{wrong}, the same except for its name", f"name: {name} in the gripper file"
        return Fault("gripper", wrong, right)
    return None


def _as_read(value: msgspec.Struct) -> Any:
    """As if read from a file, with lists."""
    return msgspec.json.decode(msgspec.json.encode(value))
