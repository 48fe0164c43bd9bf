"""Corners of chequerboards, where four squares meet, alternately dark and light; to a few hundredths of a pixel.

Around a corner where two edges cross, ``I(p + d) = I(p - d)``, whatever the blur and the angle between the edges; a
gradient of the light adds a part that is odd and linear in ``d``.  Least squares over the pixels of a disc around the
point gives its position, its covariance from the image's noise, and a test whether something else lies in the disc.

That is exact if the map from target to image is linear.  Perspective and lens bend it: a step and its opposite on the
target lead to ``p + d + q(d)`` and ``p - d + q(d)``, with q quadratic.  Neglecting q shifts corners by some hundredths
of a pixel, all of them towards where the target looks smaller; so opposite pixels are sampled with ``bend``, q's
coefficients.  These need no known camera: g maps a pixel p to lattice coordinates as (homography) o (radial polynomial
about a centre), a plane seen through a lens, and where g isn't linear,

    g(c + d + q) + g(c - d + q) = 2 g(c)    with    q = -1/2 G^-1 g''[d, d],  G = g'(c), to fourth order in d.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from gripmon.calibrate.grey_levels import Grey
from gripmon.calibrate.lattice import Index, find_lattice, fits, trimmed
from gripmon.model.records import Array

SCALES = (1.0, 2.0, 3.5)
"""Standard deviations (px) of the smoothing with which corners are searched."""
MOST_CANDIDATES = 4000
LEAST_STRENGTH = 0.02
"""Minimum strength of a candidate, relative to the strongest ones."""
_RING = 32
_SECOND = 2
_LATTICES = 3


@dataclass(frozen=True)
class _Alternating:
    """Neighbouring corners are negatives of each other: where one has dark squares, the other has light ones."""

    second: NDArray[np.complex128]

    def neighbours(self, a: int, b: int, step_px: Array) -> bool:
        product = complex(self.second[a] * np.conj(self.second[b]))
        return product.real < -0.4 * abs(product)

    def basis(self, at: int, a_px: Array, b_px: Array) -> bool:
        # A knight's move also leads to a negative, but then subtracting two of the other steps makes it shorter.
        return all(
            np.hypot(*(one + side * two)) > np.hypot(*one)
            for one, two in ((a_px, 2.0 * b_px), (b_px, 2.0 * a_px))
            for side in (1.0, -1.0)
        )


def find_corners(grey: Grey, columns: int, rows: int) -> dict[Index, tuple[float, float]]:
    """Lattice of corners (column, row) -> (u, v), to about a pixel: the one that fits into ``columns`` x ``rows`` in
    either orientation and has the most total contrast, or otherwise the largest that was found; empty if there is none.
    """
    best: dict[Index, tuple[float, float]] = {}
    shown = 0.0
    largest: dict[Index, tuple[float, float]] = {}
    for scale in SCALES:
        candidates = saddles(grey, scale)
        good, second = crossing(grey, candidates, np.full(len(candidates), 2.0 * scale + 2.0))
        candidates, second = candidates[good], second[good]
        for _ in range(_LATTICES):
            lattice = find_lattice(candidates, _Alternating(second))
            if not lattice:
                break
            chosen = np.array(list(lattice.values()))
            lattice = trimmed(_wide(grey, candidates, lattice), columns, rows)
            found = {cell: (float(candidates[i, 0]), float(candidates[i, 1])) for cell, i in lattice.items()}
            contrast = float(np.abs(second[list(lattice.values())]).sum())
            if fits(found, columns, rows, least=2):
                if contrast > shown:
                    best, shown = found, contrast
            elif len(found) >= 9:
                largest = max(largest, found, key=len)
            left = np.delete(np.arange(len(candidates)), chosen)
            candidates, second = candidates[left], second[left]
        if len(best) == columns * rows:
            break
    return best or largest


def _wide(grey: Grey, candidates: Array, lattice: dict[Index, int]) -> dict[Index, int]:
    """Test again with rings as wide as the squares allow: corners of the board's rim don't belong to its lattice."""
    indices = np.array(list(lattice.values()))
    steps = cKDTree(candidates[indices]).query(candidates[indices], 2)[0][:, 1]
    good, _ = crossing(grey, candidates[indices], 0.35 * steps)
    kept = set(indices[good].tolist())
    return {cell: index for cell, index in lattice.items() if index in kept}


def saddles(grey: Grey, sigma_px: float) -> Array:
    """Saddle candidates (n, 2): where the image curves up one way and down the other; the strongest ones."""
    smooth = cv2.GaussianBlur(grey, (0, 0), sigma_px)
    xx = cv2.Sobel(smooth, cv2.CV_32F, 2, 0, ksize=3)
    yy = cv2.Sobel(smooth, cv2.CV_32F, 0, 2, ksize=3)
    xy = cv2.Sobel(smooth, cv2.CV_32F, 1, 1, ksize=3)
    strength = xy * xy - xx * yy  # all three kernels have a gain of 4
    radius = round(2.0 * sigma_px) + 1
    peak = cv2.dilate(strength, np.ones((2 * radius + 1, 2 * radius + 1), np.uint8))
    floor = LEAST_STRENGTH * float(np.partition(strength.ravel(), -64)[-64])
    rows, columns = np.nonzero((strength >= peak) & (strength > max(floor, 1e-3)))
    if len(rows) > MOST_CANDIDATES:
        strongest = np.argsort(strength[rows, columns])[-MOST_CANDIDATES:]
        rows, columns = rows[strongest], columns[strongest]
    return np.stack([columns, rows], axis=1).astype(np.float64)


def crossing(grey: Grey, points: Array, radius_px: Array) -> tuple[NDArray[np.bool_], NDArray[np.complex128]]:
    """(n,) whether a ring around a point is dark, light, dark, light, so that two edges cross there instead of meeting;
    and their direction and strength, as the ring's second harmonic.
    """
    if not len(points):
        return np.zeros(0, bool), np.zeros(0, np.complex128)
    angles = 2.0 * np.pi / _RING * np.arange(_RING)
    ring = points[:, None] + radius_px[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    at = ring.astype(np.float32)
    levels = cv2.remap(grey, at[:, :, 0], at[:, :, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    harmonics = np.fft.rfft(levels.astype(np.float64), axis=1)[:, 1:]
    power = np.square(np.abs(harmonics))
    # Two crossing edges have only even harmonics: opposite pixels are equal.
    even, odd = power[:, 1::2].sum(axis=1), power[:, 0::2].sum(axis=1)
    second = harmonics[:, _SECOND - 1]
    inside = ((points - radius_px[:, None] > 0) & (points + radius_px[:, None] < np.array(grey.shape[::-1]) - 1)).all(
        axis=1
    )
    good = (odd < 0.25 * even) & (power[:, _SECOND - 1] > 0.5 * even) & (even > (3.0 * _RING) ** 2 / 4.0) & inside
    return good, second


LARGEST_RADIUS_PX = 12.0
SMALLEST_RADIUS_PX = 2.5
ASYMMETRIC = 0.06
"""Largest root mean square of the asymmetric part, over the contrast, beyond what the noise explains."""
SYSTEMATIC_PX = 0.015
"""Standard deviation of a point's position that noise doesn't explain (px)."""
_SMOOTH_PX = 0.7
_SMOOTHED = 0.17
"""Fraction of white noise's variance that remains after that smoothing."""
_STEPS = 12
_CONVERGED_PX = 1e-3


