"""Steps 2 and 3 of the closed form with wrong spots among the measured: the plane's normal, and a matrix for each
orientation.

The plane's spots are ``s = ray / (nᵀ ray)``, up to the plane's distance; with the right normal n each orientation's
move linearly with the end-effector's shift w, equation (15): ``s = matrix [w 1]``.  So n is sought by how well that
holds, over all normals that a camera can see, and of each orientation's spots the worst are not counted.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from gripmon.calibrate.sighting import CalibrationError
from gripmon.laser.setup import basis
from gripmon.model.records import Array

WIDEST_TILT_RAD = np.radians(75.0)
SPACING_RAD = np.radians(15.0)
"""Spacing of the normals that are tried first; it is halved around the best ones."""
MOST_BEST = 4
"""Number of best normals around which others are tried."""
LEAST_DEPTH = 0.02
"""Minimum ``nᵀ ray`` for a spot in front of the camera."""
SUBSET = 5
"""Number of spots in a subset that determines an orientation's matrix: four would do, one is redundant."""
MOST_SUBSETS = 60
BELIEVED = 0.6
"""Share of an orientation's spots that are counted."""
OUTLIER = 2.5
"""Residual, over the largest of those counted, above which a spot has no part in its orientation's matrix."""
SEED = 0
"""Seed for drawing subsets where there are too many."""


class _Orientation:
    """Spots of one orientation, with everything that doesn't depend on the plane."""

    def __init__(self, rays: Array, shifts_m: Array, rng: np.random.Generator):
        self.rays = rays
        self.scale = float(np.linalg.norm(shifts_m, axis=1).mean())
        self.design = np.concatenate([shifts_m / self.scale, np.ones((len(rays), 1))], axis=1)
        self.subsets = _subsets(self.design, rng)
        # (b, k, SUBSET): each subset's prediction of all spots.  Single precision: only the ranking depends on it.
        self._predictors = (self.design @ np.linalg.pinv(self.design[self.subsets])).astype(np.float32)

    def trimmed(self, normals: Array) -> tuple[Array, NDArray[np.intp]]:
        """For each normal (m, 3) the least sum (m,) of the squared residuals that are counted, and its subset."""
        depth = normals @ self.rays.T
        before = depth > LEAST_DEPTH
        depth = np.where(before, depth, 1.0)
        # All spots have the same coordinate along the normal: two coordinates suffice.
        flat = np.stack([t @ self.rays.T / depth for t in _across(normals)], axis=2)  # (m, k, 2)
        columns = flat.transpose(1, 0, 2).reshape(len(self.rays), -1).astype(np.float32)
        misses = (self._predictors @ columns[self.subsets] - columns).reshape(-1, *columns.shape[:1], len(normals), 2)
        # As angles, so that far spots have the same weight as near ones.
        size = np.square(depth / np.linalg.norm(self.rays, axis=1))
        squares = np.where(before, np.einsum("bkmi,bkmi,mk->bmk", misses, misses, size.astype(np.float32)), np.inf)
        kept = max(int(np.ceil(BELIEVED * len(self.rays))), SUBSET + 1)
        sums = np.partition(squares, kept - 1, axis=2)[:, :, :kept].sum(axis=2)
        sums[~before[:, self.subsets].all(axis=2).T] = np.inf
        best = sums.argmin(axis=0)
        return sums[best, np.arange(len(normals))], best

    def spots(self, normal: Array) -> Array:
        """(k, 3)."""
        depth = self.rays @ normal
        out: Array = self.rays / np.where(depth > LEAST_DEPTH, depth, LEAST_DEPTH)[:, None]
        return out

    def matrix(self, normal: Array, used: NDArray[Any]) -> Array:
        """(4, 3), by least squares over the ``used`` spots."""
        out: Array = np.linalg.lstsq(self.design[used], self.spots(normal)[used], rcond=None)[0]
        return out

    def residuals(self, normal: Array, used: NDArray[Any]) -> Array:
        """(k, 3) of all spots against the ``used`` ones' fit, as angles."""
        spots = self.spots(normal)
        out: Array = (spots - self.design @ self.matrix(normal, used)) / np.linalg.norm(spots, axis=1)[:, None]
        return out


