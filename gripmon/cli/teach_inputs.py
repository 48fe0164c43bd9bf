"""What teaching from corners begins with: camera, gripper, reference and images, each checked."""

from __future__ import annotations

import argparse
import contextlib
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from gripmon.cli import common

if TYPE_CHECKING:
    from gripmon.daemon.config import Config
    from gripmon.io.sources import FolderSettings, LiveSettings
    from gripmon.model.camera import Camera, LensSettings
    from gripmon.model.gripper import Gripper
    from gripmon.model.records import Image, ReferenceRecord
    from gripmon.teach.edges.bench import Bench
    from gripmon.teach.edges.corner_pose import CameraError
    from gripmon.teach.page import Picture

ROBOT, CAMERA_NAME = "robot1", "wrist"


@dataclass(frozen=True)
class Inputs:
    """Everything but the corners.  ``folder`` is where files go; ``config`` what was given, if it was."""

    bench: Bench
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


def read_inputs(arguments: argparse.Namespace) -> Inputs:
    """What the command line names; a fault ends the command with exit code 2."""
    import cv2

    from gripmon.monitor import MonitorSettings
    from gripmon.teach.edges.bench import Bench

    cv2.setNumThreads(1)
    config = None
    if arguments.config is not None:
        config = common.load(arguments.config, check_source=False, with_taught=False)
        bench = Bench(config.camera, config.gripper, config.settings.monitor, config.reference)
        gripper_path = config.gripper_path
    else:
        gripper, gripper_path = _gripper(arguments.gripper)
        camera, error, reference = _calibrations(arguments, gripper)
        bench = Bench(camera, gripper, MonitorSettings(), reference, error)
    if arguments.jaw_source is not None and not bench.gripper.has_jaw:
        raise common.CommandFailedError("--jaw-source: the gripper has no jaw; leave it out", common.EXIT_USAGE)
    pictures = tuple(_picture(Path(name), bench, config, arguments.jaw_opening) for name in arguments.images)
    folder = Path(arguments.out) if arguments.out else config.directory if config is not None else Path()
    common.make_directory(folder)
    return Inputs(
        bench=bench,
        pictures=pictures,
        gripper_path=gripper_path,
        folder=folder,
        source=None if config is not None else _source(arguments, bench.camera),
        config=config,
        robot=config.settings.robot if config is not None else arguments.robot or ROBOT,
        camera_name=config.settings.camera_name if config is not None else arguments.camera_name or CAMERA_NAME,
        command=_command(arguments),
        live=arguments.live,
        calibrations=_named(arguments),
        jaw_source=arguments.jaw_source,
    )


def read_rough(path: Path, gripper: Gripper) -> dict[str, tuple[float, float]]:
    """The corners in a file; a fault ends the command with exit code 2."""
    from gripmon.daemon.config.typed import to_settings
    from gripmon.teach.edges.bench import rough_fault
    from gripmon.teach.onboarding.rough import RoughCorners

    with _faults_of(path):
        rough = to_settings(_yaml(path), RoughCorners)
    # The file may be the one of calibrate plane --infer, which also names points on edges: they are no corners.
    corners = {n: at for n, at in rough.corners.items() if n in gripper.corner_ids or n not in gripper.point_ids}
    fault = rough_fault(corners, gripper)
    if fault is not None:
        raise common.CommandFailedError(f"{path}: {fault[0]}: {fault[1]}; {fault[2]}", common.EXIT_USAGE)
    return corners


def _gripper(name: str | None) -> tuple[Gripper, Path]:
    from gripmon.daemon.config import read_gripper

    if name is None:
        raise common.CommandFailedError(
            "teach: no gripper; --gripper FILE, one of configs/grippers or your own, or --config", common.EXIT_USAGE
        )
    path = Path(name)
    if not path.is_file():
        raise common.CommandFailedError(
            f"--gripper {path}: there is no such file; a gripper file such as those in configs/grippers",
            common.EXIT_USAGE,
        )
    with _faults_of(path):
        return read_gripper(path), path


