"""A target that isn't flat, or whose print isn't exact: errors that all of its images share.

Points that lie beside their places pull a fit the same way in every image, so that its residuals are no independent
errors: their covariance promises too much, and fits to halves of the images agree with each other in what is wrong.
So the points' displacements are unknowns of the fit where the images show them (Strobl and Hirzinger, "More accurate
pinhole camera calibration with imperfect planar target", 2011).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gripmon.calibrate.sighting import Sighting
from gripmon.model.records import Array

UNEVEN, MISPRINTED = 0.01, 0.001
"""Prior standard deviation of a point's displacement out of the target's plane, and within it, over the target's
length: a board of 300 mm that is bent by 3 mm, and a printer that is off by 0.3 mm.  They also fix what images can't
tell: a displacement of all points together is the plate's pose, or its size.
"""
FEWEST_VIEWS = 4
UNEVEN_TARGET = "the target isn't flat and exact"
CHANCE = 1e-4
"""Probability that an exact target is taken for one that isn't."""
_SAME_M = 1e-6


@dataclass(frozen=True, slots=True)
class TargetPoints:
    """The m points of a target, ``places_m`` (m, 3); ``index``: of each view's points (n,), -1 where the image doesn't
    tell which point of the target it is.
    """

    places_m: Array
    index: tuple[NDArray[np.intp], ...]

    @classmethod
    def of(cls, sightings: Sequence[Sighting]) -> TargetPoints | None:
        """None if too few images tell which point is which."""
        whole = [s for s in sightings if s.turns]
        if len(whole) < FEWEST_VIEWS:
            return None
        points = np.concatenate([s.plate_m[:, :2] for s in whole])
        _, first = np.unique(np.rint(points / _SAME_M), axis=0, return_index=True)
        known = points[first]
        # A place between two micrometres may have been rounded to either.
        again = [later for _, later in cKDTree(known).query_pairs(_SAME_M)]
        known = np.delete(known, again, axis=0)
        return cls.numbered(sightings, np.concatenate([known, np.zeros((len(known), 1))], axis=1))

    @classmethod
    def numbered(cls, sightings: Sequence[Sighting], places_m: Array) -> TargetPoints:
        """The points of these views among those at known places."""
        unnumbered = cls(places_m, ())
        index = [unnumbered.numbers(s.plate_m) if s.turns else np.full(len(s), -1, np.intp) for s in sightings]
        return cls(places_m, tuple(index))

    def numbers(self, plate_m: Array) -> NDArray[np.intp]:
        """Of the points at these places (n, 3); -1 where it has none."""
        away, number = cKDTree(self.places_m[:, :2]).query(plate_m[:, :2], distance_upper_bound=_SAME_M)
        return np.where(np.isfinite(away), number, -1).astype(np.intp)

    def turned(self, turns: int, number: int) -> Array:
        """(4, 4): the ``number``-th of so many turns by which the target comes to lie on itself."""
        angle, middle = 2.0 * np.pi * number / turns, 0.5 * (self.places_m.min(axis=0) + self.places_m.max(axis=0))[:2]
        cosine, sine = float(np.rint(np.cos(angle))), float(np.rint(np.sin(angle)))
        out = np.eye(4)
        out[:2, :2] = [[cosine, -sine], [sine, cosine]]
        out[:2, 3] = middle - out[:2, :2] @ middle
        return out

    @property
    def unknowns(self) -> int:
        """How many displacements images can tell: without those of a pose and of the size."""
        return 3 * len(self.places_m) - 7

    @property
    def information(self) -> Array:
        """(m, 3), 1/m²: of the prior."""
        length_m = float(np.linalg.norm(np.ptp(self.places_m, axis=0)))
        return np.tile(1.0 / np.square(length_m * np.array([MISPRINTED, MISPRINTED, UNEVEN])), (len(self.places_m), 1))

    def displaced(self, sightings: Sequence[Sighting], displacement_m: Array) -> list[Sighting]:
        """The sightings with their points where they are, given the displacement (m, 3) of each."""
        at = np.vstack([displacement_m, np.zeros(3)])
        return [replace(s, plate_m=s.plate_m + at[k]) for s, k in zip(sightings, self.index, strict=True)]


def off_plane_m(places_m: Array, displacement_m: Array) -> float:
    """How far the points lie off the plane that fits them best, at most (m)."""
    points = places_m + displacement_m
    points = points - points.mean(axis=0)
    normal = np.linalg.svd(points, full_matrices=False)[2][2]
    return float(np.abs(points @ normal).max())
