"""The inputs of ``gripmon gripper from-images``, read from files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gripmon.daemon.calibrations import camera_in, pose_in
from gripmon.io.sources.files import TIMESTAMPS_NAME, opening_beside
from gripmon.model.camera import LensSettings
from gripmon.model.errors import InputError
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
    pose = None if reference is None else pose_in(reference)
    return ImagesInputs(camera_in(camera).lens, _openings(images), pose, tuple(files))


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
