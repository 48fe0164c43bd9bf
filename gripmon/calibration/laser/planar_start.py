"""Steps 2 and 3 of the closed form, better: all orientations share one plane, and wrong spots are left out.

On a plane with the normal n the spots are ``s = ray / (nᵀ ray)`` up to the plane's distance, and shifts without turning
move them linearly: ``s = T + B w``.  For each n that is a linear fit of eight unknowns an orientation, where the direct
linear transformation of the print (equations (15) to (18)) has eleven and finds n only afterwards; n itself is sought
over the half sphere of what a camera can see.  Wrong spots are found by least trimmed squares over small subsets
(Rousseeuw, 1984).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.calibration.laser.setup import basis
from gripmon.calibration.sighting import CalibrationError
from gripmon.records import Array

WIDEST_TILT_RAD = np.radians(75.0)
RINGS = 9
"""Normals that are tried: rings of tilts against the optical axis."""
SUBSET = 5
"""Spots that determine an orientation's fit, with one to spare: four do."""
MOST_SUBSETS = 60
BELIEVED = 0.6
"""Part of an orientation's spots that are believed at first."""
OUTLIER = 4.0
"""Residual, in robust standard deviations, beyond which a spot has no part in its orientation's fit."""
SEED = 0
"""Of the subsets that are drawn where there are too many."""
_STEPS = 20


@dataclass(frozen=True, slots=True)
class PlanarStart:
    """``normal`` (3,), unit, away from the camera; one matrix (3, 4) an orientation with ``s = matrix [w 1]``; ``good``
    (n,) which spots the fits rest on.
    """

    normal: Array
    matrices: tuple[Array, ...]
    good: NDArray[np.bool_]