def _calibrations(
    arguments: argparse.Namespace, gripper: Gripper
) -> tuple[Camera, CameraError | None, ReferenceRecord | None]:
    """Camera and reference from their files; a reference's file holds its camera, too."""
    from gripmon.model.camera import make_camera

    lens, error = (None, None) if arguments.camera is None else read_lens(Path(arguments.camera))
    reference = None
    if arguments.reference is not None:
        lens, reference = _hand_eye(Path(arguments.reference), lens, gripper)
    if lens is None:
        raise common.CommandFailedError(
            "teach: no camera; --camera FILE (of gripmon calibrate intrinsics), or --config", common.EXIT_USAGE
        )
    try:
        camera = make_camera(lens)
    except ValueError as fault:
        raise common.CommandFailedError(
            f"{arguments.camera or arguments.reference}: camera.{fault}", common.EXIT_USAGE
        ) from None
    if reference is not None:
        _check_view(camera, gripper, reference, arguments.reference)
    return camera, error, reference


def _named(arguments: argparse.Namespace) -> dict[str, Path]:
    """Files of ``gripmon calibrate``, which a configuration names in place of sections, by key."""
    given = {"camera": arguments.camera, "reference": arguments.reference}
    paths = {key: Path(name) for key, name in given.items() if name is not None}
    return {key: path for key, path in paths.items() if "schema" in _yaml(path)}


def read_lens(path: Path) -> tuple[LensSettings, CameraError | None]:
    """A camera's file: of ``gripmon calibrate intrinsics``, or the section of a configuration by itself."""
    import numpy as np

    from gripmon.daemon.config.calibrated import read_camera
    from gripmon.daemon.config.typed import to_settings
    from gripmon.model.camera import LensSettings
    from gripmon.teach.edges.corner_pose import CameraError

    with _faults_of(path):
        values = _yaml(path)
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
    import hashlib

    from gripmon.daemon.config.calibrated import mismatch, read_hand_eye
    from gripmon.model.records import ReferenceRecord, to_json

    with _faults_of(path):
        made = read_hand_eye(path)
    fault = mismatch(made, lens or made.camera, gripper)
    if fault is not None:
        wrong = fault.wrong.replace("the configuration's camera", "--camera")
        wrong = wrong.replace("the configuration has", "--gripper is")
        raise common.CommandFailedError(f"--reference {path}: {fault.key}: {wrong}; {fault.right}", common.EXIT_USAGE)
    digest = hashlib.sha256(to_json(made.cam_T_grip)).hexdigest()[:8]
    name = f"config-{digest}"  # as the configuration that names the file will call it
    return made.camera, ReferenceRecord(name, 0, 0, "configuration", made.cam_T_grip, tuple(made.covariance))


def _check_view(camera: Camera, gripper: Gripper, reference: ReferenceRecord, name: str) -> None:
    """End the command if this reference doesn't see this gripper."""
    from gripmon.daemon.config.checks import covariance_of, predict_view, reference_transform, view_fault
    from gripmon.daemon.config.settings import ReferenceSettings, TransformSettings
    from gripmon.daemon.config.typed import Fault

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
        key = fault.key.removeprefix("reference.")
        raise common.CommandFailedError(f"--reference {name}: {key}: {fault.wrong}; {fault.right}", common.EXIT_USAGE)


def _yaml(path: Path) -> dict[str, object]:
    from gripmon.daemon.config.yaml_file import read_yaml

    return read_yaml(path)


@contextlib.contextmanager
def _faults_of(path: Path) -> Iterator[None]:
    """What is wrong with a file's contents ends the command with exit code 2."""
    from gripmon.daemon.config import ConfigError
    from gripmon.daemon.config.typed import SettingsError

    try:
        yield
    except ConfigError as error:
        raise common.CommandFailedError(str(error), common.EXIT_USAGE) from None
    except SettingsError as error:
        raise common.CommandFailedError(f"{path}: {error}", common.EXIT_USAGE) from None


