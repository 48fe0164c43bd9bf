"""What teaching from corners begins with: camera, gripper, reference and images, each checked.

Everything here raises :class:`~gripmon.model.errors.InputError` for what can't be used.
"""

from __future__ import annotations

import contextlib
import hashlib
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from gripmon.daemon.config import Config, ConfigError, load_config, read_gripper
from gripmon.daemon.config.calibrated import mismatch, read_camera, read_hand_eye
from gripmon.daemon.config.checks import covariance_of, predict_view, reference_transform, view_fault
from gripmon.daemon.config.settings import ReferenceSettings, TransformSettings
from gripmon.daemon.config.typed import Fault, SettingsError, to_settings
from gripmon.daemon.config.yaml_file import read_yaml
from gripmon.io.sources import FolderSettings, LiveSettings
from gripmon.model.camera import Camera, LensSettings, make_camera
from gripmon.model.errors import InputError
from gripmon.model.gripper import Gripper
from gripmon.model.records import ReferenceRecord, to_json
from gripmon.monitor import MonitorSettings
from gripmon.teach.api import Picture, read_any, read_picture
from gripmon.teach.corner_pose import CameraError, corners_fault
from gripmon.teach.outlines import RoughCorners
from gripmon.teach.page_server import OutlineSession
from gripmon.teach.session import Setup

ROBOT, CAMERA_NAME, ROUGH = "robot1", "wrist", "rough.yaml"


@dataclass(frozen=True)
class Named:
    """What a person names: files, and what is to stand in the configuration.  Either ``config``, or ``gripper`` with
    ``camera`` or ``reference``.  ``command`` goes into the files' provenance; ``live`` is a camera instead of images.
    """

    command: str
    images: Sequence[Path]
    out: Path | None = None
    config: Path | None = None
    camera: Path | None = None
    gripper: Path | None = None
    reference: Path | None = None
    live: str | None = None
    jaw_opening_m: float | None = None
    jaw_source: str | None = None
    robot: str | None = None
    camera_name: str | None = None


@dataclass(frozen=True)
class Inputs:
    """Everything but the corners.  ``folder`` is where files go; ``config`` what was given, if it was; ``calibrations``
    the files of ``gripmon calibrate`` that a configuration names in place of sections, by key.
    """

    setup: Setup
    pictures: tuple[Picture, ...]
    gripper_path: Path
    folder: Path
    source: FolderSettings | LiveSettings | None
    config: Config | None
    robot: str
    camera_name: str
    command: str
    live: str | None
    calibrations: dict[str, Path]
    jaw_source: str | None = None


def read_inputs(named: Named) -> Inputs:
    """Read and check what is named.  The folder to write to is made where it is missing."""
    cv2.setNumThreads(1)
    config, opening_m = None, named.jaw_opening_m
    if named.config is not None:
        config = load_config(named.config, check_source=False, with_taught=False)
        setup = Setup(config.camera, config.gripper, config.settings.monitor, config.reference)
        gripper_path = config.gripper_path
        if opening_m is None and config.settings.jaw.source == "fixed":
            opening_m = config.jaw_opening_m
    else:
        gripper, gripper_path = _gripper(named.gripper)
        camera, error, reference = _calibrations(named, gripper)
        setup = Setup(camera, gripper, MonitorSettings(), reference, error)
    if named.jaw_source is not None and not setup.gripper.has_jaw:
        raise InputError("--jaw-source: the gripper has no jaw; leave it out")
    depth = setup.settings.bit_depth
    pictures = tuple(read_picture(path, setup.camera, setup.gripper, depth, opening_m) for path in named.images)
    folder = named.out or (Path() if config is None else config.directory)
    calibrations = {"camera": named.camera, "reference": named.reference}
    return Inputs(
        setup=setup,
        pictures=pictures,
        gripper_path=gripper_path,
        folder=folder,
        source=None if config is not None else _source(named, setup.camera),
        config=config,
        robot=config.settings.robot if config is not None else named.robot or ROBOT,
        camera_name=config.settings.camera_name if config is not None else named.camera_name or CAMERA_NAME,
        command=named.command,
        live=named.live,
        calibrations={key: path for key, path in calibrations.items() if path and "schema" in read_yaml(path)},
        jaw_source=named.jaw_source,
    )


def read_rough(path: Path, gripper: Gripper) -> dict[str, tuple[float, float]]:
    """The corners in a file (px)."""
    with _faults_of(path):
        rough = to_settings(read_yaml(path), RoughCorners)
    # The file may be the one of calibrate plane --infer, which also names points on edges: they are no corners.
    corners = {n: at for n, at in rough.corners.items() if n in gripper.corner_ids or n not in gripper.point_ids}
    fault = corners_fault(corners, gripper)
    if fault is not None:
        raise InputError(f"{path}: {fault[0]}: {fault[1]}; {fault[2]}")
    return corners


