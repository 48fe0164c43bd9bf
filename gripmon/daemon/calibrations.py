"""What options and files name: a camera, a gripper's pose, the inputs of a calibration.  One reader for all of them, of
files of ``gripmon calibrate``, a robot's own, a configuration, a monitor's state or its estimates.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from gripmon.calibrate.bundle import GivenCamera
from gripmon.calibrate.documents import CalibratedGripper, HandEyeCalibration
from gripmon.calibrate.sighting import CalibrationError
from gripmon.calibrate.verify import Calibrated
from gripmon.daemon.config import Config, load_config, read_gripper
from gripmon.daemon.config.calibrated import foreign_camera, mismatch, read_camera
from gripmon.daemon.config.reference import covariance_of
from gripmon.daemon.config.robot_file import RobotFile, tcp_unknown
from gripmon.daemon.config.typed import ConfigError
from gripmon.daemon.config.yaml_file import GivenFile, kind_of, read_document, read_settings
from gripmon.daemon.targets import target_of_command
from gripmon.judge.statefile import unpack
from gripmon.model.atomic import write_atomically
from gripmon.model.camera import Camera, LensSettings, make_camera
from gripmon.model.errors import InputError
from gripmon.model.geometry import from_record, to_record
from gripmon.model.gripper import Gripper
from gripmon.model.images import image_paths
from gripmon.model.provenance import Provenance
from gripmon.model.records import Array, FrameRecord, Transform
from gripmon.model.targets import Target, refuse_other_size
from gripmon.model.units import in_degrees, in_mm
from gripmon.model.yaml_text import as_yaml
from gripmon.teach.hand_eye import calibrate_plane, checked_opening, measure_tracked
from gripmon.teach.mounts import Mount, towards
from gripmon.teach.outlines import RoughCorners, check_rough, outlines_of
from gripmon.track.edges.taught import gripper_digest

_RIGHT = "a file of gripmon calibrate or another program, a configuration, a monitor's state or its estimates"
_MOST_FOREIGN_BYTES = 1 << 24
"""Largest file that may be another program's."""


def read_calibrated(file: Path | GivenFile) -> Calibrated:
    """The calibration in a file.  :class:`~gripmon.model.errors.InputError` if there is none."""
    file = file if isinstance(file, GivenFile) else given_file(file)
    path, head = file.path, file.data[:4096].lstrip()
    if head.startswith(b'{"sha256"'):
        return _state(path, file.data)
    if head.startswith(b"{") and path.suffix != ".yaml":
        return _foreign(file) or _estimates(path, file.data)
    try:
        values = file.values
    except ConfigError:
        if (found := _foreign(file)) is None:
            raise
        return found
    return _of_yaml(file, values)


def given_file(path: Path) -> GivenFile:
    """A file that an option names for its calibration."""
    return GivenFile(path, _RIGHT)


def _foreign(file: GivenFile) -> Calibrated | None:
    """What a robot's file holds, or another program's; None if it is of none that is known."""
    if len(file.data) > _MOST_FOREIGN_BYTES:
        return None
    if (robot := RobotFile.of(file)) is not None:
        return _robot(robot)
    found = foreign_camera(file)
    return None if found is None else Calibrated(str(file.path), "another program's camera", found.camera)


def _of_yaml(file: GivenFile, values: dict[str, object]) -> Calibrated:
    path = file.path
    readers = {"gripmon.camera_calibration/1": _camera, "gripmon.hand_eye_calibration/1": _hand_eye}
    if values.get("schema") in readers:
        return readers[str(values["schema"])](file)
    if "camera" in values and "gripper" in values:
        return _configuration(path)
    if file.lens is not None:
        return Calibrated(str(path), "a camera", read_settings(path, LensSettings, file.lens))  # type: ignore[arg-type]
    kind = kind_of(values)
    if kind is None and (found := _foreign(file)) is not None:
        return found
    raise InputError(f"{path}: holds no calibration{f', it is {kind}' if kind else ''}; {_RIGHT}")


def _camera(file: GivenFile) -> Calibrated:
    found = read_camera(file)
    values = {**_plain(found.camera)}
    sigmas = [
        f"{name} {values[name]:.6g} ± {math.sqrt(max(found.covariance[i * (len(found.parameters) + 1)], 0.0)):.2g}"
        for i, name in enumerate(found.parameters)
    ]
    notes = [*_origin(found.provenance), *([f"one standard deviation: {', '.join(sigmas)}"] if sigmas else [])]
    if found.residuals is not None:
        notes.append(f"rms {found.residuals.rms_px:.3f} px over {found.residuals.points} points")
    return Calibrated(
        str(file.path), "a camera calibration", found.camera, found.parameters, found.covariance, target=found.target,
        notes=tuple(notes),
    )  # fmt: skip


