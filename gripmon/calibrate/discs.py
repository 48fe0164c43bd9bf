"""Discs on a lattice, and their centres; any part of a plate of them, dark on light or light on dark."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gripmon.calibrate.grey_levels import Grey, to_bytes
from gripmon.calibrate.lattice import Index, find_lattice, fits, trimmed
from gripmon.model.records import Array

SMALLEST_PX = 4.0
"""Minimum diameter of a disc."""
LEAST_ROUNDNESS = 0.88
"""Minimum area of a blob over that of the ellipse with the same moments (the maximum is its inverse)."""
LEAST_AXIS_RATIO = 0.2
"""Minimum ratio of the axes of a disc's ellipse."""
MOST_BLOBS = 4000
LARGE_PX = 1600
"""Images larger than this are searched at half size first."""
SYSTEMATIC_PX = 0.02
"""Standard deviation of a centre that noise doesn't explain."""
ASYMMETRIC = 0.025
"""Largest root mean square asymmetry about a disc's centre, over its contrast: above it something covers the disc."""
_BLOCKS = (32, 12, 5)
"""Width of the image over that of the neighbourhood whose mean level is the threshold."""
_LATTICES = 3


@dataclass(frozen=True)
class Disc:
    """A blob's centre (2,), the covariance (2, 2) of its area, and whether it is darker than its surroundings."""

    centre_px: Array
    spread_px2: Array
    dark: bool


@dataclass(frozen=True)
class _Metric:
    """A disc's own shape predicts the apparent length of the lattice's steps, and whether they are square."""

    roots: Array
    expected: float

    def neighbours(self, a: int, b: int, step_px: Array) -> bool:
        # By both discs: a lens may show one much larger than the other.
        one, other = (float(np.hypot(*(self.roots[k] @ step_px))) for k in (a, b))
        return 0.65 * self.expected < (one * other) ** 0.5 < 1.45 * self.expected

    def basis(self, at: int, a_px: Array, b_px: Array) -> bool:
        a, b = self.roots[at] @ a_px, self.roots[at] @ b_px
        return abs(float(a @ b)) < 0.45 * float(np.hypot(*a) * np.hypot(*b))


def find_discs(grey: Grey, columns: int, rows: int, spacing_per_diameter: float, count: int) -> dict[Index, Disc]:
    """Lattice of discs (column, row) -> disc: the largest that fits into ``columns`` x ``rows``, in either
    orientation, or otherwise the largest that was found; empty if there is none.  ``count``: when it is complete.
    """
    if max(grey.shape) > LARGE_PX:
        half: Grey = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
        found = _search(half, columns, rows, spacing_per_diameter, count)
        if found and fits(found, columns, rows):
            return {cell: Disc(2.0 * d.centre_px + 0.5, 4.0 * d.spread_px2, d.dark) for cell, d in found.items()}
    return _search(grey, columns, rows, spacing_per_diameter, count)


