"""The plane that laser spots lie on, from how they move as the end-effector is shifted; wrong spots are left out."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from gripmon.calibrate.sighting import CalibrationError
from gripmon.laser.setup import basis
from gripmon.model.least_squares import Equations, minimise, normal_equations
from gripmon.model.records import Array

WIDEST_TILT_RAD = np.radians(75.0)
SPACING_RAD = np.radians(15.0)
"""Spacing of the normals that are tried first; it is halved around the best ones."""
HALVINGS = 2
MOST_BEST = 4
"""Number of best normals around which the search is refined."""
LEAST_DEPTH = 0.02
"""Minimum ``nᵀ ray`` for a spot in front of the camera."""
SUBSET = 5
"""Number of spots in a subset that determines an orientation's fit: four would do, one is redundant."""
MOST_SUBSETS = 60
BELIEVED = 0.6
"""Share of an orientation's spots that count as inliers at first."""
OUTLIER = 4.0
"""Residual, in robust standard deviations, above which a spot is left out of its orientation's fit."""
SEED = 0
"""Seed for drawing subsets where there are too many."""
_STEPS = 20


class _Group:
    """Spots of one orientation, with everything that doesn't depend on the plane."""

    def __init__(self, rays: Array, shifts_m: Array, rng: np.random.Generator):
        self.rays = rays
        self.scale = float(np.linalg.norm(shifts_m, axis=1).mean())
        self.design = np.concatenate([shifts_m / self.scale, np.ones((len(rays), 1))], axis=1)
        self._rng = rng

    @functools.cached_property
    def subsets(self) -> NDArray[np.intp]:
        """Index subsets (b, SUBSET)."""
        return _subsets(self.design, self._rng)

    @functools.cached_property
    def _predictors(self) -> NDArray[np.float32]:
        """(b, k, SUBSET): each subset's prediction of all spots.  Single precision: only the ranking depends on it."""
        return (self.design @ np.linalg.pinv(self.design[self.subsets])).astype(np.float32)

    def trimmed(self, normals: Array) -> tuple[Array, NDArray[np.intp]]:
        """For each normal (m, 3) the least trimmed sum (m,) of squared residuals, and the subset that gives it."""
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


class _Fits:
    """Fits of all orientations for any normal, from the inlier spots (n,); orientations are padded to one length, so
    that they are computed at once.
    """

    def __init__(self, groups: Sequence[_Group], good: Sequence[NDArray[np.bool_]]):
        shape = (len(groups), max(len(group.rays) for group in groups))
        self._there, self._good = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
        self._rays, self._design = np.tile([0.0, 0.0, 1.0], (*shape, 1)), np.zeros((*shape, 4))
        for k, (group, part) in enumerate(zip(groups, good, strict=True)):
            count = len(group.rays)
            self._there[k, :count], self._good[k, :count] = True, part
            self._rays[k, :count], self._design[k, :count] = group.rays, group.design
        self._inverse = np.linalg.pinv(self._design * self._good[:, :, None])
        self._ends = np.cumsum([len(group.rays) for group in groups])[:-1]

    def matrices(self, normal: Array) -> Array:
        """Matrices (M, 4, 3)."""
        out: Array = self._inverse @ self._spots(normal)
        return out

    def carries(self, normal: Array) -> bool:
        """Whether all inlier spots lie in front of the camera."""
        return bool((self._rays[self._good] @ normal > 0.0).all())

    def residuals(self, normal: Array) -> list[Array]:
        """Residuals (k, 3) of all spots per orientation, as angles; infinite behind the camera."""
        spots = self._spots(normal)
        values = (spots - self._design @ (self._inverse @ spots)) / np.linalg.norm(spots, axis=2)[:, :, None]
        values[self._rays @ normal <= 0.0] = np.inf
        return np.split(values[self._there], self._ends)

    def slopes(self, normal: Array, tangents: tuple[Array, Array]) -> tuple[Array, Array]:
        """Residuals (r,) of the inlier spots and their derivatives (r, 2) along two tangents of the normal, with the
        linear fits eliminated (variable projection; Golub and Pereyra, 1973).
        """
        spots = self._spots(normal)
        length = np.linalg.norm(spots, axis=2)[:, :, None]
        misses = spots - self._design @ (self._inverse @ spots)
        out = []
        for tangent in tangents:
            along = (spots @ tangent)[:, :, None]
            change = -spots * along  # of s = ray / (nᵀ ray)
            out.append((change - self._design @ (self._inverse @ change) + misses * along) / length)
        return (misses / length)[self._good].ravel(), np.stack([d[self._good].ravel() for d in out], axis=1)

    def _spots(self, normal: Array) -> Array:
        depth = self._rays @ normal
        out: Array = self._rays / np.where(np.abs(depth) > 1e-9, depth, 1e-9)[:, :, None]
        return out


