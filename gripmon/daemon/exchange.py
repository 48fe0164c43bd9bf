"""Calibrations of other programs, and for them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from gripmon.calibrate.camera_files import LensModel
from gripmon.calibrate.camera_files import read_camera as read_foreign_camera
from gripmon.calibrate.documents import CameraCalibration
from gripmon.calibrate.hand_eye_files import HandEye, write_hand_eye
from gripmon.calibrate.hand_eye_formats import read_hand_eye
from gripmon.calibrate.interchange import FORMATS, Exported, write_camera
from gripmon.calibrate.verify import Calibrated
from gripmon.daemon.calibrations import given_file, read_calibrated
from gripmon.daemon.config.robot_file import TCP, RobotFile
from gripmon.model.errors import InputError
from gripmon.model.geometry import invert
from gripmon.model.provenance import provenance_of
from gripmon.model.yaml_text import as_yaml


def import_calibration(
    path: Path,
    command: str,
    *,
    which: str | None = None,
    size_px: tuple[int, int] | None = None,
    model: LensModel | None = None,
) -> tuple[CameraCalibration | bytes, list[str]]:
    """What another program's file holds, for a file of gripmon's, and lines that say what it is: a camera, or the text
    of a hand/eye transform.  Options as in :func:`~gripmon.calibrate.camera_files.read_camera`, ``which`` also of a
    hand/eye transform's frames; ``command`` is for the provenance.  :class:`~gripmon.model.errors.InputError`.
    """
    file = given_file(path)
    if file.own or file.lens is not None:
        raise InputError(f"{path}: is a file of gripmon's, which its commands take as it is; another program's")
    made = provenance_of(command, [file.input])
    hand_eye = read_hand_eye(file.document, which=which)
    if hand_eye is not None:
        if size_px is not None or model is not None:
            raise InputError(f"{path}: is a hand/eye transform ({hand_eye.kind}); without --size and --model")
        robot = RobotFile.foreign(path, hand_eye)
        origin = f"{hand_eye.kind}: {hand_eye.gripper_frame} to {hand_eye.camera_frame}"
        notes = [f"{origin}, from {path.name}, SHA-256 {made.inputs[0].sha256}", f"written {made.time}: {made.command}"]
        x, y, z = (1e3 * invert(hand_eye.grip_T_cam)[:3, 3]).tolist()
        lines = [origin, f"{hand_eye.gripper_frame} is at {x:.1f}, {y:.1f}, {z:.1f} mm in the camera frame"]
        if hand_eye.at_tcp:
            robot.reference()  # whole: nothing is to be completed
        else:
            tcp = f"flange_T_tcp is to be filled in: where {TCP} is in {hand_eye.gripper_frame}"
            example = "translation_m: [0.0, 0.0, 0.2], rotation_xyzw: [0.0, 0.0, 0.0, 1.0]"
            notes, lines = [*notes, f"{tcp}, for example {{{example}}}"], [*lines, tcp]
        if hand_eye.doubt:
            notes, lines = [*notes, hand_eye.doubt], [*lines, f"warning: {hand_eye.doubt}"]
        text = "".join(f"# {note}\n" for note in notes) + as_yaml(robot.values, inline=True)
        return text.encode(), lines
    found = read_foreign_camera(file.document, which=which, size_px=size_px, model=model)
    camera, lens = found.camera, found.camera.__struct_config__.tag
    lines = [f"{found.kind}: {lens}, {camera.width_px} x {camera.height_px} px, focal length {camera.fx_px:.6g} px"]
    unknown = f"imported from {found.kind}: its uncertainty is unknown"
    calibration = CameraCalibration(
        camera=camera, parameters=(), covariance=(), warnings=(unknown, *found.warnings), provenance=made
    )
    return calibration, [*lines, *(f"warning: {warning}" for warning in found.warnings)]


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
    :func:`~gripmon.calibrate.interchange.write_camera` and :class:`~gripmon.calibrate.hand_eye_files.HandEye`, whose
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
    names = {**({"gripper_frame": source.frame} if source.frame else {}), **(frames or {})}
    hand_eye = HandEye(
        source.cam_T_grip, source.covariance, gripper_in_camera=gripper_in_camera, at_tcp=not source.frame, name=name,
        **names,
    )  # fmt: skip
    return Exported(write_hand_eye(hand_eye, kind, (*_notes(source, command), *source.pose_notes)).encode())


def _notes(source: Calibrated, command: str) -> tuple[str, ...]:
    """Where a file for another program comes from."""
    made = provenance_of(command, [Path(source.name)])
    written = f"written {made.time} by gripmon {made.gripmon}: {made.command}"
    return written, f"from {source.name}, SHA-256 {made.inputs[0].sha256}", *source.notes
