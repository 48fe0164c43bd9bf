"""Pictures before, at and after an event, with what was measured in them."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from gripmon.record.read import Picture

_WIDTH_PX = 560  # of a picture on the page
_MARGIN = 0.18  # of the gripper's size, around it
_SMALLEST = 0.35  # of the image's width: less is no picture of the scene
_JPEG_QUALITY = 82
_SUBPIXEL_BITS = 4
_BGR = tuple[int, int, int]
PREDICTED: _BGR = (255, 200, 60)
USED: _BGR = (120, 235, 70)
REFUSED: _BGR = (70, 70, 255)
CORNER: _BGR = (60, 225, 255)
BEFORE: _BGR = (255, 255, 255)


class Looked(NamedTuple):
    """A picture, and whether what was measured in it was believed: else none of its points is shown as such."""

    picture: Picture
    believed: bool


@dataclass(frozen=True, slots=True)
class Shown:
    """A picture as it stands on the page: ``uri`` is a JPEG in a data URI."""

    seq: int
    uri: str
    width_px: int
    height_px: int


def together(looked: Sequence[Looked | None]) -> tuple[Shown | None, ...]:
    """Pictures in order of time, any may be None, cut to the same part of the image; into the later ones the gripper's
    place in the first one is drawn, too, in white.
    """
    there = [each.picture for each in looked if each is not None]
    if not there:
        return tuple(None for _ in looked)
    height, width = there[0].image.shape[:2]
    box = _box([points for picture in there for points in _points(picture)], width, height)
    first = looked[0]
    outline = () if first is None else tuple(first.picture.predicted_edges)
    return tuple(None if each is None else _shown(each, box, () if each is first else outline) for each in looked)


def _points(picture: Picture) -> list[NDArray[np.float32]]:
    return [*picture.predicted_edges, picture.edges_used, _corners(picture)]


def _corners(picture: Picture) -> NDArray[np.float32]:
    """(n, 2) those that were measured and used."""
    found = [corner.uv_px for corner in picture.corners if corner.uv_px is not None and corner.used]
    return np.array(found, np.float32).reshape(-1, 2)


def _box(points: Sequence[NDArray[np.float32]], width: int, height: int) -> tuple[int, int, int, int]:
    """Left, top, right, bottom: around the gripper in the image's own proportions; the whole image without one."""
    finite = [p.reshape(-1, 2)[np.isfinite(p.reshape(-1, 2)).all(axis=1)] for p in points]
    joined = np.concatenate([*finite, np.empty((0, 2))])
    inside = joined[(joined >= 0.0).all(axis=1) & (joined[:, 0] < width) & (joined[:, 1] < height)]
    if len(inside) < 3:
        return 0, 0, width, height
    low, high = inside.min(axis=0), inside.max(axis=0)
    share = max(*((high - low) * (1.0 + 2.0 * _MARGIN) / (width, height)), _SMALLEST)
    if share >= 0.9:
        return 0, 0, width, height
    size = np.round(share * np.array([width, height])).astype(int)
    corner = np.clip(np.round(0.5 * (low + high) - 0.5 * size).astype(int), 0, (width, height) - size)
    return int(corner[0]), int(corner[1]), int(corner[0] + size[0]), int(corner[1] + size[1])


def _shown(looked: Looked, box: tuple[int, int, int, int], outline: Sequence[NDArray[np.float32]]) -> Shown | None:
    left, top, right, bottom = box
    picture, believed = looked
    crop = _bgr8(picture.image)[top:bottom, left:right]
    if not crop.size:
        return None
    scale = _WIDTH_PX / (right - left)
    size = (_WIDTH_PX, max(round(scale * (bottom - top)), 1))
    canvas = cv2.resize(crop, size, interpolation=cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC)

    def place(points: NDArray[np.float32]) -> NDArray[np.int32]:
        """The first pixel's centre is 0 in both images."""
        moved = (points.reshape(-1, 2) - (left, top) + 0.5) * scale - 0.5
        moved = moved[np.isfinite(moved).all(axis=1) & (np.abs(moved) < 1e5).all(axis=1)]
        return np.round(moved * 2**_SUBPIXEL_BITS).astype(np.int32)

    for strips, colour, thickness in ((outline, BEFORE, 2), (picture.predicted_edges, PREDICTED, 1)):
        polylines = [place(strip) for strip in strips]
        cv2.polylines(
            canvas, [p for p in polylines if len(p) > 1], False, colour, thickness, cv2.LINE_AA, _SUBPIXEL_BITS
        )
    for points, colour, radius in (
        (picture.edges_used, USED if believed else REFUSED, 2),
        (picture.edges_refused, REFUSED, 2),
        (_corners(picture)[: None if believed else 0], CORNER, 5),
    ):
        for x, y in place(points).tolist():
            filled = -1 if radius < 5 else 2
            cv2.circle(canvas, (x, y), radius << _SUBPIXEL_BITS, colour, filled, cv2.LINE_AA, _SUBPIXEL_BITS)
    done, encoded = cv2.imencode(".jpg", canvas, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    if not done:
        return None
    text = base64.b64encode(encoded.tobytes()).decode("ascii")
    return Shown(int(picture.seq), f"data:image/jpeg;base64,{text}", *size)


def _bgr8(image: NDArray[Any]) -> NDArray[Any]:
    """Grey or BGR of any depth -> BGR of 8 bits."""
    if image.dtype == np.uint16:
        image = (image >> 8).astype(np.uint8)
    elif image.dtype != np.uint8:
        image = np.clip(np.nan_to_num(image) * 255.0, 0.0, 255.0).astype(np.uint8)
    return cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else np.ascontiguousarray(image[:, :, :3])
