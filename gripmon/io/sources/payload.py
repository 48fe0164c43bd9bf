"""A camera driver's payload -> an image, checked before decoding."""

from __future__ import annotations

import functools
import io
import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from gripmon.model.errors import one_line
from gripmon.model.images import JPEG, PNG
from gripmon.model.jpeg import jpeg_fault
from gripmon.model.pixels import ENCODINGS, unpacked
from gripmon.model.records import FrameNote, Image, MessageRefused, SnapshotImage, from_json

if TYPE_CHECKING:
    from PIL.ImageFile import ImageFile

LARGEST_PX = 20_000
"""Largest width and height of a camera's image whose size isn't known beforehand, px."""

SMALLEST_PX, MOST_PIXELS = 16, (64 << 20) // 3
"""Least width and height of a camera's image, px, and most pixels: as many as a message of 64 MiB holds in colour."""

MOST_SCANS = 100
"""A progressive JPEG has some ten; each one costs as much as the whole image, however few bytes it has."""


class PayloadError(ValueError):
    """A payload that can't be used; the text is "what is wrong; what would be right", in one line."""


class WrongSizeError(PayloadError):
    """An image, but not one of this camera."""


def read_note(attachment: bytes | None) -> FrameNote:
    """The attachment; an empty one if there is none.  Raises :class:`PayloadError`."""
    if not attachment:
        return FrameNote()
    try:
        return from_json(attachment, FrameNote)
    except MessageRefused as error:
        raise PayloadError(f"attachment: {error}") from None


def check_size(size_px: tuple[int, int], expected_px: tuple[int, int]) -> None:
    """Raises :class:`WrongSizeError` unless an image is as large as the camera's, (width, height)."""
    if size_px != expected_px:
        came, right = (f"{width}x{height}" for width, height in (size_px, expected_px))
        raise WrongSizeError(f"{came} pixels; {right} as the camera's calibration says")


