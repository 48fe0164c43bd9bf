"""The inputs of teaching from corners: camera, gripper, reference and images, each checked.

All functions raise :class:`~gripmon.model.errors.InputError` for unusable input.
"""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2

from gripmon.calibrate.bundle import GivenCamera
from gripmon.daemon.calibrations import camera_in, given_file, pose_of, read_calibrated
from gripmon.daemon.config import Config, ConfigError, load_config, read_gripper
from gripmon.daemon.config.calibrated import mismatch
from gripmon.daemon.config.checks import predict_view, view_fault
from gripmon.daemon.config.reference import configured, covariance_of, reference_transform
from gripmon.daemon.config.settings import ReferenceSettings, TransformSettings
from gripmon.daemon.config.typed import SettingsError
from gripmon.daemon.config.yaml_file import GivenFile, read_settings, read_yaml
from gripmon.daemon.teaching.source import named_source
from gripmon.io.sources import FolderSettings, LiveSettings, SourceError, SourceSettings
from gripmon.model.camera import Camera, make_camera
from gripmon.model.errors import InputError
from gripmon.model.gripper import Gripper
from gripmon.model.images import check_size, image_in
from gripmon.model.records import ReferenceRecord
from gripmon.model.response import ResponseSeen
from gripmon.monitor import MonitorSettings
from gripmon.teach.api import Picture, read_picture, told_response
from gripmon.teach.corner_pose import corners_fault
from gripmon.teach.outlines import RoughCorners
from gripmon.teach.session import Setup
from gripmon.teach.sites import OutlineSite

ROBOT, CAMERA_NAME, ROUGH = "robot1", "wrist", "rough.yaml"


@dataclass(frozen=True)
class Inputs:
    """Everything but the corners.  ``folder``: where files are written; ``config``: the given configuration, if any;
    ``response``: of the camera, None until a live one has sent images; ``calibrations``: files of ``gripmon calibrate``
    that the configuration names instead of sections, by key.
    """

    setup: Setup
    pictures: tuple[Picture, ...]
    gripper_path: Path
    folder: Path
    source: SourceSettings | None
    config: Config | None
    robot: str
    camera_name: str
    command: str
    live: str | None
    calibrations: dict[str, Path]
    jaw_source: str | None = None
    response: ResponseSeen | None = None


def read_inputs(
    images: Sequence[Path],
    *,
    command: str,
    out: Path | None = None,
    config: Path | None = None,
    camera: Path | None = None,
    gripper: Path | None = None,
    reference: Path | None = None,
    live: str | None = None,
    source: str | None = None,
    jaw_opening_m: float | None = None,
    jaw_source: str | None = None,
    robot: str | None = None,
    camera_name: str | None = None,
    response: str = "auto",
    distance_m: tuple[float, float] | None = None,
) -> Inputs:
    """Read and check the input: either ``config``, or ``gripper`` with ``camera`` or ``reference`` and values for the
    configuration to be written.  ``command``: for the files' provenance; ``live``: a camera instead of images;
    ``source``: of the configuration's frames (None: that camera, or the images' folder); ``response``: as in
    :func:`gripmon.teach.api.teach`; ``distance_m``: of the TCP, where there is no reference, with its standard
    deviation.
    """
    cv2.setNumThreads(1)
    given = None
    named = {key: given_file(path) for key, path in (("camera", camera), ("reference", reference)) if path is not None}
    if config is not None:
        given = load_config(config, check_source=False, with_taught=False)
        setup = Setup(given.camera, given.gripper, given.settings.monitor, given.reference)
        gripper_path = given.gripper_path
        robot, camera_name = given.settings.robot, given.settings.camera_name
        if jaw_opening_m is None and given.settings.jaw.source == "fixed":
            jaw_opening_m = given.jaw_opening_m
    else:
        model, gripper_path = _gripper(gripper)
        setup = Setup(*_calibrations(named, model))
    if jaw_source is not None and not setup.gripper.has_jaw:
        raise InputError("the gripper has no jaw; leave it out", "jaw_source")
    depth = setup.settings.bit_depth
    pictures = tuple(read_picture(path, setup.camera, setup.gripper, depth, jaw_opening_m) for path in images)
    said = None if given is None or not given.says_response else given.settings.monitor.corners.edges.response
    # A live camera's images come later: FileSaving looks at those that are kept.
    later = live is not None and said is None and response == "auto"
    light = None if later else told_response(pictures, response, said)
    setup = replace(setup, distance_m=distance_m)
    if light is not None:
        setup = replace(setup, settings=setup.settings.with_response(light.response))
    frames: SourceSettings
    try:
        if live is not None:
            frames = live_settings(live, setup.camera)
        elif source is not None:
            frames = named_source(source, (setup.camera.width_px, setup.camera.height_px))
        else:
            frames = FolderSettings(path=str(images[0].parent))
    except SourceError as error:
        raise InputError(str(error), "source") from None
    return Inputs(
        setup=setup,
        pictures=pictures,
        gripper_path=gripper_path,
        folder=out or (Path() if given is None else given.directory),
        source=frames if given is None else None,
        config=given,
        robot=robot or ROBOT,
        camera_name=camera_name or CAMERA_NAME,
        command=command,
        live=live,
        calibrations={key: file.path for key, file in named.items() if file.own},
        jaw_source=jaw_source,
        response=light,
    )