def _plain(camera: LensSettings) -> dict[str, float]:
    """A camera's numbers by their names in a calibration."""
    values: dict[str, float] = {}
    for key, value in msgspec.structs.asdict(camera).items():
        values.update({f"{key}.{i}": v for i, v in enumerate(value)} if isinstance(value, tuple) else {key: value})
    return values


def _hand_eye(file: GivenFile) -> Calibrated:
    found = read_document(file, HandEyeCalibration)
    residuals = found.residuals
    return Calibrated(
        str(file.path),
        "a hand/eye calibration",
        found.camera,
        cam_T_grip=found.cam_T_grip,
        covariance=found.covariance,
        with_gripper=found.with_gripper,
        gripper=found.gripper,
        jaw_opening_m=found.jaw_opening_m,
        target=target_of_command(found.provenance.command),
        notes=_origin(found.provenance),
        pose_notes=(
            *_uncertainty(found.covariance),
            f"rms {1e3 * residuals.rms_m:.4f} mm; {residuals.corners} corners, {residuals.images} images",
        ),
    )


def _configuration(path: Path) -> Calibrated:
    config = load_config(path, check_source=False, with_taught=False)
    reference = config.reference
    return Calibrated(
        str(path),
        "a configuration",
        config.settings.camera,
        cam_T_grip=reference.cam_T_grip,
        covariance=reference.covariance,
        with_gripper=reference.with_gripper,
        gripper=CalibratedGripper(name=config.gripper.name, sha256=gripper_digest(config.gripper)),
        pose_notes=(f"the configured reference {reference.reference_id}", *_uncertainty(reference.covariance)),
    )


def _robot(file: RobotFile) -> Calibrated:
    settings = file.of_flange() if file.frame else file.reference()
    told, covariance = settings.cam_T_grip, covariance_of(settings)
    return Calibrated(
        str(file.path), "a robot's hand/eye calibration", cam_T_grip=Transform(told.translation_m, told.rotation_xyzw),
        covariance=covariance, frame=file.frame, pose_notes=tuple(_uncertainty(covariance)),
    )  # fmt: skip


def _state(path: Path, data: bytes) -> Calibrated:
    try:
        kept = unpack(data)
    except ValueError as error:
        raise InputError(f"{path}: {error}; {_RIGHT}") from None
    reference = kept.state.references[-1]
    which = f"the reference in force of {kept.owner.robot}/{kept.owner.camera}: {reference.reference_id}"
    return Calibrated(
        str(path),
        "a monitor's state",
        cam_T_grip=reference.cam_T_grip,
        covariance=reference.covariance,
        pose_notes=(f"{which}, revision {reference.revision}, {reference.origin}", *_uncertainty(reference.covariance)),
    )


def _estimates(path: Path, data: bytes) -> Calibrated:
    """The last line with a valid transform; a daemon that was killed, or that writes just now, leaves a part of one."""
    decoder = msgspec.json.Decoder(FrameRecord)
    lines, left_out = data.splitlines(), list[str]()
    for number in range(len(lines), 0, -1):
        if not lines[number - 1].strip():
            continue
        try:
            record = decoder.decode(lines[number - 1])
        except (msgspec.MsgspecError, UnicodeDecodeError) as error:
            if 1 < number == len(lines) and not data.endswith(b"\n"):
                left_out.append(f"line {number} is unfinished, and left out")
                continue
            raise InputError(f"{path}: line {number}: isn't an estimate ({error}); {_RIGHT}") from None
        if record.verdict == "valid" and record.cam_T_grip is not None and record.covariance is not None:
            return Calibrated(
                str(path),
                "estimates",
                cam_T_grip=record.cam_T_grip,
                covariance=record.covariance,
                jaw_opening_m=record.jaw_opening_m,
                pose_notes=(
                    f"the estimate of frame {record.seq} (line {number})", *left_out, *_uncertainty(record.covariance)
                ),
            )
    raise InputError(f"{path}: no line has a valid transform; {_RIGHT}")


def _origin(provenance: Provenance) -> tuple[str, ...]:
    return (f"calibrated {provenance.time} with gripmon {provenance.gripmon}: {provenance.command}",)


