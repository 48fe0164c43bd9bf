"""The inputs of ``gripmon gripper from-images``, read from files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gripmon.daemon.calibrations import read_calibrated, read_given_camera
from gripmon.daemon.config.checks import covariance_of, reference_transform
from gripmon.daemon.config.yaml_file import read_yaml
from gripmon.daemon.setup.robot_file import is_robot_reference, robot_reference
from gripmon.io.sources.files import TIMESTAMPS_NAME, opening_beside
from gripmon.model.camera import LensSettings
from gripmon.model.errors import InputError
from gripmon.model.geometry import from_record
from gripmon.model.records import Array


@dataclass(frozen=True)
class ImagesInputs:
    """The ``camera``; the jaw opening in each image (m), None without tables; the reference ``cam_T_grip`` (4, 4) with
    its covariance (6, 6), if one is given; the ``files`` that were read.
    """

    camera: LensSettings
    openings_m: list[float | None] | None
    reference: tuple[Array, Array] | None
    files: tuple[Path, ...]


def images_inputs(images: list[Path], camera: Path, reference: Path | None) -> ImagesInputs:
    """Read the files; openings come from a ``timestamps.csv`` beside each image, if there is one.
    :class:`~gripmon.model.errors.InputError`.
    """
    files = [camera, *([] if reference is None else [reference])]
    pose = None
    if reference is not None:
        pose = _pose(reference)
    return ImagesInputs(read_given_camera(camera).lens, _openings(images), pose, tuple(files))


def _pose(path: Path) -> tuple[Array, Array]:
    """A reference ``cam_T_grip`` (4, 4) and its covariance (6, 6), of a calibration or in a robot's short form."""
    if path.suffix in (".yaml", ".yml") and path.is_file() and is_robot_reference(values := read_yaml(path)):
        settings = robot_reference(path, values)
        return reference_transform(settings), np.reshape(covariance_of(settings), (6, 6))
    found = read_calibrated(path)
    if found.cam_T_grip is None or found.covariance is None:
        raise InputError(
            f"{path}: holds no pose of a gripper; a file of gripmon calibrate plane, or cam_T_grip with "
            "position_sigma_m and rotation_sigma_rad",
            "reference",
        )
    return from_record(found.cam_T_grip), np.reshape(found.covariance, (6, 6))


def _openings(images: list[Path]) -> list[float | None] | None:
    openings = [opening_beside(path) for path in images]
    if all(opening is None for opening in openings):
        return None
    for path, opening in zip(images, openings, strict=True):
        if opening is None:
            raise InputError(
                f"{path}: its jaw opening isn't known and that of others is; jaw_opening_m in "
                f"{path.parent / TIMESTAMPS_NAME} for all of them, or for none"
            )
    return openings
