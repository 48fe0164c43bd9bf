"""Raw pixels as cameras send them, by ROS's names of their formats, and 16-bit ones of which they fill a part."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Frame, Image, Refusal

BLUE, GREEN, RED = 0.114, 0.587, 0.299
"""Luma weights of ITU-R BT.601."""

GREY_BGR = np.array([BLUE, GREEN, RED], dtype=np.float32)
"""The same in OpenCV's channel order."""


class Pixels(NamedTuple):
    """How a pixel lies in memory.  ``only`` is the one channel that is kept, ``conversion`` OpenCV's name of the way to
    BGR; neither where nothing is to be done.
    """

    channels: int
    dtype: str
    conversion: str | None = None
    only: int | None = None

    @property
    def item_bytes(self) -> int:
        """Of one channel."""
        return int(self.dtype[1])


def _bayer() -> dict[str, Pixels]:
    # Both ROS and OpenCV name the first two pixels of the first two rows here; OpenCV's short names don't.
    patterns = ("rggb", "bggr", "gbrg", "grbg")
    return {f"bayer_{p}{8 * n}": Pixels(1, f"u{n}", f"COLOR_Bayer{p.upper()}2BGR") for p in patterns for n in (1, 2)}


ENCODINGS: dict[str, Pixels] = {
    "mono8": Pixels(1, "u1"),
    "mono16": Pixels(1, "u2"),
    "8UC1": Pixels(1, "u1"),
    "16UC1": Pixels(1, "u2"),
    "32FC1": Pixels(1, "f4"),
    "bgr8": Pixels(3, "u1"),
    "bgr16": Pixels(3, "u2"),
    "rgb8": Pixels(3, "u1", "COLOR_RGB2BGR"),
    "rgb16": Pixels(3, "u2", "COLOR_RGB2BGR"),
    "bgra8": Pixels(4, "u1", "COLOR_BGRA2BGR"),
    "rgba8": Pixels(4, "u1", "COLOR_RGBA2BGR"),
    # Brightness alone: it is all that is measured.
    "yuv422_yuy2": Pixels(2, "u1", only=0),
    "yuv422": Pixels(2, "u1", only=1),
    **_bayer(),
}
"""Formats of raw pixels, named as in ROS 2."""


def unpacked(rows: NDArray[Any], width: int, pixels: Pixels) -> Image:
    """H x W, or H x W x 3 (BGR), of rows (H, n) of channels in any byte order, what is beyond ``width`` pixels left
    out; it may be a view of them.
    """
    image = rows[:, : width * pixels.channels]
    if pixels.channels > 1:
        image = image.reshape(len(rows), width, pixels.channels)
    if pixels.only is not None:
        image = image[:, :, pixels.only]
    # In the machine's own byte order, of which OpenCV knows no other.
    image = np.ascontiguousarray(image, dtype=f"={pixels.dtype}")
    if pixels.conversion is None:
        return image
    import cv2

    converted: Image = cv2.cvtColor(image, getattr(cv2, pixels.conversion))
    return converted


def in_full_scale(frame: Frame, bit_depth: int) -> Frame:
    """The frame with 16-bit grey levels up to 65535, of an image whose camera fills only the lowest ``bit_depth`` of
    the 16 bits; without an image, and a fault that says why, where it holds more than these.

    An image that this has been done to stays as it is, as a recorded one.
    """
    image = frame.image
    if bit_depth == 16 or not isinstance(image, np.ndarray) or image.dtype != np.uint16 or not image.size:
        return frame
    # A look at some of them spares most images the whole comparison.
    if all(np.array_equal(part, _filled(_levels(part, bit_depth), bit_depth)) for part in (image[::16, ::16], image)):
        return frame
    brightest, top = int(image.max()), (1 << bit_depth) - 1
    if brightest > top:
        fault = f"grey level {brightest}; at most {top} with monitor.bit_depth {bit_depth}"
        return replace(frame, image=None, refusal=Refusal.WRONG_TYPE, fault=fault)
    return replace(frame, image=_filled(image, bit_depth))


def _levels(image: NDArray[Any], bit_depth: int) -> NDArray[Any]:
    """The high bits of grey levels in full scale."""
    return np.asarray(image >> (16 - bit_depth), dtype=np.uint16)


def _filled(levels: NDArray[Any], bit_depth: int) -> NDArray[Any]:
    """Grey levels of so many bits in 16: the high bits again as the low ones, so that the brightest becomes 65535."""
    return np.asarray((levels << (16 - bit_depth)) | (levels >> (2 * bit_depth - 16)), dtype=np.uint16)
