"""Drawing over an enlarged image: places in its pixels, lines in parts of a pixel, letters that stay readable."""

from __future__ import annotations

import itertools

import cv2
import numpy as np

from gripmon.model.records import Array, Image
from gripmon.track.edges.profiles import full_scale

Colour = tuple[int, int, int]
"""Blue, green, red."""

_SHIFT = 4  # binary digits of a pixel in OpenCV's drawing
_FONT = cv2.FONT_HERSHEY_SIMPLEX


class Canvas:
    """An image ``zoom`` times as large: ``picture`` (h, w, 3), BGR of 8 bits."""

    def __init__(self, image: Image, zoom: int) -> None:
        scaled = image.astype(np.float32) * (255.0 / full_scale(image))
        grey = cv2.cvtColor(scaled, cv2.COLOR_BGR2GRAY) if scaled.ndim == 3 else scaled
        large = cv2.resize(np.clip(grey, 0.0, 255.0).astype(np.uint8), None, fx=zoom, fy=zoom)
        self.picture: Image = cv2.cvtColor(large, cv2.COLOR_GRAY2BGR)
        self.zoom = zoom

    def circle(self, at_px: Array, radius_px: float, colour: Colour) -> None:
        """``radius_px`` in the picture's own pixels."""
        (centre,) = self._fixed(at_px).tolist()
        cv2.circle(self.picture, centre, round(radius_px * (1 << _SHIFT)), colour, 1, cv2.LINE_AA, _SHIFT)

    def line(self, points_px: Array, colour: Colour, thickness: int = 1) -> None:
        """Through points (n, 2)."""
        cv2.polylines(self.picture, [self._fixed(points_px)], False, colour, thickness, cv2.LINE_AA, _SHIFT)

    def pixel(self, at_px: Array) -> tuple[int, int]:
        """The place in the picture's own pixels."""
        u, v = np.rint((np.asarray(at_px) + 0.5) * self.zoom - 0.5).astype(int).tolist()
        return u, v

    def _fixed(self, points_px: Array) -> Array:
        """(n, 2) in OpenCV's fixed-point coordinates of the picture."""
        own = (np.reshape(points_px, (-1, 2)) + 0.5) * self.zoom - 0.5
        return np.rint(own * (1 << _SHIFT)).astype(np.int32)


def write(picture: Image, text: str, at: tuple[int, int], colour: Colour, size: float) -> None:
    """With a dark outline, of the same weight: thicker letters are wider.  OpenCV's font knows ASCII only."""
    plain = text.encode("ascii", "replace").decode()
    for right, down in (*itertools.product((-1, 0, 1), repeat=2), (0, 0)):
        paint = colour if right == down == 0 else (0, 0, 0)
        cv2.putText(picture, plain, (at[0] + right, at[1] + down), _FONT, size, paint, 1, cv2.LINE_AA)


def text_size(text: str, size: float) -> tuple[int, int]:
    """Width and height, px."""
    (across, up), _ = cv2.getTextSize(text, _FONT, size, 1)
    return int(across), int(up)


def enlargement(largest_px: float, to_px: float) -> int:
    """A round number by which to enlarge what is to be seen: the largest is then at most ``to_px`` long."""
    return max((k for k in (1, 2, 5, 10, 20, 50, 100, 200, 500) if k * largest_px <= to_px), default=1)
