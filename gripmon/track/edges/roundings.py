"""Where two edges of an outline meet in a rounding that is small in this view: seen like a corner.

The outline of a tip that is rounded towards the camera is straight, and so are its sides; of the rounding between them
a few pixels show.  Nothing is intersected there for a pose: what counts is that both edges reach the rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.model.gripper import Gripper
from gripmon.model.records import Array
from gripmon.track.edges.prediction import FEWEST_SAMPLES, Prediction


@dataclass(frozen=True, slots=True)
class Rounding:
    """One in a prediction: where its two edges' tangents meet, ``meet_px`` (2,); of each edge its last profile before
    the rounding (``ends``), the way (2, 2) in which it would go on, and its profiles beside the rounding (``beside``).
    """

    edges: frozenset[int]
    meet_px: Array
    ends: tuple[int, int]
    ways: Array
    beside: tuple[NDArray[np.intp], NDArray[np.intp]]


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
        corners = set(gripper.corner_points.tolist())
        self._meeting: dict[int, tuple[int, int]] = {}
        for point in sorted(set(gripper.edge_points[outline].ravel().tolist()) - corners):
            edges = np.flatnonzero(outline & (gripper.edge_points == point).any(axis=1)).tolist()
            if len(edges) == 2:
                self._meeting[point] = edges[0], edges[1]
        self.point = np.array([p for p, pair in self._meeting.items() if not along[list(pair)].all()], dtype=np.intp)

    def seen_in(self, prediction: Prediction) -> dict[int, Rounding]:
        """Those that this view has, by number (0 to r - 1), each pair of edges once."""
        out: dict[int, Rounding] = {}
        known: set[frozenset[int]] = set()
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
        if not (passed or also or self._gripper.edge_curved[[one, other]].any()):
            return None  # two edges that end in a point which the file doesn't take for a corner
        uv_px = prediction.uv_px
        ways = np.stack([self._way(prediction, profiles) for profiles in (own, others)])
        sine = float(ways[0, 0] * ways[1, 1] - ways[0, 1] * ways[1, 0])
        if abs(float(ways[0] @ ways[1])) > self._cosine or not abs(sine) > 0.0:
            return None
        gap = uv_px[others[0]] - uv_px[own[0]]
        ahead_px = np.array(
            [gap[0] * ways[1, 1] - gap[1] * ways[1, 0], gap[0] * ways[0, 1] - gap[1] * ways[0, 0]]
        ) / sine  # fmt: skip
        if not ((ahead_px >= 0.0) & (ahead_px <= self._reach_px)).all():
            return None
        meet_px = uv_px[own[0]] + ahead_px[0] * ways[0]
        beside = tuple(self._beside(uv_px, profiles) for profiles in (own, others))
        return Rounding(frozenset((one, other)), meet_px, (int(own[0]), int(others[0])), ways, (beside[0], beside[1]))

    def _sampled(self, prediction: Prediction, point: int, edge: int) -> tuple[int, NDArray[np.intp], bool] | None:
        """The first edge that is looked at on the way from a point along an edge, its profiles from there on, and
        whether others that are too short lie between.
        """
        layout, ends = prediction.layout, self._gripper.edge_points
        for passed in range(len(ends)):
            at_start = bool(ends[edge, 0] == point)
            if prediction.profiles[edge] >= FEWEST_SAMPLES:
                profiles = np.flatnonzero((layout.edge == edge) & prediction.ok)
                return edge, profiles if at_start else profiles[::-1], passed > 0
            point = int(ends[edge, 1 if at_start else 0])
            if point not in self._meeting:
                return None
            one, other = self._meeting[point]
            edge = other if one == edge else one
        return None

    @staticmethod
    def _way(prediction: Prediction, profiles: NDArray[np.intp]) -> Array:
        """(2,) the way in which an edge goes on towards the rounding."""
        normal = prediction.normal[profiles[0]]
        way = np.array([-normal[1], normal[0]])
        return way if way @ (prediction.uv_px[profiles[0]] - prediction.uv_px[profiles[1]]) > 0.0 else -way

    def _beside(self, uv_px: Array, profiles: NDArray[np.intp]) -> NDArray[np.intp]:
        near = np.linalg.norm(uv_px[profiles] - uv_px[profiles[0]], axis=1) < self._reach_px
        near[:FEWEST_SAMPLES] = True
        return profiles[near]