def read_rough(path: Path, gripper: Gripper) -> dict[str, tuple[float, float]]:
    """The corners in a file (px)."""
    corners = read_settings(path, RoughCorners).of(gripper)
    fault = corners_fault(corners, gripper)
    if fault is not None:
        raise InputError(f"{path}: {fault[0]}: {fault[1]}; {fault[2]}")
    return corners


def outline_page(image: Path, camera: Path | None, folder: Path, back: str | None = None) -> OutlineSite:
    """A page without a gripper: rough corners for ``gripmon calibrate plane --infer``, saved in ``folder``."""
    shown, target = image_in(image), None
    if camera is not None:
        with contextlib.suppress(ConfigError):  # camera_in reports what is wrong
            target = read_yaml(camera).get("target")
        lens = camera_in(camera).lens
        check_size(str(image), shown, lens.width_px, lens.height_px)
    known = isinstance(target, str) and target.startswith("circles")
    words = ["gripmon", "calibrate", "plane", image, "--camera", camera or "camera.yaml"]
    words += ["--target", camera if known else "TARGET", "--infer", "--corners", folder / ROUGH]
    words += ["--gripper-out", folder / "gripper.yaml", "--out", folder / "hand_eye.yaml"]
    plate = (
        f"the plate is assumed to be the camera's target, {target}; for another one give --target"
        if known
        else "TARGET is the plate, of discs, such as circles:12x10:0.008:0.004"
    )
    note = f"{plate}; with jaws that move also --jaw-range MIN:MAX (m)"
    picture = Picture(image.name, shown, None, str(image))
    return OutlineSite(picture, folder / ROUGH, shlex.join(map(str, words)), note, back)


def _gripper(path: Path | None) -> tuple[Gripper, Path]:
    if path is None:
        right = "a gripper file, one of configs/grippers or your own, or a configuration"
        raise InputError(f"is missing; {right}", "gripper")
    if not path.is_file():
        right = "a gripper file such as those in configs/grippers"
        raise InputError(f"{path}: there is no such file; {right}", "gripper")
    return read_gripper(path), path


def _calibrations(
    named: dict[str, GivenFile], gripper: Gripper
) -> tuple[Camera, Gripper, MonitorSettings, ReferenceRecord | None, GivenCamera]:
    """Camera, gripper, settings and reference from files; a reference's file may also contain its camera."""
    given = camera_in(named["camera"]) if "camera" in named else None
    reference = None
    if "reference" in named:
        found = read_calibrated(named["reference"])
        pose_of(found)  # says what a file without one holds
        given = given or (None if found.lens is None else GivenCamera(found.lens))
        assert found.cam_T_grip is not None
        reference = configured(found.cam_T_grip, found.covariance, with_gripper=found.with_gripper)
        fault = None if given is None else mismatch(found.lens, found.gripper, given.lens, gripper)
        if fault is not None:
            raise InputError(f"{found.name}: {fault.key}: {fault.wrong}; {fault.right}", "reference")
    if given is None:
        right = "a file of gripmon calibrate intrinsics, or a configuration"
        raise InputError(f"is missing; {right}", "camera")
    camera = make_camera(given.lens)
    if reference is not None:
        _check_view(camera, gripper, reference, found.name)
    return camera, gripper, MonitorSettings(), reference, given


def _check_view(camera: Camera, gripper: Gripper, reference: ReferenceRecord, name: str) -> None:
    """Check that the gripper is visible at this reference."""
    transform = reference.cam_T_grip
    settings = ReferenceSettings(
        cam_T_grip=TransformSettings(translation_m=transform.translation_m, rotation_xyzw=transform.rotation_xyzw),
        covariance=reference.covariance,
    )
    try:
        cam_T_grip, _ = reference_transform(settings), covariance_of(settings)
        fault = view_fault(predict_view(camera, gripper, cam_T_grip, None), gripper, camera)
    except SettingsError as error:
        fault = error.fault
    if fault is not None:
        raise InputError(f"{name}: {fault.key.removeprefix('reference.')}: {fault.wrong}; {fault.right}", "reference")


def live_settings(device: str, camera: Camera) -> LiveSettings:
    """A live camera, with images of the calibration's size requested."""
    where = int(device) if device.isdecimal() else device
    return LiveSettings(device=where, width_px=camera.width_px, height_px=camera.height_px)