def _uncertainty(covariance: tuple[float, ...]) -> list[str]:
    sigma = [math.sqrt(max(covariance[7 * i], 0.0)) for i in range(6)]
    if not any(sigma):
        return []
    mm = ", ".join(in_mm(s) for s in sigma[:3])
    degrees = ", ".join(in_degrees(s) for s in sigma[3:])
    return [f"one standard deviation along and about the camera's x, y, z: {mm} mm (TCP), {degrees} degrees"]


def camera_in(file: Path | GivenFile) -> GivenCamera:
    """The camera in a file, with its covariance if the file has one.  :class:`~gripmon.model.errors.InputError`."""
    found = read_calibrated(file)
    path = found.name
    if found.lens is None:
        raise InputError(f"{path}: holds no camera; a file of gripmon calibrate intrinsics", "camera")
    try:
        make_camera(found.lens)
    except ValueError as error:
        raise InputError(f"{path}: camera.{error}") from None
    count = len(found.parameters)
    covariance = np.reshape(found.lens_covariance, (count, count)) if count else None
    return GivenCamera(found.lens, found.parameters, covariance, found.target)


def pose_in(path: Path) -> tuple[Array, Array]:
    """``cam_T_grip`` (4, 4) in a file, and the covariance (6, 6) of its error.
    :class:`~gripmon.model.errors.InputError`.
    """
    return pose_of(read_calibrated(path))


def pose_of(found: Calibrated) -> tuple[Array, Array]:
    """``cam_T_grip`` (4, 4) of a calibration, at the TCP, and the covariance (6, 6) of its error.
    :class:`~gripmon.model.errors.InputError`.
    """
    if found.cam_T_grip is None:
        raise InputError(
            f"{found.name}: holds no cam_T_grip; a file of gripmon calibrate plane, a configuration, or cam_T_grip "
            "with position_sigma_m and rotation_sigma_rad",
            "reference",
        )
    if found.frame:
        raise tcp_unknown(Path(found.name), found.frame)
    return from_record(found.cam_T_grip), np.reshape(found.covariance, (6, 6))


def view_in(
    camera: Path | None, reference: Path | None, rough: tuple[float, float] | None
) -> tuple[Camera | None, Array | None]:
    """A camera and ``cam_T_grip`` (4, 4), None if not given; a reference's file may also hold its camera.

    ``rough``: distance (m) of the TCP, which is in the middle of the image, and tilt of the optical axis from the
    gripper's z axis (degrees).  :class:`~gripmon.model.errors.InputError` for files without a camera or a pose.
    """
    given = None if reference is None else read_calibrated(reference)
    cam_T_grip = None if given is None else pose_of(given)[0]
    lens = None if camera is None else camera_in(camera).lens
    if lens is None and given is not None:
        lens = given.lens
    if rough is None:
        return None if lens is None else make_camera(lens), cam_T_grip
    if lens is None:
        raise InputError("is missing: a rough view needs one; a file of gripmon calibrate intrinsics", "camera")
    made = make_camera(lens)
    middle = 0.5 * (made.width_px - 1.0), 0.5 * (made.height_px - 1.0)
    return made, Mount(rough[0], math.radians(rough[1]), 0.0, 0.0).pose(towards(made, middle))


def read_rough_corners(path: Path, gripper: Gripper | None) -> dict[str, tuple[float, float]]:
    """Rough corners of a gripper (None: an unknown one).  :class:`~gripmon.model.errors.InputError`."""
    given = read_settings(path, RoughCorners)
    rough = given.corners if gripper is None else given.of(gripper)
    try:
        if gripper is None:
            outlines_of(rough)
        else:
            check_rough(gripper, rough)
    except CalibrationError as error:
        raise InputError(f"{path}: {error}") from None
    return rough


def write_document(document: msgspec.Struct | dict[str, Any], path: Path) -> None:
    """Write a calibration as YAML, whole or not at all.  OSError if it can't be written."""
    write_atomically(path, as_yaml(msgspec.to_builtins(document)).encode())


@dataclass(frozen=True)
class PlaneInputs:
    """The inputs of :func:`gripmon.calibrate_plane` besides images and target; ``notes``: assumptions; ``files``: the
    files that were read; ``response``: of the camera, auto if no configuration says it.
    """

    camera: GivenCamera
    gripper: Gripper | None
    corners: list[dict[str, tuple[float, float]]]
    jaw_opening_m: float | None
    cam_T_grip: Array | None
    notes: tuple[str, ...]
    files: tuple[Path, ...]
    response: str


