"""What programs call to teach; ``gripmon teach --config`` is this."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Protocol

import cv2

from gripmon.io.sources.files import TIMESTAMPS_NAME
from gripmon.model.camera import Camera
from gripmon.model.errors import InputError, NoResultError
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, ReferenceRecord
from gripmon.monitor import MonitorSettings
from gripmon.teach.edges import Taught, TeachingImage, TeachingRefused
from gripmon.teach.edges import teach as teach_images
from gripmon.teach.edges.files import Picture, read_picture, taught_model, to_yaml
from gripmon.teach.edges.picture import draw
from gripmon.track.edges import TaughtEdges, TaughtModel

__all__ = ["Configured", "Teaching", "teach"]


class _Jaw(Protocol):
    @property
    def source(self) -> str: ...


class _Settings(Protocol):
    @property
    def monitor(self) -> MonitorSettings: ...
    @property
    def jaw(self) -> _Jaw: ...


class Configured(Protocol):
    """What teaching needs of a configuration; :class:`gripmon.Config` has it."""

    @property
    def camera(self) -> Camera: ...
    @property
    def gripper(self) -> Gripper: ...
    @property
    def reference(self) -> ReferenceRecord: ...
    @property
    def cam_T_grip(self) -> Array: ...
    @property
    def jaw_opening_m(self) -> float | None: ...
    @property
    def settings(self) -> _Settings: ...


@dataclass(frozen=True)
class Teaching:
    """What the images show of every edge (``taught``), and the ``model`` that a configuration names."""

    taught: Taught
    model: TaughtModel
    config: Configured
    first: TeachingImage

    def text(self) -> str:
        """The taught model's file (YAML)."""
        return to_yaml(self.model)

    def picture(self, ending: str = ".png") -> bytes:
        """The first image that was used with what was taught, offsets enlarged; ``ending``: .png, .jpg or .jpeg."""
        config = self.config
        edges = TaughtEdges.of_model(self.model, config.gripper)
        drawn = draw(config.camera, config.gripper, config.cam_T_grip, self.first, edges, self.model)
        return bytes(cv2.imencode(ending, drawn)[1].tobytes())


def teach(
    config: Configured,
    images: Sequence[str | PathLike[str]],
    *,
    jaw_opening_m: float | None = None,
    command: str = "gripmon.teach.api.teach",
) -> Teaching:
    """Measure what the gripper's edges look like in image files that were taken at the reference calibration.

    ``config``: load it without a taught model (``with_taught=False``).  ``jaw_opening_m``: in all images (m); None: the
    configuration's where it is fixed, else that of a ``timestamps.csv`` beside each image.  ``command`` is written into
    the model's provenance.

    Raises :class:`~gripmon.model.errors.InputError` for images that can't be used,
    :class:`~gripmon.model.errors.NoResultError` where nothing can be taught from them.
    """
    cv2.setNumThreads(1)
    if not images:
        raise InputError("teach: no image; image files at the reference calibration")
    gripper, settings = config.gripper, config.settings.monitor
    if jaw_opening_m is None and config.settings.jaw.source == "fixed":
        jaw_opening_m = config.jaw_opening_m
    pictures = [
        read_picture(Path(image), config.camera, gripper, settings.bit_depth, jaw_opening_m) for image in images
    ]
    for each in pictures:
        if each.jaw_opening_m is None and gripper.has_jaw:
            assert each.path is not None
            wrong = f"its jaw opening isn't known (jaw.source is {config.settings.jaw.source})"
            right = f"--jaw-opening M, or jaw_opening_m in {Path(each.path).parent / TIMESTAMPS_NAME}"
            raise InputError(f"{each.path}: {wrong}; {right}")
    _check_different(pictures)
    nominal_m = gripper.jaw_nominal_m
    shown = [
        TeachingImage(p.image, nominal_m if p.jaw_opening_m is None else p.jaw_opening_m, str(p.path)) for p in pictures
    ]
    try:
        taught = teach_images(config.camera, gripper, settings.corners, settings.jaw_sigma_m, config.reference, shown)
    except TeachingRefused as refused:
        raise NoResultError(f"teach: {refused}") from None
    model = taught_model(taught, config.camera, gripper, settings, config.reference, pictures, command)
    return Teaching(taught, model, config, taught.used(shown)[0])


def _check_different(pictures: Sequence[Picture]) -> None:
    """The same image twice would make the scatter, and so the uncertainty, too small."""
    seen: dict[str, str] = {}
    for each in pictures:
        assert each.path is not None
        digest = hashlib.sha256(Path(each.path).read_bytes()).hexdigest()
        if digest in seen:
            raise InputError(f"{each.path}: is the same image as {seen[digest]}; each image once")
        seen[digest] = each.path
