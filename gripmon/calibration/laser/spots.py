"""Laser spots in images: sub-pixel, from saturated, speckled blobs, with a covariance and the candidates beside it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.calibration.sighting import NotFound
from gripmon.records import Array, Image

BACKGROUND_PX = 31
"""Width of the window whose median is the background, where no image with the laser off is given: spots are smaller."""
DETECTION = 8.0
"""Smoothed signal over its noise from which a pixel belongs to a candidate."""
SHARE_OF_PEAK = 0.15
"""Part of a blob's own peak above which its pixels count."""
MOST_CANDIDATES = 5
MOST_OF_IMAGE = 0.05
SATURATED = 0.98
GRAIN_PX = 5
"""Width of a speckle grain: so far its deviations hang together, and gaps between grains of one spot are closed."""
_SMALLEST_SIGMA_PX = 0.02
_LEAST_AREA_PX = 4


@dataclass(frozen=True, slots=True)
class Spot:
    """``uv_px`` (2,), ``covariance_px`` (2, 2) of its error, ``flux`` and ``peak`` above the background (grey levels),
    ``area_px``, and which part of it is ``saturated``.
    """

    uv_px: Array
    covariance_px: Array
    flux: float
    peak: float
    area_px: int
    saturated: float


def find_spots(image: Image, laser_off: Image | None = None) -> list[Spot] | NotFound:
    """Candidates, the brightest (by flux) first.  ``laser_off`` is the same view without the laser: ambient light and
    reflections that don't come from it vanish.
    """
    grey = _grey(image)
    ceiling = _ceiling(image)
    if laser_off is not None:
        if laser_off.shape[:2] != image.shape[:2] or laser_off.dtype != image.dtype:
            return NotFound(
                f"the image with the laser off is {laser_off.shape[1]} x {laser_off.shape[0]} {laser_off.dtype}, the "
                f"other {image.shape[1]} x {image.shape[0]} {image.dtype}; both by the same camera"
            )
        signal = _brightest_change(image, laser_off)
    else:
        signal = grey - _background(grey, ceiling)
    # Quantisation is noise, too; the median is ambient light that changed between the images.
    signal = signal - np.median(signal)
    noise = max(1.4826 * float(np.median(np.abs(signal))), ceiling / 255.0 / np.sqrt(12.0))
    smooth = cv2.GaussianBlur(signal, (0, 0), 1.0)
    # The blur of one pixel divides white noise by 2 sqrt(pi).
    limit = DETECTION * noise / (2.0 * np.sqrt(np.pi))
    peak = float(smooth.max())
    if peak < limit:
        return NotFound(f"no spot: the brightest place is {peak / limit * DETECTION:.1f} times its noise; laser on?")
    labels, count = _blobs(smooth > max(limit, 0.02 * peak))
    spots = [_measured(signal, grey, labels == k, ceiling, noise) for k in range(1, count)]
    largest = MOST_OF_IMAGE * signal.size
    kept = [s for s in spots if s is not None and s.area_px <= largest]
    if not kept:
        return NotFound("no spot: what is bright is too small or too large for one; a laser spot of a few pixels")
    return sorted(kept, key=lambda s: -s.flux)[:MOST_CANDIDATES]


def _measured(signal: Array, grey: Array, blob: NDArray[np.bool_], ceiling: float, noise: float) -> Spot | None:
    """Centroid of what stands out, in a window that follows the spot's own second moments."""
    rows, columns = np.nonzero(blob)
    margin = GRAIN_PX
    top, left = max(rows.min() - margin, 0), max(columns.min() - margin, 0)
    window = (slice(top, rows.max() + margin + 1), slice(left, columns.max() + margin + 1))
    part, inside = signal[window], blob[window]
    peak = float(part[inside].max())
    mask = inside & (part > max(SHARE_OF_PEAK * peak, 3.0 * noise))
    if mask.sum() < _LEAST_AREA_PX:
        return None
    v, u = np.nonzero(mask)
    weight = part[mask] - max(SHARE_OF_PEAK * peak, 3.0 * noise)
    flux = float(weight.sum())
    places = np.stack([u + left, v + top], axis=1).astype(float)
    centre = weight @ places / flux
    offset = places - centre
    shape = np.einsum("n,ni,nj->ij", weight, offset, offset) / flux
    covariance = _centre_covariance(part, mask, weight, offset, shape, noise)
    saturated = float(np.mean(grey[window][mask] >= SATURATED * ceiling))
    return Spot(centre, covariance, flux, peak, int(mask.sum()), saturated)