def _search(grey: Grey, columns: int, rows: int, spacing_per_diameter: float, count: int) -> dict[Index, Disc]:
    best: dict[Index, Disc] = {}
    largest: dict[Index, Disc] = {}
    shown = to_bytes(grey)
    seen: dict[bool, tuple[Array, Array]] = {dark: (np.zeros((0, 2)), np.zeros((0, 2, 2))) for dark in (True, False)}
    for part in _BLOCKS:
        for dark in (True, False):
            # Discs of all sizes together: with a strong lens some are much larger than others.
            centres, spreads = seen[dark] = _united(seen[dark], _blobs(shown, grey.shape[1] // part, dark))
            for _ in range(_LATTICES):
                metric = _Metric(_inverse_roots(spreads), 4.0 * spacing_per_diameter)
                lattice = find_lattice(centres, metric)
                if not lattice:
                    break
                chosen = np.array(list(lattice.values()))
                lattice = trimmed(lattice, columns, rows)
                found = {cell: Disc(centres[i], spreads[i], dark) for cell, i in lattice.items()}
                if fits(found, columns, rows):
                    best = max(best, found, key=len)
                elif len(found) >= 9:
                    largest = max(largest, found, key=len)
                left = np.delete(np.arange(len(centres)), chosen)
                centres, spreads = centres[left], spreads[left]
            if len(best) == count:
                return best
    return best or largest


def _united(first: tuple[Array, Array], second: tuple[Array, Array]) -> tuple[Array, Array]:
    """All of the first, and those of the second that aren't among the first."""
    if not len(first[0]) or not len(second[0]):
        return second if len(second[0]) else first
    distance, nearest = cKDTree(first[0]).query(second[0])
    new = distance > np.sqrt(np.einsum("nii->n", first[1])[nearest])
    return np.concatenate([first[0], second[0][new]]), np.concatenate([first[1], second[1][new]])


def _inverse_roots(spreads: Array) -> Array:
    if not len(spreads):
        return spreads
    values, vectors = np.linalg.eigh(spreads)
    out: Array = vectors / np.sqrt(values)[:, None, :] @ vectors.transpose(0, 2, 1)
    return out


def _blobs(shown: NDArray[np.uint8], block_px: int, dark: bool) -> tuple[Array, Array]:
    """Ellipses: centres (n, 2) and covariances (n, 2, 2) of their areas."""
    block_px = max(block_px, 11) | 1
    kind = cv2.THRESH_BINARY_INV if dark else cv2.THRESH_BINARY
    mask = cv2.adaptiveThreshold(shown, 255, cv2.ADAPTIVE_THRESH_MEAN_C, kind, block_px, 8 if dark else -8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
    height, width = shown.shape
    x, y, w, h, area = stats.T
    fill = area / (w * h)
    good = (np.minimum(w, h) >= SMALLEST_PX) & (np.maximum(w, h) <= block_px) & (fill > 0.2) & (fill < 0.95)
    good &= (x > 0) & (y > 0) & (x + w < width) & (y + h < height)
    good[0] = False
    centres, spreads = [], []
    for k in np.flatnonzero(good)[:MOST_BLOBS].tolist():
        left, top, w_k, h_k, area_k = stats[k].tolist()
        rows, columns = np.nonzero(labels[top : top + h_k, left : left + w_k] == k)
        u, v = columns - columns.mean(), rows - rows.mean()
        # A pixel is a square, not a point.
        a, b, c = u @ u / area_k + 1.0 / 12.0, u @ v / area_k, v @ v / area_k + 1.0 / 12.0
        determinant = a * c - b * b
        roundness = area_k / (4.0 * np.pi * determinant**0.5)
        largest = 0.5 * (a + c) + (0.25 * (a - c) ** 2 + b * b) ** 0.5
        if LEAST_ROUNDNESS < roundness < 1.0 / LEAST_ROUNDNESS and determinant > (LEAST_AXIS_RATIO * largest) ** 2:
            centres.append((left + columns.mean(), top + rows.mean()))
            spreads.append(((a, b), (b, c)))
    return np.array(centres).reshape(-1, 2), np.array(spreads).reshape(-1, 2, 2)


def refined(grey: Grey, disc: Disc, noise: float) -> tuple[Array, Array] | None:
    """Centroid (2,) of a disc's missing (or extra) light, with its covariance (2, 2): no threshold biases it, and every
    pixel of the rim counts by its coverage.  None if the disc is hardly visible, or not completely.
    """
    centre, spread = disc.centre_px, disc.spread_px2
    half = np.ceil(2.0 * np.sqrt(spread.diagonal()) * 1.35 + 2.0).astype(int)
    low, high = np.rint(centre).astype(int) - half, np.rint(centre).astype(int) + half + 1
    if (low < 0).any() or (high > np.array(grey.shape[::-1])).any():
        return None
    patch = grey[low[1] : high[1], low[0] : high[0]].astype(np.float64)
    v, u = np.mgrid[low[1] : high[1], low[0] : high[0]].astype(np.float64)
    offset = np.stack([u - centre[0], v - centre[1]], axis=-1)
    # In units of the ellipse's radius: inside is below 1.
    radius = np.sqrt(np.einsum("hwi,ij,hwj->hw", offset, np.linalg.inv(4.0 * spread), offset))
    pixel = 1.0 / float(np.sqrt(4.0 * np.linalg.eigvalsh(spread)[0]))  # in these units, at most
    rim, ring = radius < 1.0 + 2.0 * pixel, (radius > 1.0 + 2.0 * pixel) & (radius < 1.35 + 2.0 * pixel)
    core = radius < max(1.0 - 2.0 * pixel, 0.4)
    if ring.sum() < 8 or not core.any():
        return None
    # The surrounding light may have a gradient.
    design = np.column_stack([np.ones(int(ring.sum())), offset[ring]])
    plane, *_ = np.linalg.lstsq(design, patch[ring], rcond=None)
    around = plane[0] + offset @ plane[1:]
    # Normalise to even light: otherwise the brighter side would weigh more.
    light = np.maximum(around, 0.3 * plane[0]) / plane[0] if plane[0] > 10.0 * noise else 1.0
    depth = ((around - patch) if disc.dark else (patch - around)) / light
    contrast = float(np.median(depth[core]))
    if contrast < 6.0 * noise or contrast < 5.0:
        return None
    total = float(depth[rim].sum())
    shift = depth[rim] @ offset[rim] / total
    if np.hypot(*shift) > 1.0 or _asymmetry(grey, centre + shift, offset[rim | ring], noise) > ASYMMETRIC * contrast:
        return None
    lever = offset[rim] - shift
    variance = noise**2 * (lever.T @ lever) / total**2 + np.eye(2) * SYSTEMATIC_PX**2
    return centre + shift, variance


def _asymmetry(grey: Grey, centre: Array, offsets: Array, noise: float) -> float:
    """Root mean square of the asymmetric part about a point, beyond noise and a light gradient."""
    sides = [(centre + sign * offsets).astype(np.float32)[None] for sign in (1.0, -1.0)]
    a, b = (cv2.remap(grey, s[:, :, 0], s[:, :, 1], cv2.INTER_LINEAR)[0].astype(np.float64) for s in sides)
    odd = 0.5 * (a - b)
    slope, *_ = np.linalg.lstsq(offsets, odd, rcond=None)
    return float(np.sqrt(max(np.mean(np.square(odd - offsets @ slope)) - 0.5 * noise**2, 0.0)))
