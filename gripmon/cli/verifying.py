"""A hand/eye calibration measured anew from images, for ``gripmon calibrate verify``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from gripmon.cli import calibration_files as files
from gripmon.cli import common
from gripmon.cli.calibration_sources import Calibrated

if TYPE_CHECKING:
    from gripmon.daemon.config import Config
    from gripmon.model.records import Array, Image


def measured(first: Calibrated, arguments: argparse.Namespace, warnings: list[str]) -> Calibrated:
    """What the images show, on the plate if there is a ``--target``; what can't be measured ends the command with
    exit code 3.  What is doubtful about it is added to ``warnings``.
    """
    from gripmon.model.geometry import to_record

    config = _config(first, arguments)
    opening_m = _opening(first, config, arguments)
    paths = files.image_paths(arguments.second)
    images = list(files.images_of(paths))
    for path, image in images:
        size = (config.camera.width_px, config.camera.height_px)
        if (image.shape[1], image.shape[0]) != size:
            raise common.CommandFailedError(
                f"{path}: has {image.shape[1]} x {image.shape[0]} px; the camera's {size[0]} x {size[1]} px",
                common.EXIT_USAGE,
            )
    if arguments.target is not None:
        cam_T_grip, covariance = _on_plate(first, config, opening_m, images, arguments.target, warnings)
    else:
        cam_T_grip, covariance = _tracked(first, config, opening_m, images, warnings)
    return Calibrated(
        paths[0],
        "images",
        config.settings.camera,
        cam_T_grip=to_record(cam_T_grip),
        covariance=tuple(covariance.ravel().tolist()),
    )


def _config(first: Calibrated, arguments: argparse.Namespace) -> Config:
    """The configuration, which has to be of the same camera and gripper."""
    from gripmon.track.edges.taught import gripper_digest

    if arguments.config is None:
        raise common.CommandFailedError(
            "--config: is missing; with images, the configuration with gripper and monitor", common.EXIT_USAGE
        )
    if first.cam_T_grip is None:
        raise common.CommandFailedError(
            f"{first.path}: is {first.kind}; with images, a hand/eye calibration", common.EXIT_USAGE
        )
    config = common.load(arguments.config, check_source=False)
    if first.lens is not None and first.lens != config.settings.camera:
        raise common.CommandFailedError(
            f"{first.path}: camera: isn't the one of {arguments.config}; the same camera calibration in both",
            common.EXIT_USAGE,
        )
    if first.gripper is not None and first.gripper.sha256 != gripper_digest(config.gripper):
        raise common.CommandFailedError(
            f"{first.path}: gripper: {first.gripper.name} isn't the one of {arguments.config}; the same file in both",
            common.EXIT_USAGE,
        )
    return config


def _opening(first: Calibrated, config: Config, arguments: argparse.Namespace) -> float | None:
    gripper = config.gripper
    if not gripper.has_jaw:
        if arguments.jaw_opening is not None:
            raise common.CommandFailedError("--jaw-opening: the gripper has no jaw; leave it out", common.EXIT_USAGE)
        return None
    given = (arguments.jaw_opening, first.jaw_opening_m, config.jaw_opening_m)
    opening_m = next(m for m in given if m is not None)
    if not gripper.jaw_min_m <= opening_m <= gripper.jaw_max_m:
        raise common.CommandFailedError(
            f"--jaw-opening: {opening_m:g} m; the gripper's {gripper.jaw_min_m:g} to {gripper.jaw_max_m:g} m",
            common.EXIT_USAGE,
        )
    return opening_m


def _on_plate(
    first: Calibrated,
    config: Config,
    opening_m: float | None,
    images: list[tuple[Path, Image]],
    target_text: str,
    warnings: list[str],
) -> tuple[Array, Array]:
    """By the plane coincidence, as ``gripmon calibrate plane`` does it, with the known gripper."""
    from gripmon.calibrate.detection import detect
    from gripmon.calibrate.plane import GivenCamera
    from gripmon.calibrate.plane_average import average
    from gripmon.calibrate.sighting import CalibrationError, NotFound
    from gripmon.model.geometry import from_record
    from gripmon.teach.onboarding import KnownGripper

    target = files.target_of(target_text)
    assert first.cam_T_grip is not None
    method = KnownGripper(GivenCamera(config.settings.camera), config.gripper, opening_m, from_record(first.cam_T_grip))
    found = []
    for path, image in images:
        sighting = detect(image, target, str(path))
        if isinstance(sighting, NotFound):
            raise common.CommandFailedError(f"{path}: {sighting.reason}")
        try:
            found.append(method.look(image, sighting, None).coincidence)
        except CalibrationError as error:
            raise common.CommandFailedError(f"{path}: {error}") from None
    together = average(found, inferred=False)
    warnings += together.warnings
    return together.cam_T_grip, together.covariance


def _tracked(
    first: Calibrated,
    config: Config,
    opening_m: float | None,
    images: list[tuple[Path, Image]],
    warnings: list[str],
) -> tuple[Array, Array]:
    """By the monitor's own measurement.  Images that it can't measure, or that contradict the others, are left out;
    where they are half of them or more, the command ends with exit code 3.
    """
    import numpy as np

    from gripmon.calibrate.verify import agreeing, mean_of_one_scene
    from gripmon.model.geometry import from_record

    assert first.cam_T_grip is not None
    expected, covariance = from_record(first.cam_T_grip), np.reshape(first.covariance, (6, 6))
    # Where the camera has moved, an image that begins at the calibration may end at a wrong place.  So once more, from
    # where most of them end.
    for _ in range(2):
        found, reasons = _each_measured(config, opening_m, images, expected, covariance)
        if not found:
            raise common.CommandFailedError(f"no image can be measured; {reasons[0]}")
        transforms, covariances = [one[1] for one in found], [one[2] for one in found]
        agree = agreeing(transforms, covariances)
        chosen = np.flatnonzero(agree)
        expected, covariance = mean_of_one_scene([transforms[k] for k in chosen], [covariances[k] for k in chosen])
    if 2 * len(chosen) <= len(found) and len(found) > 1:
        share = f"only {len(chosen)}" if len(chosen) > 1 else "no two"
        raise common.CommandFailedError(
            f"{share} of {len(found)} images agree on where the gripper is; images of one pose, in which the "
            "background doesn't hide its edges"
        )
    if len(found) == 1:
        warnings.append(f"{found[0][0]} alone: nothing confirms what it shows; three images or more are better")
    warnings += [f"left out: {reason}" for reason in reasons]
    warnings += [
        f"left out: {one[0]}: contradicts the other images" for one, kept in zip(found, agree, strict=True) if not kept
    ]
    return expected, covariance


def _each_measured(
    config: Config, opening_m: float | None, images: list[tuple[Path, Image]], expected: Array, covariance: Array
) -> tuple[list[tuple[Path, Array, Array]], list[str]]:
    """``cam_T_grip`` and covariance of every image that shows the gripper about where it is ``expected``; why not."""
    import numpy as np

    from gripmon.model.geometry import from_record, to_record
    from gripmon.model.records import Frame, Origin, ReferenceRecord
    from gripmon.monitor import Monitor

    flat = tuple(covariance.ravel().tolist())
    reference = ReferenceRecord("verify", 0, 0, "configuration", to_record(expected), flat)
    found, reasons = [], []
    for number, (path, image) in enumerate(images):
        # Each image by itself: what a monitor learns from the last one is for a camera that stands still meanwhile.
        monitor = Monitor(config.camera, config.gripper, config.settings.monitor, reference, config.taught_edges)
        record = monitor.process(Frame(number, 1_000_000_000 * (number + 1), image, opening_m, str(path)))
        if record.cam_T_grip is None or record.covariance is None or record.source is Origin.HELD:
            reasons.append(f"{path}: {record.reason or 'the gripper is not seen'}")
            continue
        found.append((path, from_record(record.cam_T_grip), np.reshape(record.covariance, (6, 6))))
    return found, reasons
