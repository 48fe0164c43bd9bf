"""A frame as a picture for people: a part of its image with lines, points and rings over it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Image

Colour = tuple[int, int, int]
"""Blue, green, red."""

_SUBPIXEL_BITS = 4
_RING_PX = 5


class Line(NamedTuple):
    """A polyline (n, 2), px of the whole image, the first pixel's centre at 0."""

    points_px: Any
    colour: Colour
    thickness: int = 1


class Marks(NamedTuple):
    """Points (n, 2): dots, or rings."""

    points_px: Any
    colour: Colour
    rings: bool = False


def jpeg(
    image: Image, lines: Iterable[Line], marks: Iterable[Marks], width_px: int, quality: int,
    box: tuple[int, int, int, int] | None = None,
) -> bytes:  # fmt: skip
    """JPEG of an image (h, w) or (h, w, 3) BGR of 8 bits, ``width_px`` wide; of its part ``box`` (left, top, right,
    bottom), or all of it.  Points that aren't finite aren't drawn.
    """
    left, top, right, bottom = box or (0, 0, image.shape[1], image.shape[0])
    part = image[top:bottom, left:right]
    scale = width_px / part.shape[1]
    size = (width_px, max(round(scale * part.shape[0]), 1))
    canvas = cv2.resize(part, size, interpolation=cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC)
    canvas = cv2.cvtColor(canvas, cv2.COLOR_GRAY2BGR) if canvas.ndim == 2 else canvas

    def placed(points_px: Any) -> NDArray[np.int32]:
        """The first pixel's centre is at 0 in both images."""
        moved = (np.reshape(np.asarray(points_px, float), (-1, 2)) - (left, top) + 0.5) * scale - 0.5
        moved = moved[np.isfinite(moved).all(axis=1) & (np.abs(moved) < 1e5).all(axis=1)]
        return np.round(moved * 2**_SUBPIXEL_BITS).astype(np.int32)

    for line in lines:
        if len(points := placed(line.points_px)) > 1:
            cv2.polylines(canvas, [points], False, line.colour, line.thickness, cv2.LINE_AA, _SUBPIXEL_BITS)
    for each in marks:
        radius, thickness = (_RING_PX, 2) if each.rings else (2, -1)
        for x, y in placed(each.points_px).tolist():
            cv2.circle(canvas, (x, y), radius << _SUBPIXEL_BITS, each.colour, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)
    return bytes(cv2.imencode(".jpg", canvas, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes())