def read_fitting_image(path: Path, camera: Camera, gripper: Gripper, bit_depth: int) -> Image:
    """An image that fits the camera, in full scale; anything else ends the command with exit code 2."""
    from gripmon.io.sources.folder import read_image
    from gripmon.judge.inspection import inspect
    from gripmon.model.pixels import in_full_scale
    from gripmon.model.records import Frame

    if path.is_dir():
        raise common.CommandFailedError(f"{path}: is a folder; image files, e.g. {path}/*.png", common.EXIT_USAGE)
    image, fault = read_image(path)
    if image is None:
        raise common.CommandFailedError(f"{path}: {fault}; an image file", common.EXIT_USAGE)
    frame = in_full_scale(Frame(0, 0, image, None, str(path)), bit_depth)
    refused = inspect(frame, camera, gripper)
    if refused is not None or frame.image is None:
        kind, why = refused or (frame.refusal, frame.fault)
        raise common.CommandFailedError(f"{path}: {kind}: {why}", common.EXIT_USAGE)
    return frame.image


def _picture(path: Path, bench: Bench, config: Config | None, given_m: float | None) -> Picture:
    """An image that fits the camera; else the command ends with exit code 2."""
    from gripmon.teach.page import Picture

    image = read_fitting_image(path, bench.camera, bench.gripper, bench.settings.bit_depth)
    return Picture(path.name, image, read_opening(path, bench.gripper, config, given_m), str(path))


def read_opening(path: Path, gripper: Gripper, config: Config | None, given_m: float | None) -> float | None:
    """What is known of the jaw opening in an image: given, in its folder's table, or fixed in the configuration; None
    if nothing is.
    """
    from gripmon.io.sources import SourceError
    from gripmon.io.sources.folder import TIMESTAMPS_NAME, read_table

    if not gripper.has_jaw:
        if given_m is not None:
            raise common.CommandFailedError("--jaw-opening: the gripper has no jaw; leave it out", common.EXIT_USAGE)
        return None
    opening_m, table = given_m, path.parent / TIMESTAMPS_NAME
    if opening_m is None and config is not None and config.settings.jaw.source == "fixed":
        opening_m = config.jaw_opening_m
    if opening_m is None and table.exists():
        try:
            row = read_table(table).get(path.name)
        except SourceError as error:
            raise common.CommandFailedError(str(error), common.EXIT_USAGE) from None
        opening_m = None if row is None else row.jaw_opening_m
    if opening_m is not None and not gripper.jaw_min_m <= opening_m <= gripper.jaw_max_m:
        raise common.CommandFailedError(
            f"{path}: jaw opening {opening_m:g} m; the gripper's {gripper.jaw_min_m:g} to {gripper.jaw_max_m:g} m",
            common.EXIT_USAGE,
        )
    return opening_m


def live_settings(device: str, camera: Camera) -> LiveSettings:
    """A camera that is asked for images of the calibration's size."""
    from gripmon.io.sources import LiveSettings

    named = int(device) if device.isdecimal() else device
    return LiveSettings(device=named, width_px=camera.width_px, height_px=camera.height_px)


def _source(arguments: argparse.Namespace, camera: Camera) -> FolderSettings | LiveSettings:
    """Where the monitor will find its frames: the live camera, or the images' folder."""
    from gripmon.io.sources import FolderSettings

    if arguments.live is not None:
        return live_settings(arguments.live, camera)
    return FolderSettings(path=str(Path(arguments.images[0]).parent))


def _command(arguments: argparse.Namespace) -> str:
    words = ["gripmon", "teach", *(["--page"] if arguments.page else []), *arguments.images]
    for name in ("live", "corners", "config", "camera", "gripper", "reference", "out", "jaw_opening", "jaw_source"):
        value = getattr(arguments, name)
        words += [] if value is None else [f"--{name.replace('_', '-')}", str(value)]
    return shlex.join(words)
