"""Calibrations as ``gripmon calibrate export`` and ``verify`` take them: from a calibration's file, a configuration, a
monitor's state or its estimates.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from gripmon.cli import common

if TYPE_CHECKING:
    from gripmon.calibrate.documents import CalibratedGripper
    from gripmon.model.camera import LensSettings
    from gripmon.model.provenance import Provenance
    from gripmon.model.records import Transform

_RIGHT = "a file of gripmon calibrate, a configuration, a monitor's state or its estimates (JSON lines)"
_LARGEST_BYTES = 1 << 30


@dataclass(frozen=True, slots=True)
class Calibrated:
    """What a file says: a ``lens`` with the covariance of its ``parameters``, a ``cam_T_grip`` with ``covariance``
    (36), or both; ``kind`` is what the file is, ``notes`` where it comes from, for people, ``pose_notes`` more about
    the transform.
    """

    path: Path
    kind: str
    lens: LensSettings | None = None
    parameters: tuple[str, ...] = ()
    lens_covariance: tuple[float, ...] = ()
    cam_T_grip: Transform | None = None
    covariance: tuple[float, ...] = ()
    gripper: CalibratedGripper | None = None
    jaw_opening_m: float | None = None
    notes: tuple[str, ...] = ()
    pose_notes: tuple[str, ...] = ()


def read_calibrated(path: Path) -> Calibrated:
    """What a file says; one that says nothing ends the command with exit code 2."""
    data = read_bytes(path)
    head = data[:4096].lstrip()
    if head.startswith(b'{"sha256"'):
        return _state(path, data)
    if head.startswith(b"{") and path.suffix != ".yaml":
        return _estimates(path, data)
    from gripmon.daemon.config import ConfigError
    from gripmon.daemon.config.yaml_file import read_yaml

    try:
        values = read_yaml(path)
        return _of_yaml(path, str(values.get("schema")), values)
    except ConfigError as error:
        raise common.CommandFailedError(str(error), common.EXIT_USAGE) from None


def read_bytes(path: Path) -> bytes:
    """A file's content; a fault ends the command with exit code 2."""
    try:
        if path.is_file() and path.stat().st_size > _LARGEST_BYTES:
            raise common.CommandFailedError(f"{path}: is larger than 1 GB; {_RIGHT}", common.EXIT_USAGE)
        return path.read_bytes()
    except FileNotFoundError:
        raise common.CommandFailedError(f"{path}: there is no such file; {_RIGHT}", common.EXIT_USAGE) from None
    except OSError as error:
        raise common.CommandFailedError(
            f"{path}: can't be read ({error.strerror}); {_RIGHT}", common.EXIT_USAGE
        ) from None


def _of_yaml(path: Path, schema: str, values: dict[str, object]) -> Calibrated:
    readers: dict[str, Callable[[Path], Calibrated]] = {
        "gripmon.camera_calibration/1": _camera,
        "gripmon.hand_eye_calibration/1": _hand_eye,
    }
    if schema in readers:
        return readers[schema](path)
    if "camera" in values and "gripper" in values:
        return _configuration(path)
    raise common.CommandFailedError(f"{path}: holds no calibration; {_RIGHT}", common.EXIT_USAGE)


def _camera(path: Path) -> Calibrated:
    from gripmon.daemon.config.calibrated import read_camera

    found = read_camera(path)
    values = {**_plain(found.camera)}
    sigmas = [
        f"{name} {values[name]:.6g} ± {math.sqrt(max(found.covariance[i * (len(found.parameters) + 1)], 0.0)):.2g}"
        for i, name in enumerate(found.parameters)
    ]
    notes = [*_origin(found.provenance), *([f"one standard deviation: {', '.join(sigmas)}"] if sigmas else [])]
    if found.residuals is not None:
        notes.append(f"rms {found.residuals.rms_px:.3f} px over {found.residuals.points} points")
    return Calibrated(
        path, "a camera calibration", found.camera, found.parameters, found.covariance, notes=tuple(notes)
    )