def plane_inputs(
    camera: Path | None,
    gripper: Path | None,
    config: Path | None,
    corners: Sequence[Path],
    jaw_opening_m: float | None,
    *,
    infer: bool,
) -> PlaneInputs:
    """Read the files; a configuration supplies camera, gripper, jaw opening and rough calibration if they are not
    given. ``infer``: the gripper is unknown.  :class:`~gripmon.model.errors.InputError`.
    """
    files = [path for path in (camera, config, gripper, *corners) if path is not None]
    loaded = None if config is None else load_config(config, check_source=False, with_taught=False)
    if loaded is not None:
        files += [loaded.gripper_path, *loaded.calibrated.paths.values()]
        camera = camera or loaded.calibrated.paths.get("camera")
    known = None if loaded is None or infer else loaded.gripper
    if gripper is not None:
        known = read_gripper(gripper)
    notes: tuple[str, ...] = ()
    if jaw_opening_m is None and known is not None and loaded is not None and known.has_jaw:
        jaw_opening_m = loaded.jaw_opening_m
        notes = (f"jaw opening assumed to be {jaw_opening_m:g} m; --jaw-opening M if it was another",)
    given = None if camera is None else camera_in(camera)
    if given is None:
        assert loaded is not None, "the caller asks for a camera"
        given = GivenCamera(loaded.settings.camera)
    return PlaneInputs(
        given,
        known,
        [read_rough_corners(path, known) for path in corners],
        None if infer else jaw_opening_m,
        None if loaded is None or infer else loaded.cam_T_grip,
        notes,
        tuple(files),
        "auto" if loaded is None else said_response(loaded),
    )


def said_response(config: Config) -> str:
    """How grey levels follow the light by a configuration or what it was taught with; auto if neither says it."""
    return config.settings.monitor.corners.edges.response if config.knows_response else "auto"


def measure_again(
    first: Calibrated,
    images: Sequence[str],
    config_file: Path | None,
    target: Target | None = None,
    *,
    other_target: bool = False,
    jaw_opening_m: float | None = None,
) -> tuple[Calibrated, tuple[str, ...]]:
    """The hand/eye calibration from images (files, folders), to compare with the ``first`` one: on the plate if there
    is a ``target``, otherwise as the configuration's monitor measures it.  And warnings about it.
    ``other_target``: the target may have the pattern of the calibrations' target in another size.
    """
    config = _same_config(first, config_file)
    if target is not None and not other_target:
        named = (read_calibrated(path) for path in reversed(config.calibrated.paths.values()))  # the reference first
        made = next((each for each in (first, *named) if each.target is not None), first)
        refuse_other_size(target, made.target, f"{made.name} was made with")
    opening_m = _opening(first, config, jaw_opening_m)
    paths = image_paths(images)
    expected = pose_of(first)
    lens = config.settings.camera
    if target is None:
        (cam_T_grip, covariance), doubts = measure_tracked(
            paths, lens, config.gripper, expected, config.settings.monitor,
            jaw_opening_m=opening_m, taught_edges=config.taught_edges,
        )  # fmt: skip
    else:
        found = calibrate_plane(
            paths, lens, config.gripper, target, jaw_opening_m=opening_m, cam_T_grip=expected[0],
            response=said_response(config),
        )  # fmt: skip
        if found.not_used:
            raise CalibrationError(found.not_used[0])
        cam_T_grip, covariance, doubts = found.cam_T_grip, found.covariance, found.fit.warnings
    flat = tuple(covariance.ravel().tolist())
    return Calibrated(str(paths[0]), "images", lens, cam_T_grip=to_record(cam_T_grip), covariance=flat), doubts


def _same_config(first: Calibrated, file: Path | None) -> Config:
    """The configuration, which must be of the same camera and gripper."""
    if file is None:
        raise InputError("is missing; with images, the configuration with gripper and monitor", "config")
    if first.cam_T_grip is None:
        raise InputError(f"{first.name}: is {first.kind}; with images, a hand/eye calibration")
    config = load_config(file, check_source=False)
    if fault := mismatch(first.lens, first.gripper, config.settings.camera, config.gripper):
        raise ConfigError.of(Path(first.name), fault)
    return config


def _opening(first: Calibrated, config: Config, given_m: float | None) -> float | None:
    known = (given_m, first.jaw_opening_m, config.jaw_opening_m) if config.gripper.has_jaw else (given_m,)
    return checked_opening(config.gripper, next((opening_m for opening_m in known if opening_m is not None), None))