def centres_of_symmetry(
    grey: Grey, start: Array, radius_px: Array, noise: float, bend: Array | None = None
) -> tuple[Array, Array, Array]:
    """Near ``start`` (n, 2), in discs of ``radius_px`` (n,): centres (n, 2), their covariances (n, 2, 2) and the
    asymmetry of the image about each (n,), over its contrast; NaN and infinity where there is none.  ``bend`` (n, 3,
    2): q of ``d`` = (x, y) px is ``[x², xy, y²]`` times it; None if unknown.
    """
    radius_px = np.clip(radius_px, SMALLEST_RADIUS_PX, LARGEST_RADIUS_PX)
    if not len(start):
        return start, np.zeros((0, 2, 2)), np.zeros(0)
    grey, corner = _cropped(grey, start, int(2.0 * LARGEST_RADIUS_PX) + 4)
    start = start - corner
    smooth = cv2.GaussianBlur(grey, (0, 0), _SMOOTH_PX)
    slopes: list[Any] = [cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3, scale=0.125) for order in ((1, 0), (0, 1))]
    # Interpolation other than by splines shifts corners by up to 0.04 px, depending on the sub-pixel position.
    levels: Array = spline_filter(smooth, order=3, output=np.float64)
    reach = int(np.ceil(radius_px.max(initial=1.0)))
    dv, du = (a.ravel() for a in np.mgrid[-reach : reach + 1, -reach : reach + 1].astype(np.float64))
    half = (dv > 0) | ((dv == 0) & (du > 0))  # each pair of opposite pixels once
    offsets = np.stack([du[half], dv[half]], axis=1)
    bent = 0.0 if bend is None else _quadratic(offsets) @ bend
    weight = np.clip(radius_px[:, None] + 0.5 - np.hypot(*offsets.T), 0.0, 1.0)
    # The effect of a light gradient; its columns don't depend on the point.
    odd = np.broadcast_to(2.0 * offsets, (len(start), *offsets.shape))
    at, moving = start.astype(np.float64).copy(), np.full(len(start), True)
    # All points at once: a minimiser for single problems would be called hundreds of times per image.
    for _ in range(_STEPS):
        difference, gradient, _ = _opposites(levels, slopes, at[:, None] + bent, offsets)
        rows = np.concatenate([gradient, odd], axis=2)
        step = -_solve(rows, difference, weight)[:, :2]
        length = np.linalg.norm(step, axis=1)
        step *= np.minimum(1.0, 1.0 / np.maximum(length, 1e-12))[:, None]  # at most a pixel at a time
        at[moving] += step[moving]
        moving &= length > _CONVERGED_PX
        if not moving.any():
            break
    at[moving | (np.linalg.norm(at - start, axis=1) > radius_px)] = np.nan
    middles = np.nan_to_num(at, nan=-100.0)[:, None] + bent
    return at + corner, *_judged(levels, slopes, at, middles, offsets, weight, odd, noise)