def _plain(camera: LensSettings) -> dict[str, float]:
    """A camera's numbers by the names that its calibration gives them."""
    import msgspec

    values: dict[str, float] = {}
    for key, value in msgspec.structs.asdict(camera).items():
        values.update({f"{key}.{i}": v for i, v in enumerate(value)} if isinstance(value, tuple) else {key: value})
    return values


def _hand_eye(path: Path) -> Calibrated:
    from gripmon.daemon.config.calibrated import read_hand_eye

    found = read_hand_eye(path)
    residuals = found.residuals
    return Calibrated(
        path,
        "a hand/eye calibration",
        found.camera,
        cam_T_grip=found.cam_T_grip,
        covariance=found.covariance,
        gripper=found.gripper,
        jaw_opening_m=found.jaw_opening_m,
        notes=_origin(found.provenance),
        pose_notes=(
            *_uncertainty(found.covariance),
            f"rms {1e3 * residuals.rms_m:.4f} mm on the plate; {residuals.corners} corners, {residuals.images} images",
        ),
    )


def _configuration(path: Path) -> Calibrated:
    config = common.load(str(path), check_source=False, with_taught=False)
    reference = config.reference
    return Calibrated(
        path,
        "a configuration",
        config.settings.camera,
        cam_T_grip=reference.cam_T_grip,
        covariance=reference.covariance,
        pose_notes=(f"the configured reference {reference.reference_id}", *_uncertainty(reference.covariance)),
    )


def _state(path: Path, data: bytes) -> Calibrated:
    from gripmon.judge.statefile import unpack

    try:
        kept = unpack(data)
    except ValueError as error:
        raise common.CommandFailedError(f"{path}: {error}; {_RIGHT}", common.EXIT_USAGE) from None
    reference = kept.state.references[-1]
    said = f"the reference in force of {kept.owner.robot}/{kept.owner.camera}: {reference.reference_id}"
    return Calibrated(
        path,
        "a monitor's state",
        cam_T_grip=reference.cam_T_grip,
        covariance=reference.covariance,
        pose_notes=(f"{said}, revision {reference.revision}, {reference.origin}", *_uncertainty(reference.covariance)),
    )


def _estimates(path: Path, data: bytes) -> Calibrated:
    """The last line with a valid transform."""
    import msgspec

    from gripmon.model.records import FrameRecord

    decoder = msgspec.json.Decoder(FrameRecord)
    lines = data.splitlines()
    for number in range(len(lines), 0, -1):
        if not lines[number - 1].strip():
            continue
        try:
            record = decoder.decode(lines[number - 1])
        except (msgspec.MsgspecError, UnicodeDecodeError) as error:
            raise common.CommandFailedError(
                f"{path}: line {number}: is no estimate ({error}); {_RIGHT}", common.EXIT_USAGE
            ) from None
        if record.verdict == "valid" and record.cam_T_grip is not None and record.covariance is not None:
            return Calibrated(
                path,
                "estimates",
                cam_T_grip=record.cam_T_grip,
                covariance=record.covariance,
                jaw_opening_m=record.jaw_opening_m,
                pose_notes=(f"the estimate of frame {record.seq} (line {number})", *_uncertainty(record.covariance)),
            )
    raise common.CommandFailedError(f"{path}: no line has a valid transform; {_RIGHT}", common.EXIT_USAGE)


def _origin(provenance: Provenance) -> tuple[str, ...]:
    return (f"calibrated {provenance.time} with gripmon {provenance.gripmon}: {provenance.command}",)


def _uncertainty(covariance: tuple[float, ...]) -> list[str]:
    sigma = [math.sqrt(max(covariance[7 * i], 0.0)) for i in range(6)]
    if not any(sigma):
        return []
    mm = ", ".join(f"{1e3 * s:.2g}" for s in sigma[:3])
    degrees = ", ".join(f"{math.degrees(s):.2g}" for s in sigma[3:])
    return [f"one standard deviation along and about the camera's x, y, z: {mm} mm (TCP), {degrees} degrees"]
