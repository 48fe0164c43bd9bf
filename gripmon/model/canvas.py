"""An image to draw on: positions in its own pixels, lines and circles to parts of a pixel of the enlarged picture."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.pixels import to_8_bit
from gripmon.model.records import Array, Image

Colour = tuple[int, int, int]
"""Blue, green, red."""

_LARGEST_ZOOM, _LEAST_BESIDE_PX = 8, 20.0
_SHIFT = 4  # fractional bits of a pixel in OpenCV's drawing functions


class Canvas:
    """An image (h, w[, 3]), or the part of it from ``origin_px`` on, enlarged by ``zoom``: ``picture`` (h, w, 3), BGR
    of 8 bits, grey unless its ``colours`` are kept.  The first pixel's centre is at 0; points that aren't finite, or
    far away, aren't drawn.
    """

    def __init__(
        self, image: Image, zoom: float, origin_px: tuple[int, int] = (0, 0), *, colours: bool = False
    ) -> None:
        self.zoom, self._origin_px = zoom, np.array(origin_px)
        image = to_8_bit(image)
        if image.ndim == 3 and not colours:
            image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        way = cv2.INTER_AREA if zoom < 1.0 else cv2.INTER_CUBIC
        large = cv2.resize(image, None, fx=zoom, fy=zoom, interpolation=way)
        self.picture: Image = large if large.ndim == 3 else cv2.cvtColor(large, cv2.COLOR_GRAY2BGR)

    @classmethod
    def about(cls, image: Image, points_px: Array, width_px: int) -> Canvas:
        """The part of an image around points (n, 2), with as much beside them as they take, some ``width_px`` wide: of
        fingers of 30 px nothing can be seen in a whole image.
        """
        height, width = image.shape[:2]
        low, high = points_px.min(axis=0), points_px.max(axis=0)
        beside = max(float((high - low).max()) / 2.0, _LEAST_BESIDE_PX)
        left, top = np.maximum(np.floor(low - beside), 0.0).astype(int).tolist()
        right, bottom = np.minimum(np.ceil(high + beside) + 1.0, (width, height)).astype(int).tolist()
        zoom = int(np.clip(-(-width_px // max(right - left, 1)), 1, _LARGEST_ZOOM))
        return cls(image[top:bottom, left:right], zoom, (left, top))

    def circle(self, at_px: Any, radius_px: float, colour: Colour, thickness: int = 1) -> None:
        """Draw circles about points (2,) or (n, 2), discs with a negative thickness; ``radius_px`` in the picture's own
        pixels.
        """
        for centre in self._fixed(at_px).tolist():
            radius = round(radius_px * (1 << _SHIFT))
            cv2.circle(self.picture, centre, radius, colour, thickness, cv2.LINE_AA, _SHIFT)

    def line(self, points_px: Any, colour: Colour, thickness: int = 1) -> None:
        """Draw a line through points (n, 2)."""
        if len(fixed := self._fixed(points_px)) > 1:
            cv2.polylines(self.picture, [fixed], False, colour, thickness, cv2.LINE_AA, _SHIFT)

    def pixel(self, at_px: Array) -> tuple[int, int]:
        """The position in the picture's own pixels."""
        u, v = np.rint(self._enlarged(at_px)[0]).astype(int).tolist()
        return u, v

    def jpeg(self, quality: int) -> bytes:
        """The picture as a file's content; ``quality`` in percent."""
        return bytes(cv2.imencode(".jpg", self.picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes())

    def _enlarged(self, points_px: Any) -> Array:
        points = np.reshape(np.asarray(points_px, float), (-1, 2))
        return np.asarray((points - self._origin_px + 0.5) * self.zoom - 0.5)

    def _fixed(self, points_px: Any) -> NDArray[np.int32]:
        """Points (n, 2) in OpenCV's fixed-point coordinates of the picture."""
        own = self._enlarged(points_px)
        own = own[np.isfinite(own).all(axis=1) & (np.abs(own) < 1e5).all(axis=1)]
        return np.rint(own * (1 << _SHIFT)).astype(np.int32)