def _quadratic(offsets: Array) -> Array:
    x, y = offsets.T
    return np.stack([x * x, x * y, y * y], axis=1)


def _cropped(grey: Grey, points: Array, margin: int) -> tuple[Grey, Array]:
    """The part of the image that contains the points, and its first pixel (2,)."""
    low = np.maximum(np.floor(points.min(axis=0)).astype(int) - margin, 0)
    high = np.minimum(np.ceil(points.max(axis=0)).astype(int) + margin + 1, grey.shape[::-1])
    return np.ascontiguousarray(grey[low[1] : high[1], low[0] : high[0]]), low.astype(np.float64)


def _judged(
    levels: Array,
    slopes: list[Grey],
    at: Array,
    middles: Array,
    offsets: Array,
    weight: Array,
    odd: Array,
    noise: float,
) -> tuple[Array, Array]:
    """Covariances (n, 2, 2) and asymmetries (n,) at the centres."""
    difference, gradient, pairs = _opposites(levels, slopes, middles, offsets)
    rows = np.concatenate([gradient, odd], axis=2)
    # A difference of two pixels has twice their variance; the correlation by smoothing averages out over the disc.
    information = np.einsum("nk,nki,nkj->nij", weight, rows, rows)
    size = np.sqrt(np.maximum(np.einsum("nii->ni", information), 1e-12))
    scaled = information / (size[:, :, None] * size[:, None, :]) + 1e-9 * np.eye(4)
    inverse = np.linalg.inv(scaled) / (size[:, :, None] * size[:, None, :])
    covariance = 2.0 * noise**2 * inverse[:, :2, :2] + SYSTEMATIC_PX**2 * np.eye(2)
    unknown = _solve(rows, difference, weight)
    left = difference - np.einsum("nki,ni->nk", rows, unknown)
    total = weight.sum(axis=1)
    rms2 = (weight * left * left).sum(axis=1) / total
    contrast = np.sqrt(np.maximum((weight * pairs * pairs).sum(axis=1) / total, 1e-6))
    asymmetry = np.sqrt(np.maximum(rms2 - 2.0 * _SMOOTHED * noise**2, 0.0)) / (2.0 * contrast)
    lost = ~np.isfinite(at).all(axis=1) | ~np.isfinite(asymmetry)
    covariance[lost], asymmetry[lost] = np.nan, np.inf
    return covariance, asymmetry


def _opposites(levels: Array, slopes: list[Grey], middles: Array, offsets: Array) -> tuple[Array, Array, Array]:
    """Differences of opposite pixels (n, k) about ``middles`` (n, 1 or k, 2), their derivatives by the middles (n, k,
    2), and the mean levels of the pairs (n, k) less their average.
    """
    plus, minus = middles + offsets, middles - offsets
    a, b = (
        map_coordinates(levels, [w[:, :, 1], w[:, :, 0]], order=3, prefilter=False, mode="nearest")
        for w in (plus, minus)
    )
    gradient = np.stack([_sampled(s, plus) - _sampled(s, minus) for s in slopes], axis=2)
    mean = 0.5 * (a + b)
    return a - b, gradient, mean - mean.mean(axis=1, keepdims=True)


def _sampled(image: Grey, where: Array) -> Array:
    u, v = (np.ascontiguousarray(where[:, :, k], np.float32) for k in (0, 1))
    out: Array = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float64)
    return out


def _solve(rows: Array, values: Array, weight: Array) -> Array:
    """Weighted least squares of many small problems (n, k, 4), slightly damped for featureless discs."""
    normal = np.einsum("nk,nki,nkj->nij", weight, rows, rows)
    side = np.einsum("nk,nki,nk->ni", weight, rows, values)
    size = np.sqrt(np.maximum(np.einsum("nii->ni", normal), 1e-9))
    scaled = normal / (size[:, :, None] * size[:, None, :]) + 1e-9 * np.eye(4)
    out: Array = np.linalg.solve(scaled, (side / size)[:, :, None])[:, :, 0] / size
    return out


