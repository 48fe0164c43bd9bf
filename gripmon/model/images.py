"""Image files: one, several from the same camera, or all in a folder, in natural order."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import stat
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from gripmon.model.errors import InputError
from gripmon.model.jpeg import jpeg_fault

if TYPE_CHECKING:
    from gripmon.model.records import Image

_SUFFIXES = "bmp dib exr hdr jp2 jpe jpeg jpg pbm pgm png pnm ppm tif tiff webp"
IMAGE_SUFFIXES = frozenset(f".{suffix}" for suffix in _SUFFIXES.split())
VIDEO_SUFFIXES = frozenset({".mp4", ".mkv", ".avi", ".mov", ".webm"})
LARGEST_BYTES = 1 << 30
"""Larger files are neither images nor tables: 12,000 x 12,000 px of 16-bit colour are 0.8 GiB (bytes)."""
JPEG, PNG = b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"
"""First bytes of such a file."""
NOT_AN_IMAGE = "truncated, damaged or not an image"
_TOO_LARGE = "CV_IO_MAX_IMAGE_PIXELS"
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_BIG_TIFF, _ORIENTATION, _MOST_TAGS = 43, 274, 4096
_PNG_END = b"IEND"
_PNG_END_BYTES = 8
"""Length of the last chunk's name and checksum (bytes)."""


class NamedImage(NamedTuple):
    """An image that is no file of its own, as a video's frame, with the name to call it by."""

    name: str
    image: Image


def natural_key(name: str) -> tuple[list[Any], str]:
    """Natural sort key: digits compare as numbers, the rest as text; ties by the name itself."""
    parts = re.split(r"([0-9]+)", name)
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], name


def image_paths(names: Sequence[str | Path]) -> list[Path]:
    """The image files to read: files as named, and for a folder all images in it, in natural order.
    :class:`~gripmon.model.errors.InputError` for a folder without images and for a missing file.
    """
    paths: list[Path] = []
    for path in map(Path, names):
        if not path.exists():
            raise InputError(f"{path}: the file is missing; an image file, or a folder with images")
        if not path.is_dir():
            paths.append(path)
            continue
        inside = [p for p in path.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file()]
        if not inside:
            raise InputError(f"{path}: no image in this folder; e.g. *.png, *.jpg")
        paths += sorted(inside, key=lambda p: natural_key(p.name))
    return paths


def images_of_one_camera(
    images: Sequence[str | Path | NamedImage | Image], size_px: tuple[int, int] | None = None
) -> Iterator[tuple[str, Image]]:
    """Yield each image with its name ("image 1", ... for arrays without one); all must have one size, that of the
    camera if it is given.  :class:`~gripmon.model.errors.InputError` for one that can't be read, has another size, or
    equals an earlier one.
    """
    seen: dict[bytes, str] = {}
    first_shape: tuple[str, tuple[int, ...]] | None = None
    for number, given in enumerate(images, 1):
        if isinstance(given, str | Path):
            name, image = str(given), image_in(Path(given))
        elif isinstance(given, NamedImage):
            name, image = given
        else:
            name, image = f"image {number}", given
        # A duplicate image would make every uncertainty too small.
        first = seen.setdefault(hashlib.sha256(image.tobytes()).digest(), name)
        if len(seen) < number:
            raise InputError(f"{name}: is the same image as {first}; each image once")
        height, width = image.shape[:2]
        first_name, size = first_shape = first_shape or (name, (width, height))
        if (width, height) != size:
            raise InputError(
                f"{name}: has {width} x {height} px and {first_name} {size[0]} x {size[1]} px; images of one camera, "
                "in one size"
            )
        if size_px is not None:
            check_size(name, image, *size_px)
        yield name, image


def image_in(path: Path) -> Image:
    """The image in a file.  :class:`~gripmon.model.errors.InputError` if there is none."""
    if path.is_dir():
        raise InputError(f"{path}: is a folder; an image file")
    image, fault = read_image(path)
    if image is None:
        raise InputError(f"{path}: {fault}; an image file{'' if path.exists() else ', or a folder of them'}")
    return image


def check_size(name: str, image: Image, width_px: int, height_px: int) -> None:
    """:class:`~gripmon.model.errors.InputError` for an image that doesn't have the camera's size."""
    height, width = image.shape[:2]
    if (width, height) != (width_px, height_px):
        raise InputError(
            f"{name}: {width} x {height} px; the camera's {width_px} x {height_px} px, as it was calibrated"
        )


def read_image(path: Path) -> tuple[Image | None, str | None]:
    """The image and None, or None and the reason why there is none."""
    import cv2
    import numpy as np

    try:
        data = regular_bytes(path)
    except FileNotFoundError:
        return None, "the file is missing"
    except OSError as error:
        return None, f"the file can't be read: {error.strerror}"
    if not data:
        return None, "the file is empty"
    image, fault = decoded(data, cv2.IMREAD_UNCHANGED)
    if image is None:
        return None, fault
    if image.dtype == np.float64:
        image = image.astype(np.float32)
    if image.ndim == 3:
        image = np.ascontiguousarray(image[:, :, 0] if image.shape[2] < 3 else image[:, :, :3])
    return image, None


def grey_image(data: bytes) -> tuple[Image | None, str | None]:
    """The brightness in a file's bytes, H x W (nothing else is measured), and None; or None and why there is none."""
    import cv2

    return decoded(data, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE)


def decoded(data: bytes, flags: int) -> tuple[Image | None, str | None]:
    """What OpenCV reads in a file's bytes by its ``flags``, and None; or None and why there is nothing.

    Pixels are as the sensor has them, whatever EXIF says of the way up: the lens is of the sensor.
    """
    import cv2
    import numpy as np

    if data.startswith(PNG) and not 0 <= data.rfind(_PNG_END) <= len(data) - _PNG_END_BYTES:
        return None, NOT_AN_IMAGE  # libpng would print its own message to stderr
    if data.startswith(JPEG) and (fault := jpeg_fault(data)) is not None:
        return None, fault
    if data.startswith(_TIFF):
        data = _not_turned(data)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        if _TOO_LARGE in str(error.err):
            return None, f"an image of more pixels than OPEN{_TOO_LARGE}"
        return None, NOT_AN_IMAGE
    return image, None if image is not None else NOT_AN_IMAGE


def _not_turned(tiff: bytes) -> bytes:
    """A TIFF without its tag of orientation, which OpenCV obeys whatever it is told (TIFF 6.0, section 8; BigTIFF)."""
    order: Literal["little", "big"] = "little" if tiff.startswith(b"II") else "big"

    def number(at: int, size: int) -> int:
        return int.from_bytes(tiff[at : at + size], order)

    at, wide, entry, value = (8, 8, 20, 12) if number(2, 2) == _BIG_TIFF else (4, 2, 12, 8)
    at = number(at, at if at == 8 else 4)
    for tag in range(at + wide, at + wide + entry * min(number(at, wide), _MOST_TAGS), entry):
        if number(tag, 2) == _ORIENTATION:
            return tiff[: tag + value] + (1).to_bytes(2, order) + tiff[tag + value + 2 :]
    return tiff


def regular_bytes(path: Path) -> bytes:
    """The content of a regular file.  OSError for anything else too: reading a pipe or a device might never end."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    with os.fdopen(descriptor, "rb") as file:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise OSError(errno.EINVAL, "it is not a regular file")
        if status.st_size > LARGEST_BYTES:
            raise OSError(errno.EFBIG, f"it is larger than {LARGEST_BYTES >> 20} MiB")
        return file.read(LARGEST_BYTES)