def planar_start(
    xy: Array, shifts_m: Sequence[Array], members: Sequence[NDArray[np.intp]], *, robust: bool = True, seed: int = SEED
) -> tuple[Array, list[Array]]:
    """From ideal image points (n, 2) and, for each orientation, its spots' indices and shifts (k, 3): the plane's
    normal (3,), unit, away from the camera, and a matrix (3, 4) for each orientation with ``s = matrix [w 1]``.
    Without ``robust`` all spots count as inliers.

    Raises :class:`CalibrationError` if no plane in front of the camera explains the spots.
    """
    rng = np.random.default_rng(seed)
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    groups = [_Group(rays[m], w, rng) for m, w in zip(members, shifts_m, strict=True)]
    if robust:
        normal = _sought(lambda normals: np.sum([group.trimmed(normals)[0] for group in groups], axis=0))
        good = _believed(groups, normal)
    else:
        good = [np.ones(len(group.rays), dtype=bool) for group in groups]
        normal = _sought(functools.partial(_sums, _Fits(groups, good)))
    for _ in range(3 if robust else 1):
        normal = _descend(_Fits(groups, good), normal)
        before, good = good, _consistent(groups, normal, good) if robust else good
        if all((one == other).all() for one, other in zip(before, good, strict=True)):
            break
    matrices = []
    for group, fit in zip(groups, _Fits(groups, good).matrices(normal), strict=True):
        matrix = fit.T.copy()
        matrix[:, :3] /= group.scale
        matrices.append(matrix)
    return normal, matrices


def _sums(fits: _Fits, normals: Array) -> Array:
    """Sums of squared residuals (m,) for each normal (m, 3)."""
    return np.array([sum(np.square(r).sum() for r in fits.residuals(n)) for n in normals])


def _sought(costs_of: Callable[[Array], Array]) -> Array:
    """The normal (3,) with the least cost: over the half sphere, then around the best at half the spacing."""
    normals, spacing = _half_sphere(), SPACING_RAD
    costs = costs_of(normals)
    for _ in range(HALVINGS):
        best = costs.argsort()[:MOST_BEST]
        spacing = 0.5 * spacing
        around = _around(normals[best], spacing)
        around = around[around[:, 2] > np.cos(WIDEST_TILT_RAD)]
        normals = np.concatenate([normals[best], around])
        costs = np.concatenate([costs[best], costs_of(around)])
    if not np.isfinite(costs).any():
        raise CalibrationError("no plane before the camera carries the spots; spots and camera of one set-up")
    out: Array = normals[int(costs.argmin())]
    return out


def _believed(groups: Sequence[_Group], normal: Array) -> list[NDArray[np.bool_]]:
    """Inliers near the best subset's prediction, by one robust scale over all orientations."""
    sizes = []
    for group in groups:
        _, best = group.trimmed(normal[None])
        subset = np.zeros(len(group.rays), dtype=bool)
        subset[group.subsets[int(best[0])]] = True
        sizes.append(np.linalg.norm(_Fits([group], [subset]).residuals(normal)[0], axis=1))
    # Subsets fit themselves too well: take the scale from the largest residual of the inlier share.
    scale = float(np.quantile(np.concatenate(sizes), BELIEVED)) + 1e-12
    out = []
    for size in sizes:
        part = size <= 2.5 * scale
        if part.sum() < SUBSET:
            part = size <= np.sort(size)[SUBSET - 1]
        out.append(part)
    return out


def _consistent(groups: Sequence[_Group], normal: Array, good: Sequence[NDArray[np.bool_]]) -> list[NDArray[np.bool_]]:
    """Inliers near the prediction of the inliers' fits, by their median residual over all orientations."""
    sizes = [np.linalg.norm(values, axis=1) for values in _Fits(groups, good).residuals(normal)]
    believed = np.concatenate([size[part] for size, part in zip(sizes, good, strict=True)])
    unknowns = 8 * len(groups) + 2
    # A fit reduces its residuals by the share of its unknowns.
    left = np.sqrt(max(1.0 - unknowns / (2.0 * len(believed)), 0.1))
    limit = OUTLIER * float(np.median(believed)) / 1.1774 / left + 1e-12
    return [size <= limit if (size <= limit).sum() >= SUBSET else part for size, part in zip(sizes, good, strict=True)]


def _descend(fits: _Fits, normal: Array) -> Array:
    """The best normal near a start: least squares in its two angles."""

    def cost(at: Array) -> float:
        here, _ = fits.slopes(at, basis(at))
        return float(here @ here) if fits.carries(at) else np.inf

    def equations(at: Array) -> Equations:
        here, slopes = fits.slopes(at, basis(at))
        return normal_equations(slopes, -here)

    def moved(at: Array, step: Array) -> Array:
        out: Array = at + step @ basis(at)
        return out / np.linalg.norm(out)

    return minimise(normal, cost, equations, moved, iterations=_STEPS, damping=1e-9).state


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
    drawn = drawn[spread[:, 3] > 0.1 * spread[:, 0]] if (spread[:, 3] > 0.1 * spread[:, 0]).any() else drawn[:1]
    return drawn[rng.permutation(len(drawn))[:MOST_SUBSETS]]