FEWEST = 9
"""Minimum number of points to determine the map of a plane, with some redundancy."""
_LENS = 3
_NOISE_PX = 0.05
_CENTRE_SHARE = 0.1
"""Prior standard deviation of the lens's centre about the image's, over the image's size; and (next) that of the lens's
distortion at the image's corner.
"""
_LENS_SHARE = 0.5
_STEP_PX = 2.0


def bends(cells: Array, at: Array, size_px: tuple[int, int]) -> Array:
    """(n, 3, 2): q of ``d`` = (x, y) px is ``[x², xy, y²]`` times these, at the points ``at`` (n, 2) px with the
    lattice coordinates ``cells`` (n, 2); 0 if there are fewer than :data:`FEWEST` points or all are collinear.
    """
    out = np.zeros((len(at), 3, 2))
    if len(at) < FEWEST or np.linalg.svd(cells - cells.mean(axis=0), compute_uv=False)[1] < 1.0:
        return out
    view = _View(cells, at, size_px)
    unknown = view.fitted()
    if unknown is None:
        return out
    east, south = np.array([_STEP_PX, 0.0]), np.array([0.0, _STEP_PX])
    here = view.to_cells(unknown, at)
    e, w, s, n = (view.to_cells(unknown, at + way) for way in (east, -east, south, -south))
    diagonal = (
        view.to_cells(unknown, at + east + south)
        + view.to_cells(unknown, at - east - south)
        - view.to_cells(unknown, at + east - south)
        - view.to_cells(unknown, at - east + south)
    )
    slopes = np.stack([e - w, s - n], axis=2) / (2.0 * _STEP_PX)
    # Second derivatives of g by x x, x y (doubled, as it occurs twice in the form), y y.
    second = np.stack([e + w - 2.0 * here, 0.5 * diagonal, s + n - 2.0 * here], axis=2) / _STEP_PX**2
    out[:] = -0.5 * np.linalg.solve(slopes, second).transpose(0, 2, 1)
    return out


class _View:
    """A lattice in an image, both scaled to the order of one."""

    def __init__(self, cells: Array, at: Array, size_px: tuple[int, int]) -> None:
        self._middle_px, self._scale_px = 0.5 * np.asarray(size_px, float), 0.5 * float(np.hypot(*size_px))
        self._middle, self._extent = cells.mean(axis=0), float(np.ptp(cells, axis=0).max())
        self._cells, self._at = (cells - self._middle) / self._extent, at
        # Pixels per unit of a residual on the lattice.
        self._px = float(np.sqrt(np.linalg.det(np.cov(at.T)) / np.linalg.det(np.cov(self._cells.T))) ** 0.5)

    def fitted(self) -> Array | None:
        """Homography (8), lens (3) and its centre (2); None if the fit fails."""
        plane, _ = cv2.findHomography(self._normal(self._at), self._cells)
        if plane is None or not np.isfinite(plane).all() or plane[2, 2] == 0.0:
            return None
        start = np.concatenate([(plane / plane[2, 2]).ravel()[:8], np.zeros(_LENS + 2)])
        with np.errstate(all="ignore"):
            for loss in ("linear", "soft_l1"):
                found = least_squares(self._residuals, start, loss=loss, x_scale="jac", max_nfev=60)
                start = found.x
        return start if np.isfinite(start).all() and np.isfinite(found.cost) else None

    def to_cells(self, unknown: Array, at: Array) -> Array:
        """Pixels (n, 2) -> lattice coordinates (n, 2)."""
        return self._to_plane(unknown, at) * self._extent + self._middle

    def _residuals(self, unknown: Array) -> Array:
        off = (self._to_plane(unknown, self._at) - self._cells).ravel() * (self._px / _NOISE_PX)
        lens, centre = unknown[8 : 8 + _LENS], unknown[8 + _LENS :]
        return np.concatenate([np.nan_to_num(off, nan=1e6), lens / _LENS_SHARE, centre / _CENTRE_SHARE])

    def _to_plane(self, unknown: Array, at: Array) -> Array:
        plane = np.append(unknown[:8], 1.0).reshape(3, 3)
        lens, centre = unknown[8 : 8 + _LENS], unknown[8 + _LENS :]
        off = self._normal(at) - centre
        r2 = np.square(off).sum(axis=1)
        ideal = centre + off * (1.0 + r2 * (lens[0] + r2 * (lens[1] + r2 * lens[2])))[:, None]
        x, y, w = plane @ np.stack([*ideal.T, np.ones(len(at))])
        out: Array = np.stack([x / w, y / w], axis=1)
        return out

    def _normal(self, at: Array) -> Array:
        out: Array = (at - self._middle_px) / self._scale_px
        return out
