"""Roundings between two edges of an outline that are small in this view, and seen like corners.

The outline of a tip that is rounded towards the camera is straight, and so are its sides; the rounding between them
covers a few pixels.  No intersection is measured there: what counts is that both edges reach the rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.model.gripper import Gripper
from gripmon.model.records import Array
from gripmon.track.edges.prediction import FEWEST_SAMPLES, Prediction


class GoesOn(NamedTuple):
    """A tangent to the edge of a ``profile`` where it is beyond another edge: place (2,), px, and unit way (2,)."""

    profile: int
    from_px: Array
    way: Array


@dataclass(frozen=True, slots=True)
class Rounding:
    """A rounding in a prediction: its two ``edges``, the search lines of each ``beside`` it, outwards from it, and
    their continuations ``go_on`` beyond it.
    """

    edges: frozenset[int]
    beside: tuple[NDArray[np.intp], NDArray[np.intp]]
    go_on: tuple[GoesOn, ...]


def crossing(
    prediction: Prediction, profiles: NDArray[np.intp], at_px: Array, way: Array, cosine: float
) -> GoesOn | None:
    """Continuation of an edge, by the tangent at the last of its ``profiles``, across a line through ``at_px`` (2,)
    along the unit ``way`` (2,): as a straight border would go on.  The ``profiles`` are ordered outwards from the line.
    None where it doesn't cross the line, or nearly parallel to it, ``cosine`` that of the smallest angle.
    """
    last = int(profiles[-1])
    tangent = _tangent(prediction, last, prediction.uv_px[profiles[0]])
    ahead_px = _ahead_px(prediction.uv_px[last], tangent, at_px, way)
    if abs(float(tangent @ way)) > cosine or not ahead_px[0] > 0.0:
        return None
    return GoesOn(last, prediction.uv_px[last] + ahead_px[0] * tangent, tangent)


def _tangent(prediction: Prediction, profile: int, towards_px: Array) -> Array:
    """(2,) the edge's direction at a search line, towards a place (2,)."""
    normal = prediction.normal[profile]
    way = np.array([-normal[1], normal[0]])
    return way if way @ (towards_px - prediction.uv_px[profile]) > 0.0 else -way


def _ahead_px(one_px: Array, one: Array, other_px: Array, other: Array) -> Array:
    """(2,) how far two places (2,) have to go along their unit ways (2,) to meet; infinite if these are parallel."""
    gap, sine = other_px - one_px, float(one[0] * other[1] - one[1] * other[0])
    if sine == 0.0:
        return np.full(2, np.inf)
    return np.array([gap[0] * other[1] - gap[1] * other[0], gap[0] * one[1] - gap[1] * one[0]]) / sine


class Roundings:
    """The points of one gripper at which two outlines go on in each other without a corner, not both of them along the
    fingers; ``point`` (r,).
    """

    def __init__(self, gripper: Gripper, along: NDArray[np.bool_], reach_px: float, cosine: float) -> None:
        """``reach_px``: so far from the rounding an edge is looked at, and so near to it both have to be seen;
        ``cosine``: of the smallest angle between the two.
        """
        self._gripper, self._reach_px, self._cosine = gripper, reach_px, cosine
        outline = ~gripper.edge_crease
        # Points at the same place are one: of these one may wander over what is round, and another stay.
        _, same = np.unique(gripper.points_grip_m(), axis=0, return_inverse=True)
        _, first = np.unique(same, return_index=True)
        one = first[same.ravel()]
        self._ends, self._corners = one[gripper.edge_points], set(one[gripper.corner_points].tolist())
        self._meeting: dict[int, tuple[int, int]] = {}
        for point in sorted(set(self._ends[outline].ravel().tolist())):
            edges = np.flatnonzero(outline & (self._ends == point).any(axis=1)).tolist()
            if len(edges) == 2:
                self._meeting[point] = edges[0], edges[1]
        self.point = np.array([p for p, pair in self._meeting.items() if not along[list(pair)].all()], dtype=np.intp)

    def seen_in(self, prediction: Prediction, known: set[frozenset[int]]) -> dict[int, Rounding]:
        """Those that this view has, by number (0 to r - 1), each pair of edges once and none that is ``known``."""
        out: dict[int, Rounding] = {}
        known = set(known)
        for number, point in enumerate(self.point.tolist()):
            rounding = self._at(prediction, point)
            if rounding is not None and rounding.edges not in known:
                known.add(rounding.edges)
                out[number] = rounding
        return out

    def _at(self, prediction: Prediction, point: int) -> Rounding | None:
        """None where an edge is out of view, where they are nearly parallel or opposite, and where they aren't both
        seen near to where they meet.
        """
        found = [self._sampled(prediction, point, edge) for edge in self._meeting[point]]
        if found[0] is None or found[1] is None or found[0][0] == found[1][0]:
            return None
        (one, own, passed), (other, others, also) = found[0], found[1]
        # A corner is seen as one, unless an edge at it is too short to be measured in this view.
        turns = point not in self._corners and self._gripper.edge_curved[[one, other]].any()
        if not (passed or also or turns):
            return None  # two edges that end in a point which the file doesn't take for a corner
        uv_px = prediction.uv_px
        first = [int(own[0]), int(others[0])]
        ways = [_tangent(prediction, k, 2.0 * uv_px[k] - uv_px[after]) for k, after in ((own[:2]), (others[:2]))]
        ahead_px = _ahead_px(uv_px[first[0]], ways[0], uv_px[first[1]], ways[1])
        near = ((ahead_px >= 0.0) & (ahead_px <= self._reach_px)).all()
        if abs(float(ways[0] @ ways[1])) > self._cosine or not near:
            return None
        meet_px = uv_px[first[0]] + ahead_px[0] * ways[0]
        beside = self._beside(uv_px, own), self._beside(uv_px, others)
        straight = [GoesOn(k, meet_px, way) for k, way in zip(first, ways, strict=True)]
        curved = [
            crossing(prediction, beside[k], meet_px, ways[1 - k], self._cosine)
            for k, edge in enumerate((one, other))
            if self._gripper.edge_curved[edge]
        ]
        return Rounding(frozenset((one, other)), beside, (*straight, *(each for each in curved if each is not None)))

    def _sampled(self, prediction: Prediction, point: int, edge: int) -> tuple[int, NDArray[np.intp], bool] | None:
        """The first edge that is looked at on the way from a point along an edge, its search lines from there on, and
        whether others that are too short lie between.
        """
        layout, ends = prediction.layout, self._ends
        for passed in range(len(ends)):
            at_start = bool(ends[edge, 0] == point)
            if prediction.profiles[edge] >= FEWEST_SAMPLES:
                profiles = np.flatnonzero((layout.edge == edge) & prediction.ok)
                return edge, profiles if at_start else profiles[::-1], passed > 0
            point = int(ends[edge, 1 if at_start else 0])
            if point not in self._meeting or not layout.visible[edge]:
                return None
            one, other = self._meeting[point]
            edge = other if one == edge else one
        return None

    def _beside(self, uv_px: Array, profiles: NDArray[np.intp]) -> NDArray[np.intp]:
        near = np.linalg.norm(uv_px[profiles] - uv_px[profiles[0]], axis=1) < self._reach_px
        near[:FEWEST_SAMPLES] = True
        return profiles[near]