def find_plane(
    xy: Array, shifts_m: Sequence[Array], members: Sequence[NDArray[np.intp]], *, robust: bool = True, seed: int = SEED
) -> tuple[Array, list[Array]]:
    """From ideal image points (n, 2) and, for each orientation, its spots' indices and shifts (k, 3): the plane's
    normal (3,), unit, camera axes, away from the camera, and each orientation's matrix (3, 4).  Without ``robust`` all
    spots are counted.

    Raises :class:`CalibrationError` if no plane in front of the camera carries the spots.
    """
    rng = np.random.default_rng(seed)
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    orientations = [_Orientation(rays[m], w, rng) for m, w in zip(members, shifts_m, strict=True)]
    normals = _half_sphere()
    for _ in range(2):
        costs = np.sum([o.trimmed(normals)[0] for o in orientations], axis=0)
        if not np.isfinite(costs).any():
            raise CalibrationError("no plane before the camera carries the spots; spots and camera of one set-up")
        best = normals[costs.argsort()[:MOST_BEST]]
        normals = np.concatenate([best, _around(best, 0.5 * SPACING_RAD)])
    normal = best[0]
    used = _believed(orientations, normal) if robust else [np.ones(len(o.rays), dtype=bool) for o in orientations]
    normal = _settled(orientations, used, normal)
    matrices = []
    for orientation, part in zip(orientations, used, strict=True):
        matrix = orientation.matrix(normal, part).T
        matrix[:, :3] /= orientation.scale
        matrices.append(matrix)
    return normal, matrices


def _believed(orientations: Sequence[_Orientation], normal: Array) -> list[NDArray[np.bool_]]:
    """Spots near their best subset's prediction, by one scale for all orientations."""
    sizes = []
    for orientation in orientations:
        best = orientation.subsets[int(orientation.trimmed(normal[None])[1][0])]
        sizes.append(np.linalg.norm(orientation.residuals(normal, best), axis=1))
    limit = OUTLIER * float(np.quantile(np.concatenate(sizes), BELIEVED)) + 1e-12
    return [size <= max(limit, float(np.sort(size)[SUBSET - 1])) for size in sizes]


def _settled(orientations: Sequence[_Orientation], used: Sequence[NDArray[np.bool_]], start: Array) -> Array:
    """The normal near a start with the least residuals of the used spots, each orientation's matrix following it."""
    tangents = np.stack(basis(start))

    def normal_at(tilt: Array) -> Array:
        out: Array = start + tilt @ tangents
        return out / np.linalg.norm(out)

    def residuals(tilt: Array) -> Array:
        at = normal_at(tilt)
        return np.concatenate([o.residuals(at, part)[part].ravel() for o, part in zip(orientations, used, strict=True)])

    return normal_at(least_squares(residuals, np.zeros(2), x_scale=SPACING_RAD, xtol=1e-15, ftol=1e-15, gtol=1e-15).x)


def _half_sphere() -> Array:
    out = [np.array([0.0, 0.0, 1.0])]
    for ring in range(1, round(WIDEST_TILT_RAD / SPACING_RAD) + 1):
        tilt = SPACING_RAD * ring
        count = max(6, round(2.0 * np.pi * np.sin(tilt) / SPACING_RAD))
        angle = 2.0 * np.pi * np.arange(count) / count
        out += list(
            np.stack([np.sin(tilt) * np.cos(angle), np.sin(tilt) * np.sin(angle), np.full(count, np.cos(tilt))], 1)
        )
    return np.array(out)


def _around(normals: Array, angle_rad: float) -> Array:
    """Six directions (6 m, 3) at an angle from each of (m, 3)."""
    a, b = _across(normals)
    turns = np.radians(60.0 * np.arange(6))[:, None, None]
    out: Array = np.cos(angle_rad) * normals + np.sin(angle_rad) * (np.cos(turns) * a + np.sin(turns) * b)
    return out.reshape(-1, 3)


def _across(normals: Array) -> tuple[Array, Array]:
    """Two unit vectors (m, 3) each that are orthogonal to the normals (m, 3) and to each other."""
    a = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)])
    a /= np.linalg.norm(a, axis=1)[:, None]
    return a, np.cross(normals, a)


def _subsets(design: Array, rng: np.random.Generator) -> NDArray[np.intp]:
    """(b, SUBSET) spots whose shifts span space; drawn at random if there are too many."""
    count = len(design)
    total = list(itertools.combinations(range(count), SUBSET)) if count <= 10 else []
    drawn = np.array(total, dtype=np.intp) if total else rng.random((4 * MOST_SUBSETS, count)).argsort()[:, :SUBSET]
    spread = np.linalg.svd(design[drawn], compute_uv=False)
    spans = spread[:, 3] > 0.1 * spread[:, 0]
    drawn = drawn[spans] if spans.any() else drawn[:1]
    return drawn[rng.permutation(len(drawn))[:MOST_SUBSETS]]
