"""What ``gripmon calibrate plane`` works on; a fault ends the command with exit code 2."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np

from gripmon.calibrate.plane import GivenCamera
from gripmon.calibrate.sighting import CalibrationError
from gripmon.cli import calibration_files as files
from gripmon.cli import common
from gripmon.daemon.config import Config, ConfigError, read_gripper
from gripmon.daemon.config.calibrated import read_camera
from gripmon.daemon.config.typed import SettingsError, to_settings
from gripmon.daemon.config.yaml_file import read_yaml
from gripmon.model.gripper import Gripper
from gripmon.model.records import Image
from gripmon.model.targets import Target
from gripmon.teach.onboarding import KnownGripper, RoughCorners, UnknownGripper, outlines_of

Rough = Mapping[str, tuple[float, float]]


@dataclass(frozen=True, slots=True)
class Inputs:
    """All of it, checked; ``rough`` one for each image; ``files``: everything that was read, for the provenance."""

    camera: GivenCamera
    target: Target
    method: KnownGripper | UnknownGripper
    paths: list[Path]
    images: list[Image]
    rough: list[Rough | None]
    files: list[Path]
    notes: tuple[str, ...]

    @property
    def inferred(self) -> bool:
        return isinstance(self.method, UnknownGripper)


def check_options(arguments: argparse.Namespace) -> None:
    """Options that don't go together, and files that can't be written, before any work."""
    outputs = {"--out": arguments.out, "--gripper-out": arguments.gripper_out, "--picture": arguments.picture}
    if arguments.infer and arguments.gripper_out is None:
        _refuse("--infer: where to write the gripper isn't said; --gripper-out FILE.yaml")
    if arguments.infer and not arguments.corners:
        _refuse("--infer: needs rough corners; --corners FILE.yaml")
    for option, value in (("--gripper-out", arguments.gripper_out), ("--jaw-range", arguments.jaw_range)):
        if value is not None and not arguments.infer:
            _refuse(f"{option}: has no effect with a gripper that is known; --infer, or leave it out")
    if not arguments.infer and arguments.gripper is None and arguments.config is None:
        _refuse("the gripper isn't said; --gripper FILE.yaml, --config CONFIG, or --infer")
    if arguments.camera is None and arguments.config is None:
        _refuse("the camera isn't said; --camera FILE.yaml (of gripmon calibrate intrinsics), or --config CONFIG")
    if not arguments.corners and arguments.config is None:
        _refuse("nothing says where the gripper is in the image; --corners FILE.yaml, or --config CONFIG")
    given = {option: Path(value) for option, value in outputs.items() if value is not None}
    if len({path.resolve() for path in given.values()}) < len(given):
        _refuse(f"{', '.join(given)}: name the same file twice; different files")
    for option, path in given.items():
        check = files.check_picture if option == "--picture" else files.check_output
        check(path, force=arguments.force, option=option)


def read(arguments: argparse.Namespace) -> Inputs:
    """Read and check everything that the command line names."""
    config = None if arguments.config is None else common.load(arguments.config, check_source=False, with_taught=False)
    target = files.target_of(arguments.target)
    camera = _camera(arguments, config)
    method, note = _method(arguments, config, camera, target)
    paths = files.image_paths(arguments.images)
    images = files.read_images(paths)
    for path, image in zip(paths, images, strict=True):
        height, width = image.shape[:2]
        if (width, height) != (camera.lens.width_px, camera.lens.height_px):
            _refuse(
                f"{path}: {width} x {height} px; the camera's {camera.lens.width_px} x {camera.lens.height_px} px, as "
                "it was calibrated"
            )
    rough, rough_paths = _rough(arguments, len(paths), method)
    named = [arguments.camera, arguments.config, arguments.gripper, *rough_paths]
    inputs = [*paths, *(Path(name) for name in named if name is not None)]
    if config is not None:
        inputs += [config.gripper_path, *config.calibrated.paths.values()]
    notes = () if note is None else (note,)
    if not camera.parameters:
        notes = (*notes, "how certain the camera is isn't known: its errors are not in the covariance")
    return Inputs(camera, target, method, paths, images, rough, list(dict.fromkeys(inputs)), notes)


def _camera(arguments: argparse.Namespace, config: Config | None) -> GivenCamera:
    path = config.calibrated.paths.get("camera") if config is not None and arguments.camera is None else None
    path = path if arguments.camera is None else Path(arguments.camera)
    if path is None:
        assert config is not None, "check_options asks for a camera"
        return GivenCamera(config.settings.camera)
    from gripmon.model.camera import make_camera

    try:
        found = read_camera(path)
        make_camera(found.camera)
    except ConfigError as error:
        raise common.CommandFailedError(str(error), common.EXIT_USAGE) from None
    except ValueError as error:
        raise common.CommandFailedError(f"{path}: camera.{error}", common.EXIT_USAGE) from None
    count = len(found.parameters)
    return GivenCamera(found.camera, found.parameters, np.reshape(found.covariance, (count, count)))


def _method(
    arguments: argparse.Namespace, config: Config | None, camera: GivenCamera, target: Target
) -> tuple[KnownGripper | UnknownGripper, str | None]:
    """How to calibrate, and what is to be said of the jaw opening."""
    if arguments.infer:
        return UnknownGripper(camera, target), None
    gripper = _gripper(arguments, config)
    opening_m: float | None = arguments.jaw_opening
    if opening_m is not None and not gripper.has_jaw:
        _refuse(f"--jaw-opening: {gripper.name} has no jaw; leave it out")
    if opening_m is not None and not gripper.jaw_min_m <= opening_m <= gripper.jaw_max_m:
        _refuse(f"--jaw-opening {opening_m:g}: the gripper's is {gripper.jaw_min_m:g} to {gripper.jaw_max_m:g} m")
    note = None
    if opening_m is None and gripper.has_jaw:
        opening_m = gripper.jaw_nominal_m if config is None else config.jaw_opening_m
        note = f"jaw opening taken as {opening_m:g} m; --jaw-opening M if it was another"
    expected = None if config is None else config.cam_T_grip
    return KnownGripper(camera, gripper, opening_m, expected), note


def _gripper(arguments: argparse.Namespace, config: Config | None) -> Gripper:
    if arguments.gripper is None:
        assert config is not None, "check_options asks for a gripper"
        return config.gripper
    try:
        return read_gripper(Path(arguments.gripper))
    except ConfigError as error:
        raise common.CommandFailedError(str(error), common.EXIT_USAGE) from None


def _rough(
    arguments: argparse.Namespace, images: int, method: KnownGripper | UnknownGripper
) -> tuple[list[Rough | None], list[str]]:
    names: list[str] = arguments.corners or []
    if len(names) > 1 and len(names) != images:
        _refuse(f"--corners: {len(names)} files for {images} images; one for all, or one for each")
    rough: list[Rough | None] = [_read_rough(Path(name), method) for name in names] or [None]
    return rough * images if len(rough) == 1 else rough, names


def _read_rough(path: Path, method: KnownGripper | UnknownGripper) -> Rough:
    try:
        rough = to_settings(read_yaml(path), RoughCorners).corners
    except SettingsError as error:
        raise common.CommandFailedError(f"{path}: {error}", common.EXIT_USAGE) from None
    except ConfigError as error:
        raise common.CommandFailedError(str(error), common.EXIT_USAGE) from None
    try:
        if isinstance(method, UnknownGripper):
            outlines_of(rough)
        else:
            method.check_names(rough)
    except CalibrationError as error:
        raise common.CommandFailedError(f"{path}: {error}", common.EXIT_USAGE) from None
    return rough


def _refuse(text: str) -> NoReturn:
    raise common.CommandFailedError(f"calibrate plane: {text}", common.EXIT_USAGE)
