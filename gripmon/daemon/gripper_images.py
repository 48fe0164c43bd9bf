"""The inputs of ``gripmon gripper from-images``, read from files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from gripmon.io.sources.files import TIMESTAMPS_NAME, VideoSettings, VideoSource, opening_beside
from gripmon.model.errors import InputError
from gripmon.model.images import IMAGE_SUFFIXES, VIDEO_SUFFIXES, NamedImage, image_paths, natural_key
from gripmon.model.records import Array, Image

MOST_FRAMES = 100
"""Frames of a video that are kept, at most, and at least half as many of a longer one: they fill 0.6 GB at 1920 px."""
CHANGED_LEVELS = 8.0
"""Difference of grey levels of 255 at a quarter of the size, from which another thing is seen there: a coder's errors
average to less."""
CHANGED_SHARE = 0.05
"""Least part of the image that shows another thing than the frame before, for another view.  The same view again would
count as another background that agrees."""


@dataclass(frozen=True)
class ImagesTaken:
    """``images``: files, and frames of videos; ``files`` that hold them; ``notes``: how many frames of each video."""

    images: list[Path | NamedImage]
    files: list[Path]
    notes: list[str]


def images_taken(names: Sequence[str | Path]) -> ImagesTaken:
    """Image files as named, all images in a folder or, if it has none, its videos; of a video frames at equal distances
    that show different views.  :class:`~gripmon.model.errors.InputError`.
    """
    taken = ImagesTaken([], [], [])
    for path in map(Path, names):
        videos = [path] if path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES else []
        if path.is_dir() and not any(p.suffix.lower() in IMAGE_SUFFIXES for p in path.iterdir()):
            found = (p for p in path.iterdir() if p.suffix.lower() in VIDEO_SUFFIXES and p.is_file())
            videos = sorted(found, key=lambda p: natural_key(p.name))
        stills = [] if videos else image_paths([path])
        taken.images.extend(stills)
        taken.files.extend([*stills, *videos])
        for video in videos:
            frames, note = frames_of_video(video)
            taken.images.extend(frames)
            taken.notes.append(note)
    return taken


def frames_of_video(path: Path) -> tuple[list[NamedImage], str]:
    """Frames of a video at equal distances, at most :data:`MOST_FRAMES`, without those that show the same view as the
    one before; and how many these are, in words.  :class:`~gripmon.model.errors.InputError`.
    """
    source = VideoSource(VideoSettings(path=path.name, fps=1.0), path.parent)
    kept: list[NamedImage] = []
    stride = count = 0
    try:
        while (frame := source.read()) is not None:
            stride = stride or 1
            if frame.image is not None and count % stride == 0:
                kept.append(NamedImage(f"{path}, frame {count}", frame.image))
            if len(kept) > MOST_FRAMES:  # read once, however long it is
                kept, stride = kept[::2], 2 * stride
            count += 1
    finally:
        source.close()
    if not kept:
        raise InputError(f"{path}: holds no frame that can be decoded; a complete video")
    views, shown = [], None
    for one in kept:
        small = _small(one.image)
        if shown is None or float((np.abs(small - shown) > CHANGED_LEVELS).mean()) >= CHANGED_SHARE:
            views.append(one)
            shown = small
    said = f"{path}: {len(views)} of {count} frames are used"
    said += f", one in {stride}" if stride > 1 else ""
    alike = len(kept) - len(views)
    return views, said + (f", without {alike} that show the view of the one before" if alike else "")


def _small(image: Image) -> Array:
    """Grey levels (h / 4, w / 4)."""
    size = max(image.shape[1] // 4, 1), max(image.shape[0] // 4, 1)
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    return np.asarray(small.mean(axis=2) if small.ndim == 3 else small)


def openings_beside(images: Sequence[Path | NamedImage]) -> list[float | None] | None:
    """The jaw opening in each image (m), from a ``timestamps.csv`` beside each image file; None without any.
    :class:`~gripmon.model.errors.InputError`.
    """
    openings = [opening_beside(image) if isinstance(image, Path) else None for image in images]
    if all(opening is None for opening in openings):
        return None
    for image, opening in zip(images, openings, strict=True):
        if opening is None:
            path = image if isinstance(image, Path) else Path(image.name)
            raise InputError(
                f"{path}: its jaw opening isn't known and that of others is; jaw_opening_m in "
                f"{path.parent / TIMESTAMPS_NAME} for all of them, or for none"
            )
    return openings