def raw_image(payload: bytes, note: FrameNote, expected_px: tuple[int, int]) -> Image:
    """Raw pixels -> H x W, or H x W x 3 (BGR); it may be a read-only view of the payload.

    Raises :class:`PayloadError`.
    """
    if note.width is None or note.height is None or note.encoding is None:
        missing = [name for name in ("width", "height", "encoding") if getattr(note, name) is None]
        raise PayloadError(f"raw pixels without {', '.join(missing)}; all three in the attachment")
    check_size((note.width, note.height), expected_px)
    pixels = ENCODINGS.get(note.encoding)
    if pixels is None:
        raise PayloadError(f"encoding {note.encoding!r}; one of {', '.join(ENCODINGS)}")
    item = pixels.item_bytes
    row = note.width * pixels.channels * item
    step = row if note.step is None else note.step
    if step < row or step % item:
        raise PayloadError(f"step {step}; at least {row} bytes, a multiple of {item}")
    first, more = step * note.height, step * math.ceil((pixels.planes - 1.0) * note.height)
    if len(payload) != first + more:
        planes = f", and {pixels.planes - 1.0:g} times as many" * (pixels.planes != 1.0)
        expected = f"{first + more} ({note.height} rows of {step}{planes})"
        raise PayloadError(f"{len(payload)} bytes; {expected}")
    rows = np.frombuffer(payload[:first], f"<{pixels.dtype}").reshape(note.height, step // item)
    return unpacked(rows, note.width, pixels)


def message_image(message: Any, data: bytes, expected_px: tuple[int, int]) -> Image:
    """``sensor_msgs/Image`` (or Foxglove's) with its ``data`` -> as :func:`raw_image`, in either byte order."""
    pixels = ENCODINGS.get(message.encoding)
    if getattr(message, "is_bigendian", 0) and pixels is not None and len(data) % pixels.item_bytes == 0:
        data = np.frombuffer(data, f">{pixels.dtype}").astype(f"<{pixels.dtype}").tobytes()
    width, height, step = int(message.width), int(message.height), int(message.step)
    return raw_image(data, FrameNote(width=width, height=height, encoding=message.encoding, step=step), expected_px)


def file_image(payload: bytes, expected_px: tuple[int, int]) -> Image:
    """A JPEG -> H x W, its brightness; a PNG -> H x W, or H x W x 3 (BGR); uint8, or uint16 for grey PNGs of 16 bits.

    Its header is compared with ``expected_px``, (width, height), before memory is allocated or a pixel decoded.  This
    uses Pillow, because OpenCV can't read only the header, and writes warnings about damaged files to stderr.  Raises
    :class:`PayloadError`.
    """
    with _damaged("PNG" if payload.startswith(PNG) else "JPEG"):
        if payload.startswith(PNG):
            _check_png(payload)
            with _open_file(payload) as checked:
                check_size(checked.size, expected_px)
                checked.verify()  # the check sums; the file has to be opened again after it
        else:
            _check_jpeg(payload)
        with _open_file(payload) as file:
            check_size(file.size, expected_px)
            return _array_of(file)


def snapshot_image(payload: bytes, stated: SnapshotImage) -> Image:
    """The PNG or JPEG attached to a snapshot -> H x W, or H x W x 3 (BGR), uint8 or uint16.

    Anyone may be the sender, and a few kB may be gigabytes of pixels: its header is compared with the size ``stated``,
    and that with a camera's, before a pixel is decoded.  Raises :class:`PayloadError`.
    """
    import cv2

    size_px = stated.width_px, stated.height_px
    if min(size_px) < SMALLEST_PX or size_px[0] * size_px[1] > MOST_PIXELS:
        right = f"at least {SMALLEST_PX} each way, at most {MOST_PIXELS} in all"
        raise PayloadError(f"{size_px[0]}x{size_px[1]} pixels; {right}")
    if not payload.startswith((JPEG, PNG)):
        raise PayloadError(f"no PNG or JPEG file: it begins with {payload[:8].hex() or 'nothing'}")
    with _damaged("PNG" if payload.startswith(PNG) else "JPEG"):
        if payload.startswith(JPEG):
            _check_jpeg(payload)
        with _open_file(payload) as file:
            check_size(file.size, size_px)
        image = cv2.imdecode(np.frombuffer(payload, np.uint8), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise PayloadError("a damaged file; a whole one")
    return np.asarray(image[:, :, :3] if image.ndim == 3 else image)


def jpeg_in_colour(payload: bytes) -> Image:
    """A JPEG of any size -> H x W x 3 (BGR), uint8.  Raises :class:`PayloadError`."""
    if not payload.startswith(JPEG):
        raise PayloadError(f"no JPEG file: it begins with {payload[:8].hex() or 'nothing'}")
    with _damaged("JPEG"):
        _check_jpeg(payload)
        with _open_file(payload) as file:
            if max(file.size) > LARGEST_PX:
                raise PayloadError(f"a JPEG of {file.width}x{file.height} pixels; at most {LARGEST_PX} each way")
            return np.ascontiguousarray(np.asarray(file.convert("RGB"))[:, :, ::-1])


@contextmanager
def _damaged(kind: str) -> Iterator[None]:
    """Raises :class:`PayloadError` for whatever a decoder raises."""
    try:
        yield
    except PayloadError:
        raise
    except Exception as error:  # noqa: BLE001  a dozen types, by what is damaged
        raise PayloadError(f"damaged {kind} file ({one_line(error)}); a whole one") from None


def _check_jpeg(payload: bytes) -> None:
    if payload.count(b"\xff\xda") > MOST_SCANS:
        raise PayloadError(f"a JPEG of more than {MOST_SCANS} scans; a usual one")
    if (fault := jpeg_fault(payload)) is not None:
        raise PayloadError(f"damaged JPEG file ({fault}); a whole one")


def _open_file(payload: bytes) -> ImageFile:
    """Reads the header.  Only these two classes: Pillow's general ``open`` would try all formats."""
    jpeg, png = _pillow()
    return png(io.BytesIO(payload)) if payload.startswith(PNG) else jpeg(io.BytesIO(payload))


@functools.cache
def _pillow() -> tuple[type[ImageFile], type[ImageFile]]:
    from PIL.JpegImagePlugin import JpegImageFile
    from PIL.PngImagePlugin import PngImageFile

    # Damaged metadata, which is not read here, would give a line on stderr for every frame.
    warnings.filterwarnings("ignore", module=r"PIL\.")
    return JpegImageFile, PngImageFile


def _check_png(payload: bytes) -> None:
    if payload[12:16] != b"IHDR" or len(payload) < 33:
        raise PayloadError("a PNG file without a header; a whole one")
    bits, colour = payload[24], payload[25]
    if bits > 8 and colour != 0:
        raise PayloadError("a PNG file with colours of 16 bits; 8 bits, or grey")


def _array_of(file: ImageFile) -> Image:
    # Only brightness is measured, and a JPEG stores it separately: a fifth of the time for its colours.
    file.draft("L", file.size)
    if file.mode in ("L", "I;16"):
        return np.asarray(file, dtype=np.uint8 if file.mode == "L" else np.uint16)
    if file.mode in ("1", "LA"):
        return np.asarray(file.convert("L"))
    if file.mode in ("RGB", "RGBA", "P"):
        import cv2

        rgb = np.asarray(file if file.mode != "P" else file.convert("RGB"))
        bgr: Image = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR if rgb.shape[2] == 3 else cv2.COLOR_RGBA2BGR)
        return bgr
    raise PayloadError(f"a file of colour mode {file.mode}; grey or RGB")
