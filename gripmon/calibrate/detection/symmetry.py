"""Points that an image is symmetric about: corners of chequerboards to a few hundredths of a pixel.

About the corner where two edges cross, ``I(p + d) = I(p - d)``, however blurred the image is and whatever the angle
between the edges; light that slopes adds a part that is odd and linear in ``d``.  Least squares in the pixels of a disc
about the point gives its place, its covariance from the image's noise, and tells where something else lies in the disc.

That is exact where the target's map to the image is linear.  Perspective and lens bend it: a step and its opposite on
the target lead to ``p + d + q(d)`` and ``p - d + q(d)``, with q quadratic.  Left out, it moves corners by some
hundredths of a pixel, all of them towards where the target looks smaller; so opposite pixels are taken by ``bend``,
q's coefficients (:mod:`gripmon.calibrate.detection.bending`).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter

from gripmon.model.records import Array

Grey = NDArray[np.float32]
LARGEST_RADIUS_PX = 12.0
SMALLEST_RADIUS_PX = 2.5
ASYMMETRIC = 0.06
"""Root mean square of what isn't symmetric, over the contrast, beyond what the noise explains."""
SYSTEMATIC_PX = 0.015
"""Of a point's place, that no noise explains."""
_SMOOTH_PX = 0.7
_SMOOTHED = 0.17
"""What is left of white noise's variance after that smoothing."""
_STEPS = 12
_CONVERGED_PX = 1e-3


def centres_of_symmetry(
    grey: Grey, start: Array, radius_px: Array, noise: float, bend: Array | None = None
) -> tuple[Array, Array, Array]:
    """Near ``start`` (n, 2), in discs of ``radius_px`` (n,): centres (n, 2), their covariances (n, 2, 2) and how
    asymmetric the image is about each (n,), as a part of its contrast; NaN and infinity where there is none.
    ``bend`` (n, 3, 2): q of ``d`` = (x, y) px is ``[x², xy, y²]`` times it; none if it isn't known.
    """
    radius_px = np.clip(radius_px, SMALLEST_RADIUS_PX, LARGEST_RADIUS_PX)
    if not len(start):
        return start, np.zeros((0, 2, 2)), np.zeros(0)
    grey, corner = _cropped(grey, start, int(2.0 * LARGEST_RADIUS_PX) + 4)
    start = start - corner
    smooth = cv2.GaussianBlur(grey, (0, 0), _SMOOTH_PX)
    slopes: list[Any] = [cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3, scale=0.125) for order in ((1, 0), (0, 1))]
    # Other interpolation than by splines shifts the corners by up to 0.04 px, depending on where in a pixel they are.
    levels: Array = spline_filter(smooth, order=3, output=np.float64)
    reach = int(np.ceil(radius_px.max(initial=1.0)))
    dv, du = (a.ravel() for a in np.mgrid[-reach : reach + 1, -reach : reach + 1].astype(np.float64))
    half = (dv > 0) | ((dv == 0) & (du > 0))  # each pair of opposite pixels once
    offsets = np.stack([du[half], dv[half]], axis=1)
    bent = 0.0 if bend is None else _quadratic(offsets) @ bend
    weight = np.clip(radius_px[:, None] + 0.5 - np.hypot(*offsets.T), 0.0, 1.0)
    # What the light's slope adds; its columns don't move with the point.
    odd = np.broadcast_to(2.0 * offsets, (len(start), *offsets.shape))
    at, moving = start.astype(np.float64).copy(), np.full(len(start), True)
    # All points at once: a minimiser of single problems would be called hundreds of times an image.
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
    """The part of the image that the points are in, and its first pixel (2,)."""
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
    # A difference of two pixels has twice their variance; that smoothing has made them alike evens out over the disc.
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
    """Differences of opposite pixels (n, k) about ``middles`` (n, 1 or k, 2), their derivatives by these (n, k, 2), and
    the levels (n, k) of the pairs about their mean.
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
    """Weighted least squares of each of many small problems (n, k, 4); a little damped, where nothing is to be seen."""
    normal = np.einsum("nk,nki,nkj->nij", weight, rows, rows)
    side = np.einsum("nk,nki,nk->ni", weight, rows, values)
    size = np.sqrt(np.maximum(np.einsum("nii->ni", normal), 1e-9))
    scaled = normal / (size[:, :, None] * size[:, None, :]) + 1e-9 * np.eye(4)
    out: Array = np.linalg.solve(scaled, (side / size)[:, :, None])[:, :, 0] / size
    return out