class _Group:
    """Spots of one orientation with what doesn't depend on the plane."""

    def __init__(self, rays: Array, shifts_m: Array, rng: np.random.Generator):
        self.rays = rays
        self.scale = float(np.linalg.norm(shifts_m, axis=1).mean())
        self.design = np.concatenate([shifts_m / self.scale, np.ones((len(rays), 1))], axis=1)
        self.subsets = _subsets(self.design, rng)
        # (b, k, SUBSET): what each subset predicts for all spots.
        self.predictors = self.design @ np.linalg.pinv(self.design[self.subsets])

    def trimmed(self, normals: Array) -> tuple[Array, NDArray[np.intp]]:
        """For each normal (m, 3) the least sum (m,) of the believed part of squared residuals, and whose subset."""
        spots = self.rays / (normals @ self.rays.T)[:, :, None]  # (m, k, 3)
        predicted = np.einsum("bks,mbsi->mbki", self.predictors, spots[:, self.subsets])
        # As angles, so that far spots count no more than near ones.
        depth = np.linalg.norm(spots, axis=2)[:, None, :]
        squares = np.square(predicted - spots[:, None]).sum(axis=3) / np.square(depth)
        kept = max(int(np.ceil(BELIEVED * len(self.rays))), SUBSET + 1)
        sums = np.partition(squares, kept - 1, axis=2)[:, :, :kept].sum(axis=2)
        sums = np.where(np.isfinite(sums), sums, np.inf)
        best = sums.argmin(axis=1)
        return np.take_along_axis(sums, best[:, None], axis=1)[:, 0], best

    def residuals(self, normal: Array, good: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Matrix (4, 3) that fits the good spots, and residuals (k, 3) of all as angles."""
        spots = self.rays / (self.rays @ normal)[:, None]
        fit = np.linalg.lstsq(self.design[good], spots[good], rcond=None)[0]
        return fit, (spots - self.design @ fit) / np.linalg.norm(spots, axis=1)[:, None]


def planar_start(
    xy: Array, shifts_m: Sequence[Array], members: Sequence[NDArray[np.intp]], *, robust: bool = True, seed: int = SEED
) -> PlanarStart:
    """From ideal image points (n, 2) and, for each orientation, its spots' indices and shifts (k, 3).  Without
    ``robust`` all spots are believed.

    Raises :class:`CalibrationError` where no plane before the camera explains the spots.
    """
    rng = np.random.default_rng(seed)
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    groups = [_Group(rays[m], w, rng) for m, w in zip(members, shifts_m, strict=True)]
    normals = _half_sphere()
    # Only planes that all spots lie on before the camera.
    normals = normals[(rays @ normals.T > 0.02).all(axis=0)]
    if not len(normals):
        raise CalibrationError("no plane before the camera carries all spots; spots and camera of one set-up")
    if robust:
        costs = np.sum([group.trimmed(normals)[0] for group in groups], axis=0)
        normal = normals[int(costs.argmin())]
        good = _believed(groups, normal)
    else:
        good = [np.ones(len(group.rays), dtype=bool) for group in groups]
        costs = np.array([sum(np.square(g.residuals(n, p)[1]).sum() for g, p in zip(groups, good, strict=True))
                          for n in normals])  # fmt: skip
        normal = normals[int(costs.argmin())]
    for _ in range(3 if robust else 1):
        normal = _descend(groups, normal, good, rays)
        good = _consistent(groups, normal, good) if robust else good
    matrices = []
    for group, part in zip(groups, good, strict=True):
        fit, _ = group.residuals(normal, part)
        matrix = fit.T.copy()
        matrix[:, :3] /= group.scale
        matrices.append(matrix)
    used = np.zeros(len(xy), dtype=bool)
    for index, part in zip(members, good, strict=True):
        used[index[part]] = True
    return PlanarStart(normal, tuple(matrices), used)


def _believed(groups: Sequence[_Group], normal: Array) -> list[NDArray[np.bool_]]:
    """Spots near what the best subset predicts, by one robust scale over all orientations."""
    sizes = []
    for group in groups:
        _, best = group.trimmed(normal[None])
        spots = group.rays / (group.rays @ normal)[:, None]
        predicted = group.predictors[int(best[0])] @ spots[group.subsets[int(best[0])]]
        sizes.append(np.linalg.norm(predicted - spots, axis=1) / np.linalg.norm(spots, axis=1))
    # Subsets fit themselves too well: the scale comes from the upper middle of what is believed.
    scale = float(np.quantile(np.concatenate(sizes), BELIEVED)) + 1e-12
    out = []
    for size in sizes:
        part = size <= 2.5 * scale
        if part.sum() < SUBSET:
            part = size <= np.sort(size)[SUBSET - 1]
        out.append(part)
    return out


def _consistent(groups: Sequence[_Group], normal: Array, good: Sequence[NDArray[np.bool_]]) -> list[NDArray[np.bool_]]:
    """Spots near what the fits of the good ones predict, by their median residual over all orientations."""
    sizes = [np.linalg.norm(g.residuals(normal, part)[1], axis=1) for g, part in zip(groups, good, strict=True)]
    believed = np.concatenate([size[part] for size, part in zip(sizes, good, strict=True)])
    unknowns = 8 * len(groups) + 2
    # A fit takes its unknowns' share of the noise away.
    left = np.sqrt(max(1.0 - unknowns / (2.0 * len(believed)), 0.1))
    limit = OUTLIER * float(np.median(believed)) / 1.1774 / left + 1e-12
    return [size <= limit if (size <= limit).sum() >= SUBSET else part for size, part in zip(sizes, good, strict=True)]


def _descend(groups: Sequence[_Group], normal: Array, good: Sequence[NDArray[np.bool_]], rays: Array) -> Array:
    """Gauss-Newton in the normal's two angles; each orientation's fit follows (Golub and Pereyra, 1973)."""

    def residuals(n: Array) -> Array:
        return np.concatenate([g.residuals(n, part)[1][part].ravel() for g, part in zip(groups, good, strict=True)])

    step = 1e-6
    for _ in range(_STEPS):
        a, b = basis(normal)
        here = residuals(normal)
        slopes = np.stack(
            [
                (residuals(_unit(normal + step * t)) - residuals(_unit(normal - step * t))) / (2.0 * step)
                for t in (a, b)
            ],
            axis=1,
        )
        change = -np.linalg.lstsq(slopes, here, rcond=None)[0]
        for _ in range(12):
            trial = _unit(normal + change[0] * a + change[1] * b)
            if (rays @ trial > 0.0).all() and np.square(residuals(trial)).sum() <= np.square(here).sum():
                break
            change = 0.5 * change
        else:
            return normal
        normal = trial
        if np.abs(change).max() < 1e-9:
            break
    return normal


def _half_sphere() -> Array:
    out = [np.array([0.0, 0.0, 1.0])]
    for ring in range(1, RINGS + 1):
        tilt = WIDEST_TILT_RAD * ring / RINGS
        count = max(6, round(2.0 * np.pi * np.sin(tilt) * RINGS / WIDEST_TILT_RAD))
        angle = 2.0 * np.pi * np.arange(count) / count
        out += list(
            np.stack([np.sin(tilt) * np.cos(angle), np.sin(tilt) * np.sin(angle), np.full(count, np.cos(tilt))], 1)
        )
    return np.array(out)


def _subsets(design: Array, rng: np.random.Generator) -> NDArray[np.intp]:
    """(b, SUBSET) spots whose shifts span space; drawn at random where there are too many."""
    count = len(design)
    total = list(itertools.combinations(range(count), SUBSET)) if count <= 10 else []
    drawn = np.array(total, dtype=np.intp) if total else rng.random((4 * MOST_SUBSETS, count)).argsort()[:, :SUBSET]
    spread = np.linalg.svd(design[drawn], compute_uv=False)
    drawn = drawn[spread[:, 3] > 0.1 * spread[:, 0]] if (spread[:, 3] > 0.1 * spread[:, 0]).any() else drawn[:1]
    return drawn[rng.permutation(len(drawn))[:MOST_SUBSETS]]


def _unit(vector: Array) -> Array:
    out: Array = vector / np.linalg.norm(vector)
    return out