def _centre_covariance(
    part: Array, mask: NDArray[np.bool_], weight: Array, offset: Array, shape: Array, noise: float
) -> Array:
    """Of the centroid: each pixel's deviation from a smooth spot of the same moments moves it by its lever.  What is
    the same on the other side of the centre (a saturated core) doesn't; speckle's deviations hang together over a
    grain, so that neighbours count with each other.
    """
    flux = float(weight.sum())
    steady = shape + np.eye(2) / 12.0
    model = np.exp(-0.5 * np.einsum("ni,ij,nj->n", offset, np.linalg.inv(steady), offset))
    model *= (weight @ model) / (model @ model)
    deviation = np.zeros(part.shape)
    deviation[mask] = weight - model
    rows, columns = np.nonzero(mask)
    lever = np.zeros((*part.shape, 2))
    lever[mask] = (deviation[mask] - _mirrored(deviation, rows, columns, offset))[:, None] * offset
    together = np.asarray(cv2.blur(lever, (GRAIN_PX, GRAIN_PX), borderType=cv2.BORDER_CONSTANT)) * GRAIN_PX**2
    # The centre follows the speckle that it is measured by, which hides about half of the variance on rendered grains;
    # the difference of two pixels has twice that of each.
    sensor = noise**2 * (offset.T @ offset) / flux**2
    speckle = np.einsum("vui,vuj->ij", lever, together) / flux**2 - 2.0 * sensor
    values, axes = np.linalg.eigh(0.5 * (speckle + speckle.T))
    out: Array = (axes * np.maximum(values, 0.0)) @ axes.T + sensor + _SMALLEST_SIGMA_PX**2 * np.eye(2)
    return out


def _mirrored(values: Array, rows: NDArray[np.intp], columns: NDArray[np.intp], offset: Array) -> Array:
    """``values`` on the other side of the centre, to the nearest pixel; zero outside."""
    v = np.rint(rows - 2.0 * offset[:, 1]).astype(int)
    u = np.rint(columns - 2.0 * offset[:, 0]).astype(int)
    there = (v >= 0) & (v < values.shape[0]) & (u >= 0) & (u < values.shape[1])
    out: Array = np.where(there, values[np.where(there, v, 0), np.where(there, u, 0)], 0.0)
    return out


def _blobs(bright: NDArray[np.bool_]) -> tuple[NDArray[np.int32], int]:
    """Connected blobs, the grains of one spot put together; labels from 1, and one more than there are."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (GRAIN_PX, GRAIN_PX))
    closed = cv2.morphologyEx(bright.astype(np.uint8), cv2.MORPH_CLOSE, kernel)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    large = [k for k in range(1, count) if stats[k, cv2.CC_STAT_AREA] >= _LEAST_AREA_PX]
    large = sorted(large, key=lambda k: -stats[k, cv2.CC_STAT_AREA])[: 4 * MOST_CANDIDATES]
    out = np.zeros(labels.shape, dtype=np.int32)
    for new, old in enumerate(large, start=1):
        out[labels == old] = new
    return out, len(large) + 1


def _background(grey: Array, ceiling: float) -> Array:
    """Median over a window, in 8 bits: OpenCV has no other for large windows."""
    eight = np.clip(grey * (255.0 / ceiling), 0.0, 255.0).astype(np.uint8)
    width = min(BACKGROUND_PX, (min(grey.shape) - 1) // 2 * 2 - 1)
    return cv2.medianBlur(eight, width).astype(np.float32) * np.float32(ceiling / 255.0)


def _brightest_change(image: Image, laser_off: Image) -> Array:
    """The channel that the laser lights the most: a red laser is faint in grey."""
    change = image.astype(np.float32) - laser_off.astype(np.float32)
    return change if change.ndim == 2 else np.ascontiguousarray(change.max(axis=2))


def _grey(image: Image) -> Array:
    out = image.astype(np.float32)
    return out if out.ndim == 2 else np.ascontiguousarray(out.max(axis=2))


def _ceiling(image: Image) -> float:
    """Full scale of the image's numbers."""
    if image.dtype == np.uint8:
        return 255.0
    if image.dtype == np.uint16:
        # Cameras of 10 to 14 bits deliver 16: the highest power of two that is needed.
        return float(2 ** max(int(image.max()).bit_length(), 8) - 1)
    return max(float(image.max()), 1e-6)
