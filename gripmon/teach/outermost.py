"""Whether something of the gripper lies outside of what is measured as its outline.

Between two faces of a finger there is a border too, often with more contrast than the outline has: a dark front beside
a side that the same light makes as bright as the background.  Grey levels don't tell which one is the outline, as those
of a face change with the light.  But beyond the outline no edge stays, and what lies there is open to where edges come
and go.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array
from gripmon.model.staying import Bits, Edges
from gripmon.teach.silhouette import Stations
from gripmon.teach.straight_pieces import LEAST_USABLE, SHORTEST_PIECE_PX

BESIDE_PX = 2.5
"""Distance beyond an edge from which another one is told from it: three sigmas of a blur of 0.8 px."""
BEYOND_PX = 8.0
"""Distance within which the outermost edge is measured instead: a search line's reach."""
GRADIENT_BLUR_PX = 1.5
"""Blur of an edge where edges that stay are looked for: two filters of a pixel."""
TAIL = 3.0
"""Blurs from an edge at which nothing of it is left: a 90th of its slope, less than what counts as an edge."""
OPENING_PX = 3.0
"""Radius of a disc that reaches what is background between edges that stay: it doesn't pass gaps that the length of the
shortest piece hides."""
LEAST_ALIKE = 0.5
"""Least part of a background in which edges come and go, over that of all: a face has shadows, but nothing passes."""
_ALONG_RAD = np.radians(30.0)
_NEIGHBOURS = 9
_STEP_PX = 0.5


class Outside:
    """What the images' ``edges`` show beside what stays, ``still`` (h, w)."""

    def __init__(self, edges: Edges, still: Bits) -> None:
        self._scale = np.array(edges.share.shape[::-1]) / np.array(still.shape[::-1])
        self._stays, self._across_rad = _without_specks(edges.stays), edges.across_rad
        self._stays_near = np.asarray(edges.share > edges.limit)
        self._open = self._opened(edges, still)

    def _opened(self, edges: Edges, still: Bits) -> Bits:
        """The background (h, w) of the edges' size, as far as a disc reaches it."""
        own = cv2.resize(still.astype(np.uint8), edges.share.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
        radius = OPENING_PX * float(self._scale[0])
        free = (cv2.distanceTransform((~self._stays).astype(np.uint8), cv2.DIST_L2, 5) > radius) & ~own
        count, labels = cv2.connectedComponents(free.astype(np.uint8), connectivity=4)
        area = np.bincount(labels.ravel(), minlength=count)
        changing = np.bincount(labels.ravel(), edges.changing.ravel(), minlength=count)
        least = LEAST_ALIKE * float(changing[1:].sum()) / max(int(area[1:].sum()), 1)
        background = changing >= least * area
        background[0] = False
        away = cv2.distanceTransform((~background[labels]).astype(np.uint8), cv2.DIST_L2, 5)
        return np.asarray(away <= radius + _half_diagonal(radius))

    def is_free(self, stations: Stations, offset_px: Array, blur_px: float) -> NDArray[np.bool_]:
        """Whether nothing stays beyond edges of a blur at ``offset_px`` (s,) along the stations' normals, where
        background begins.
        """
        is_open = self._at(self._open, stations.uv_px + (offset_px + 2.0 * BESIDE_PX)[:, None] * stations.normal)
        from_px = TAIL * math.hypot(blur_px, GRADIENT_BLUR_PX)
        return is_open & (self._farthest(self._stays_near, stations, offset_px, from_px) == 0.0)

    def beyond_px(self, stations: Stations, offset_px: Array) -> Array:
        """How far (s,) beyond edges at ``offset_px`` (s,) the outermost edge along them is that stays; 0 where there is
        none.
        """
        return self._farthest(self._stays, stations, offset_px, BESIDE_PX)

    def _farthest(self, stays: Bits, stations: Stations, offset_px: Array, from_px: float) -> Array:
        """How far (s,) beyond ``offset_px`` something along an edge stays, ``from_px`` at least; 0 for nothing."""
        away = np.arange(from_px, BEYOND_PX + 0.5 * _STEP_PX, _STEP_PX)
        places = stations.uv_px[:, None] + (offset_px[:, None] + away)[..., None] * stations.normal[:, None]
        normal_rad = np.arctan2(stations.normal[:, 1], stations.normal[:, 0])
        along = np.abs(np.cos(self._at(self._across_rad, places) - normal_rad[:, None])) > np.cos(_ALONG_RAD)
        found = np.where(self._at(stays, places) & along, away, 0.0).max(axis=1, initial=0.0)
        # By chance an edge is there at a few stations.
        padded = np.pad(found > 0.0, _NEIGHBOURS // 2, mode="wrap")
        around = np.lib.stride_tricks.sliding_window_view(padded, _NEIGHBOURS)
        return np.where(around.mean(axis=1) >= LEAST_USABLE, found, 0.0)

    def _at(self, plane: NDArray[Any], uv_px: Array) -> NDArray[Any]:
        """The values of a plane of the edges' size at places (..., 2) of the images."""
        height, width = plane.shape
        at = np.rint((uv_px + 0.5) * self._scale - 0.5).astype(int)
        return plane[np.clip(at[..., 1], 0, height - 1), np.clip(at[..., 0], 0, width - 1)]


def _half_diagonal(radius: float) -> float:
    """How far a disc in a square corner stays from it, beyond its radius."""
    return (2.0**0.5 - 1.0) * radius


def _without_specks(stays: Bits) -> Bits:
    """Edges (h, w) of fewer pixels than the shortest piece has are chance."""
    count, labels = cv2.connectedComponents(stays.astype(np.uint8), connectivity=8)
    enough = np.bincount(labels.ravel(), minlength=count) >= SHORTEST_PIECE_PX
    enough[0] = False
    return np.asarray(enough[labels])
