"""Curved edges: smooth curves through points, stored as their offset from the straight line between the two ends."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gripmon.model.gripper.model import GripperError
from gripmon.model.records import Array

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

SHORTEST_PIECE_M = 1e-5
"""Minimum distance of a curve's points, m: points closer than a file's digits resolve are the same point."""


class Curves:
    """A gripper's curved edges, each a cubic spline over the arc length of the polyline through its points.

    A fraction of such an edge is a fraction of that length.  Fingers don't rotate, so that a curve keeps its shape at
    every opening.
    """

    def __init__(self, points_m: Sequence[Array | None], names: Sequence[str]):
        """``points_m``: all points (n, 3) of each edge in turn, gripper frame; None for a straight one."""
        self.curved: NDArray[np.bool_] = np.array([p is not None for p in points_m], dtype=bool)
        self._bulges = {
            i: _bulge(points, names[i]) for i, points in enumerate(points_m) if points is not None
        }  # fmt: skip
        self.bend_rad: Array = np.zeros(len(points_m))
        """(e,) largest angle between an edge and the straight line between its two ends."""
        for i, points in enumerate(points_m):
            if points is not None:
                self.bend_rad[i] = _bend_rad(self._bulges[i], points[-1] - points[0])

    def bulge_m(self, edge: NDArray[np.intp], fraction: Array) -> tuple[Array, Array]:
        """Offset (n, 3) from the straight line between the two ends at fractions (n,) of edges (n,), gripper frame, and
        its derivative (n, 3) by the fraction; zero on straight edges.
        """
        bulge, rate = np.zeros((2, len(edge), 3))
        for i, spline in self._bulges.items():
            own = np.flatnonzero(edge == i)
            bulge[own], rate[own] = spline(fraction[own]), spline(fraction[own], 1)
        return bulge, rate


def _bend_rad(bulge: CubicSpline, chord_m: Array) -> float:
    """Largest angle of the curve's tangents from its chord (3,), at places between its points."""
    at = np.linspace(0.0, 1.0, 4 * len(bulge.x) + 1)
    ways = chord_m + bulge(at, 1)
    cosines = ways @ chord_m / (np.linalg.norm(ways, axis=1) * np.linalg.norm(chord_m))
    return float(np.arccos(np.clip(cosines.min(), -1.0, 1.0)))


def _bulge(points_m: Array, name: str) -> CubicSpline:
    """Spline through the points (n, 3) less the chord from first to last, over the fraction of the length."""
    from scipy.interpolate import CubicSpline  # takes half a second: only for a gripper that has a curve

    length_m = np.linalg.norm(np.diff(points_m, axis=0), axis=1)
    if not (length_m > SHORTEST_PIECE_M).all():
        raise GripperError(f"edges.{name}.via: two points in turn are the same; different points along the edge")
    fraction = np.concatenate([[0.0], np.cumsum(length_m)]) / length_m.sum()
    fraction[-1] = 1.0
    straight = points_m[0] + fraction[:, None] * (points_m[-1] - points_m[0])
    return CubicSpline(fraction, points_m - straight)