def outline_session(image: Path, camera: Path | None, folder: Path) -> OutlineSession:
    """A page without a gripper: rough corners for ``gripmon calibrate plane --infer``, to be saved in ``folder``."""
    shown, target = read_any(image), None
    if camera is not None:
        with contextlib.suppress(ConfigError):  # reading the camera says what is wrong
            target = read_yaml(camera).get("target")
        lens, _ = _read_lens(camera)
        height, width = shown.shape[:2]
        if (width, height) != (lens.width_px, lens.height_px):
            wrong = f"{width} x {height} px; the camera's {lens.width_px} x {lens.height_px} px, as it was calibrated"
            raise InputError(f"{image}: {wrong}")
    known = isinstance(target, str)
    words = ["gripmon", "calibrate", "plane", image, "--camera", camera or "camera.yaml"]
    words += ["--target", camera if known else "TARGET", "--infer", "--corners", folder / ROUGH]
    words += ["--gripper-out", folder / "gripper.yaml", "--out", folder / "hand_eye.yaml"]
    plate = (
        f"the plate is taken to be the camera's target, {target}; of another one --target says what it is"
        if known
        else "TARGET is the plate, such as circles:12x10:0.008:0.004"
    )
    note = f"{plate}; with jaws that move also --jaw-range MIN:MAX (m)"
    picture = Picture(image.name, shown, None, str(image))
    return OutlineSession(picture, folder / ROUGH, shlex.join(map(str, words)), note)


def _gripper(path: Path | None) -> tuple[Gripper, Path]:
    if path is None:
        raise InputError("teach: no gripper; --gripper FILE, one of configs/grippers or your own, or --config")
    if not path.is_file():
        raise InputError(f"--gripper {path}: there is no such file; a gripper file such as those in configs/grippers")
    return read_gripper(path), path


def _calibrations(named: Named, gripper: Gripper) -> tuple[Camera, CameraError | None, ReferenceRecord | None]:
    """Camera and reference from their files; a reference's file holds its camera, too."""
    lens, error = (None, None) if named.camera is None else _read_lens(named.camera)
    reference = None
    if named.reference is not None:
        lens, reference = _hand_eye(named.reference, lens, gripper)
    if lens is None:
        raise InputError("teach: no camera; --camera FILE (of gripmon calibrate intrinsics), or --config")
    try:
        camera = make_camera(lens)
    except ValueError as fault:
        raise InputError(f"{named.camera or named.reference}: camera.{fault}") from None
    if reference is not None:
        _check_view(camera, gripper, reference, f"--reference {named.reference}")
    return camera, error, reference


def _read_lens(path: Path) -> tuple[LensSettings, CameraError | None]:
    """A camera's file: of ``gripmon calibrate intrinsics``, or the section of a configuration by itself."""
    with _faults_of(path):
        values = read_yaml(path)
        if "model" in values and "schema" not in values:
            lens: LensSettings = to_settings(values, LensSettings)  # type: ignore[arg-type]
            return lens, None
        made = read_camera(path)
    if not made.parameters:
        return made.camera, None
    count = len(made.parameters)
    return made.camera, CameraError(made.parameters, np.reshape(made.covariance, (count, count)))


def _hand_eye(path: Path, lens: LensSettings | None, gripper: Gripper) -> tuple[LensSettings, ReferenceRecord]:
    """A file of ``gripmon calibrate plane``, made with this camera, if one was given, and this gripper."""
    made = read_hand_eye(path)
    fault = mismatch(made, lens or made.camera, gripper)
    if fault is not None:
        wrong = fault.wrong.replace("the configuration's camera", "--camera")
        wrong = wrong.replace("the configuration has", "--gripper is")
        raise InputError(f"--reference {path}: {fault.key}: {wrong}; {fault.right}")
    digest = hashlib.sha256(to_json(made.cam_T_grip)).hexdigest()[:8]
    name = f"config-{digest}"  # as the configuration that names the file will call it
    return made.camera, ReferenceRecord(name, 0, 0, "configuration", made.cam_T_grip, tuple(made.covariance))


def _check_view(camera: Camera, gripper: Gripper, reference: ReferenceRecord, name: str) -> None:
    """Whether this reference sees this gripper."""
    transform = reference.cam_T_grip
    settings = ReferenceSettings(
        cam_T_grip=TransformSettings(translation_m=transform.translation_m, rotation_xyzw=transform.rotation_xyzw),
        covariance=reference.covariance,
    )
    pose, covariance = reference_transform(settings), covariance_of(settings)
    fault = pose if isinstance(pose, Fault) else covariance if isinstance(covariance, Fault) else None
    if fault is None and not isinstance(pose, Fault):
        fault = view_fault(predict_view(camera, gripper, pose, None), gripper, camera)
    if fault is not None:
        raise InputError(f"{name}: {fault.key.removeprefix('reference.')}: {fault.wrong}; {fault.right}")


@contextlib.contextmanager
def _faults_of(path: Path) -> Iterator[None]:
    """What is wrong with a file's contents is an :class:`InputError` that names the file."""
    try:
        yield
    except SettingsError as error:
        raise InputError(f"{path}: {error}") from None


def live_settings(device: str, camera: Camera) -> LiveSettings:
    """A camera that is asked for images of the calibration's size."""
    where = int(device) if device.isdecimal() else device
    return LiveSettings(device=where, width_px=camera.width_px, height_px=camera.height_px)


def _source(named: Named, camera: Camera) -> FolderSettings | LiveSettings:
    """Where the monitor will find its frames: the live camera, or the images' folder."""
    if named.live is not None:
        return live_settings(named.live, camera)
    return FolderSettings(path=str(named.images[0].parent))
