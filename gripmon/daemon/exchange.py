"""Calibrations of other programs, and for them: ROS, Kalibr, OpenCV, mrcal, URDF, easy_handeye2."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from gripmon.calibrate.documents import CameraCalibration
from gripmon.calibrate.interchange import FORMATS, Exported, HandEye, format_of, write_camera, write_hand_eye
from gripmon.calibrate.interchange import read_camera as read_foreign_camera
from gripmon.calibrate.verify import Calibrated
from gripmon.daemon.calibrations import read_bytes, read_calibrated
from gripmon.model.errors import InputError
from gripmon.model.provenance import provenance_of


def import_camera(
    path: Path,
    kind: str | None,
    which: str | None,
    size_px: tuple[int, int] | None,
    fisheye: bool | None,
    command: str,
) -> tuple[str, CameraCalibration]:
    """The format of another program's file (``kind`` None: recognised by its content), and its camera.  ``command`` is
    for the provenance.  :class:`~gripmon.model.errors.InputError`.
    """
    data = read_bytes(path)
    kind = kind or format_of(data, str(path))
    return kind, CameraCalibration(
        camera=read_foreign_camera(data, str(path), kind, which, size_px, fisheye),
        parameters=(),
        covariance=(),
        warnings=(f"imported from {kind}: its uncertainty is unknown",),
        provenance=provenance_of(command, [path]),
    )


def export_calibration(
    path: Path,
    kind: str,
    command: str,
    *,
    name: str = "gripmon",
    suffix: str = "",
    fit: bool = False,
    frames: Mapping[str, str] | None = None,
    gripper_in_camera: bool = False,
) -> Exported:
    """The camera of a calibration file, or its hand/eye transform, in another program's format ``kind``: see
    :func:`~gripmon.calibrate.interchange.write_camera` and :class:`~gripmon.calibrate.interchange.HandEye`, whose
    frames have the names ``frames``.  ``command`` is for the provenance.  :class:`~gripmon.model.errors.InputError`.
    """
    source = read_calibrated(path)
    if kind in FORMATS:
        if source.lens is None:
            right = "a camera calibration, a hand/eye calibration or a configuration"
            raise InputError(f"{source.name}: is {source.kind} without a camera; {right}")
        notes = _notes(source, command)
        return write_camera(source.lens, kind, notes, name=name, file=source.name, suffix=suffix, fit=fit)
    if source.cam_T_grip is None:
        right = "a hand/eye calibration, a configuration, a monitor's state or its estimates"
        raise InputError(f"{source.name}: is {source.kind}, which has no hand/eye transform; {right}")
    hand_eye = HandEye(
        source.cam_T_grip, source.covariance, gripper_in_camera=gripper_in_camera, name=name, **(frames or {})
    )
    return Exported(write_hand_eye(hand_eye, kind, (*_notes(source, command), *source.pose_notes)).encode())


def _notes(source: Calibrated, command: str) -> tuple[str, ...]:
    """Where a file for another program comes from."""
    made = provenance_of(command, [Path(source.name)])
    written = f"written {made.time} by gripmon {made.gripmon}: {made.command}"
    return written, f"from {source.name}, SHA-256 {made.inputs[0].sha256}", *source.notes
