"""Raw pixels as cameras send them, named as in ROS, and 16-bit pixels of which the camera uses only part."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.model.images import decoded
from gripmon.model.records import Frame, Image, Refusal

BLUE, GREEN, RED = 0.114, 0.587, 0.299
"""Luma weights of ITU-R BT.601."""

_LUMA_WHITE = 235  # of BT.601: brighter light is cut off there, which has to be the end of the grey levels, too
_GREY_OF_LUMA = np.rint(np.minimum(np.arange(256), _LUMA_WHITE) * (255.0 / _LUMA_WHITE)).astype(np.uint8)

GREY_BGR = np.array([BLUE, GREEN, RED], dtype=np.float32)
"""The same weights in OpenCV's channel order."""


class Pixels(NamedTuple):
    """Memory layout of a pixel.  ``only`` is the one channel that is kept, ``conversion`` OpenCV's name of the
    conversion to BGR; both are None if nothing has to be done.  ``planes``: bytes in all as a multiple of the first
    plane's, the only one that is used.
    """

    channels: int
    dtype: str
    conversion: str | None = None
    only: int | None = None
    planes: float = 1.0

    @property
    def item_bytes(self) -> int:
        """Bytes of one channel."""
        return int(self.dtype[1])


def _bayer() -> dict[str, Pixels]:
    # ROS and OpenCV's long names both name the first two pixels of the first two rows; OpenCV's short names don't.
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
    # OpenCV's types of several channels are in its order.
    "8UC3": Pixels(3, "u1"),
    "16UC3": Pixels(3, "u2"),
    "rgb8": Pixels(3, "u1", "COLOR_RGB2BGR"),
    "rgb16": Pixels(3, "u2", "COLOR_RGB2BGR"),
    **{name: Pixels(4, "u1", "COLOR_BGRA2BGR") for name in ("bgra8", "8UC4")},
    **{name: Pixels(4, "u2", "COLOR_BGRA2BGR") for name in ("bgra16", "16UC4")},
    "rgba8": Pixels(4, "u1", "COLOR_RGBA2BGR"),
    "rgba16": Pixels(4, "u2", "COLOR_RGBA2BGR"),
    # Keep only the luma, white at the end of the range: it is all that is measured.
    **{name: Pixels(2, "u1", only=0) for name in ("yuv422_yuy2", "yuyv")},
    **{name: Pixels(2, "u1", only=1) for name in ("yuv422", "uyvy")},
    **{name: Pixels(1, "u1", only=0, planes=1.5) for name in ("nv12", "nv21")},
    "nv24": Pixels(1, "u1", only=0, planes=3.0),
    **_bayer(),
}
"""Raw pixel formats, named as in ROS 2."""


def unpacked(rows: NDArray[Any], width: int, pixels: Pixels) -> Image:
    """H x W, or H x W x 3 (BGR), from rows (H, n) of channels in any byte order, without what lies beyond ``width``
    pixels; it may be a view of ``rows``.
    """
    image = rows[:, : width * pixels.channels]
    if pixels.channels > 1:
        image = image.reshape(len(rows), width, pixels.channels)
        image = image if pixels.only is None else image[:, :, pixels.only]
    # OpenCV handles only the machine's own byte order.
    image = np.ascontiguousarray(image, dtype=f"={pixels.dtype}")
    if pixels.only is None and pixels.conversion is None:
        return image
    import cv2

    if pixels.conversion is None:
        return np.asarray(cv2.LUT(image, _GREY_OF_LUMA))
    return np.asarray(cv2.cvtColor(image, getattr(cv2, pixels.conversion)))


def without_mosaic(image: Image, data: bytes, said: str) -> Image:
    """A picture (H, W) in colour if it is a Bayer sensor's mosaic, by the ``format`` of a ``CompressedImage``: that of
    ``compressed_image_transport``, ``bayer_rggb8; png compressed ``, where a conversion before it is named at the end.
    A file whose ``data`` have colours was converted, whatever it is called.
    """
    encoding, _, how = said.partition(";")
    pixels = ENCODINGS.get(f"{encoding.strip().rstrip('0123456789')}{8 * image.itemsize}")
    if pixels is None or not encoding.startswith("bayer_") or len(how.split()) > 2:
        return image
    import cv2

    own, _ = decoded(data, cv2.IMREAD_UNCHANGED)
    return image if own is None or own.ndim != 2 else unpacked(own, own.shape[1], pixels)


def in_full_scale(frame: Frame, bit_depth: int) -> Frame:
    """The frame with 16-bit grey levels scaled to 65535, for a camera that fills only the lowest ``bit_depth`` of the
    16 bits; if the image holds larger values, the frame without image and with a fault that gives the reason.

    An image that was scaled already, for example a recorded one, stays as it is.
    """
    image = frame.image
    if bit_depth == 16 or not isinstance(image, np.ndarray) or image.dtype != np.uint16 or not image.size:
        return frame
    # Checking a subsample first spares most images the full comparison.
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
    """``bit_depth``-bit grey levels as 16 bits: the high bits are repeated as the low ones, so that white is 65535."""
    return np.asarray((levels << (16 - bit_depth)) | (levels >> (2 * bit_depth - 16)), dtype=np.uint16)


def to_8_bit(image: NDArray[np.generic]) -> NDArray[np.uint8]:
    """uint16 by its upper byte, float from 0..1; for display only, so values out of range and NaN are clipped."""
    if image.dtype == np.uint8:
        return image.astype(np.uint8, copy=False)
    if image.dtype == np.uint16:
        return (image.astype(np.uint16, copy=False) >> 8).astype(np.uint8)
    scaled = np.nan_to_num(image.astype(np.float32, copy=False) * np.float32(255.0), nan=0.0)
    return np.clip(np.rint(scaled), 0.0, 255.0).astype(np.uint8)
