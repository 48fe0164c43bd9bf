"""A laser's spot in an image: candidates, with their centres and how exact these are."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.calibrate.sighting import NotFound
from gripmon.model.records import Array, Image

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
"""Width of a fine speckle grain: gaps between grains of one spot are closed so far."""
GRAINS_PX = (5, 9, 13)
"""Widths over which a spot's deviations may hang together; the one that says the most counts."""
BESIDE = 12
"""Places around a spot that tell what its surroundings do to the centre."""
_SMALLEST_SIGMA_PX = 0.02
_LEAST_AREA_PX = 4
_MOST_HIDDEN = 0.75
_MOST_CUT = 0.35


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


def plain_spot(uv_px: Array) -> Spot:
    """A spot that nothing but its place (2,) is known of: the calibration's own residuals tell how exact it is."""
    return Spot(np.asarray(uv_px, dtype=float), np.zeros((2, 2)), 0.0, 0.0, 0, 0.0)


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
        change = _brightest_change(image, laser_off)
        found = _candidates(change, grey, _grey(laser_off), ceiling)
        if not isinstance(found, NotFound):
            return found
        # A shadow that moved in between changes a part of the image: against its own neighbourhood the spot stands out.
        middle = 0.5 * (change + np.float32(ceiling))
        local = 2.0 * (middle - _background(middle, ceiling))
        again = _candidates(local, grey, _grey(laser_off), ceiling)
        return found if isinstance(again, NotFound) else again
    return _candidates(grey - _background(grey, ceiling), grey, grey, ceiling)


def _candidates(signal: Array, grey: Array, ambient: Array, ceiling: float) -> list[Spot] | NotFound:
    """From what stands out; ``ambient`` is the light without the laser as far as it is known, ``grey`` the image."""
    # Quantisation is noise, too; the median is ambient light that changed between the images.
    signal = signal - np.median(signal)
    noise = max(1.4826 * float(np.median(np.abs(signal))), ceiling / 255.0 / np.sqrt(12.0))
    smooth: Array = np.asarray(cv2.GaussianBlur(signal, (0, 0), 1.0))
    # The blur of one pixel divides white noise by 2 sqrt(pi).
    limit = DETECTION * noise / (2.0 * np.sqrt(np.pi))
    peak = float(smooth.max())
    if peak < limit:
        return NotFound(f"no spot: the brightest place is {peak / limit * DETECTION:.1f} times its noise; laser on?")
    blobs, bright = _blobs(smooth, max(limit, 0.02 * peak))
    scene = _Scene(signal, grey, ambient, bright, ceiling, noise)
    spots = [_measured(scene, blob) for blob in blobs]
    largest = MOST_OF_IMAGE * signal.size
    kept = [s for s in spots if s is not None and s.area_px <= largest]
    if not kept and any(_touches_border(blob, signal.shape) for blob in blobs):
        return NotFound("no spot: what is bright is cut off by the image's border; a spot that is seen whole")
    if not kept:
        return NotFound("no spot: what is bright is too small or too large for one; a laser spot of a few pixels")
    return sorted(kept, key=lambda s: -s.flux)[:MOST_CANDIDATES]


@dataclass(frozen=True, slots=True)
class _Scene:
    """What all candidates of an image share; ``bright`` where any of them lies."""

    signal: Array
    grey: Array
    ambient: Array
    bright: NDArray[np.bool_]
    ceiling: float
    noise: float


@dataclass(frozen=True, slots=True)
class _Blob:
    """A window of the image (rows, columns) that holds it with a grain's margin, and which of its pixels are its."""

    window: tuple[slice, slice]
    inside: NDArray[np.bool_]


def _touches_border(blob: _Blob, shape: tuple[int, ...]) -> bool:
    v, u = np.nonzero(blob.inside)
    v, u = v + blob.window[0].start, u + blob.window[1].start
    return bool((v == 0).any() or (u == 0).any() or (v == shape[0] - 1).any() or (u == shape[1] - 1).any())


def _measured(scene: _Scene, blob: _Blob) -> Spot | None:
    """Centroid of what stands out; None for what is not a spot, or not seen whole."""
    signal, noise = scene.signal, scene.noise
    window, inside = blob.window, blob.inside
    top, left = window[0].start, window[1].start
    part = signal[window]
    peak = float(part[inside].max())
    mask = inside & (part > max(SHARE_OF_PEAK * peak, 3.0 * noise))
    if mask.sum() < _LEAST_AREA_PX:
        return None
    v, u = np.nonzero(mask)
    weight = part[mask] - max(SHARE_OF_PEAK * peak, 3.0 * noise)
    flux = float(weight.sum())
    places = np.stack([u + left, v + top], axis=1).astype(float)
    border = ((places == 0) | (places == np.array(signal.shape[::-1]) - 1)).any(axis=1)
    if weight[border].max(initial=0.0) > _MOST_CUT * peak:
        return None  # where its middle is can't be told
    centre = weight @ places / flux
    offset = places - centre
    shape = np.einsum("n,ni,nj->ij", weight, offset, offset) / flux
    covariance = _centre_covariance(part, mask, weight, offset, shape, noise)
    # Of what the border cuts off, as much again as is seen at it.
    missing = weight[border] @ offset[border] / flux
    covariance += np.outer(missing, missing)
    covariance += _surroundings(scene, np.stack([v + top, u + left], axis=1), weight, offset)
    saturated = float(np.mean(scene.grey[window][mask] >= SATURATED * scene.ceiling))
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
    # The centre follows the speckle that it is measured by, which hides about half of the variance on rendered grains;
    # the difference of two pixels has twice that of each.
    sensor = noise**2 * (offset.T @ offset) / flux**2
    speckle = 0.0
    for width in GRAINS_PX:
        # The centre is where all levers cancel: a window as wide as the spot would see none of their variance.
        hidden = min(width**2 / len(offset), _MOST_HIDDEN)
        if width > GRAIN_PX and hidden == _MOST_HIDDEN:
            break
        together = np.asarray(cv2.blur(lever, (width, width), borderType=cv2.BORDER_CONSTANT)) * width**2
        wider = float((lever * together).sum()) / flux**2 - 2.0 * float(np.trace(sensor))
        speckle = max(speckle, wider / (1.0 - hidden))
    # A few grains tell how much, not where to: that is the spot's form.
    levers = (offset.T * np.square(model)) @ offset
    out: Array = speckle * levers / np.trace(levers) + sensor + _SMALLEST_SIGMA_PX**2 * np.eye(2)
    return out


def _surroundings(scene: _Scene, places: NDArray[np.intp], weight: Array, offset: Array) -> Array:
    """(2, 2): what ambient light and a surface that isn't the same everywhere do to the centre, by the same sums at
    places beside the spot: light that isn't the laser's adds to it, and where the surface is darker it sends less of
    the laser back.  Places on both sides count together: what the spot's own rim does to them cancels.
    """
    flux = float(weight.sum())
    level = float(np.median(scene.ambient[tuple(places.T)]))
    shading = max(level, 4.0 * scene.noise)
    far = 2.0 * float(np.linalg.norm(offset, axis=1).max()) + GRAIN_PX
    total, count = np.zeros((2, 2)), 0
    for angle in np.pi * np.arange(BESIDE // 2) / (BESIDE // 2):
        shift = np.rint(far * np.array([np.sin(angle), np.cos(angle)])).astype(int)
        pair = [places + shift, places - shift]
        if any((p < 0).any() or (p >= scene.signal.shape).any() or scene.bright[tuple(p.T)].any() for p in pair):
            continue
        added = sum(scene.signal[tuple(p.T)] @ offset for p in pair) / flux / np.sqrt(2.0)
        dimmed = sum(((scene.ambient[tuple(p.T)] - level) / shading * weight) @ offset for p in pair)
        dimmed = dimmed / flux / np.sqrt(2.0)
        total += np.outer(added, added) + np.outer(dimmed, dimmed)
        count += 1
    if not count:
        return total
    noisy = scene.noise**2 * (offset.T @ offset + (offset.T * np.square(weight / shading)) @ offset) / flux**2
    return _positive(total / count - noisy)


def _positive(matrix: Array) -> Array:
    """The nearest (2, 2) covariance."""
    values, axes = np.linalg.eigh(0.5 * (matrix + matrix.T))
    out: Array = (axes * np.maximum(values, 0.0)) @ axes.T
    return out


def _mirrored(values: Array, rows: NDArray[np.intp], columns: NDArray[np.intp], offset: Array) -> Array:
    """``values`` on the other side of the centre, between pixels bilinearly; zero outside."""
    grid = np.indices(values.shape).astype(float)
    other_v = (2.0 * (rows[0] - offset[0, 1]) - grid[0]).astype(np.float32)
    other_u = (2.0 * (columns[0] - offset[0, 0]) - grid[1]).astype(np.float32)
    out = cv2.remap(values.astype(np.float32), other_u, other_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(out, dtype=float)[rows, columns]


def _blobs(smooth: Array, limit: float) -> tuple[list[_Blob], NDArray[np.bool_]]:
    """Connected blobs above a limit, the grains of one spot put together: those with the most light, for a spot is
    small beside what an uneven plane shows without an image with the laser off; and where any of them lies.
    """
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (GRAIN_PX, GRAIN_PX))
    closed = cv2.morphologyEx((smooth > limit).astype(np.uint8), cv2.MORPH_CLOSE, kernel)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    lit = np.nonzero(closed)
    light = np.bincount(labels[lit], weights=np.maximum(smooth[lit], 0.0), minlength=count)
    large = [k for k in range(1, count) if stats[k, cv2.CC_STAT_AREA] >= _LEAST_AREA_PX]
    large = sorted(large, key=lambda k: -light[k])[: 4 * MOST_CANDIDATES]
    chosen = np.zeros(count, dtype=bool)
    chosen[large] = True
    bright = np.zeros(labels.shape, dtype=bool)
    bright[lit] = chosen[labels[lit]]
    blobs = []
    for k in large:
        left, top, width, height = (int(value) for value in stats[k, : cv2.CC_STAT_AREA])
        rows = slice(max(top - GRAIN_PX, 0), top + height + GRAIN_PX)
        columns = slice(max(left - GRAIN_PX, 0), left + width + GRAIN_PX)
        blobs.append(_Blob((rows, columns), labels[rows, columns] == k))
    return blobs, bright


def _background(grey: Array, ceiling: float) -> Array:
    """Median over a window, in 8 bits: OpenCV has no other for large windows."""
    eight = np.clip(grey * (255.0 / ceiling), 0.0, 255.0).astype(np.uint8)
    width = min(BACKGROUND_PX, (min(grey.shape) - 1) // 2 * 2 - 1)
    return cv2.medianBlur(eight, width).astype(np.float32) * np.float32(ceiling / 255.0)


def _brightest_change(image: Image, laser_off: Image) -> Array:
    """The channel that the laser lights the most: a red laser is faint in grey."""
    change = image.astype(np.float32) - laser_off.astype(np.float32)
    return _brightest(change)


def _grey(image: Image) -> Array:
    return _brightest(image.astype(np.float32))


def _brightest(values: Array) -> Array:
    """Of the channels, at each pixel; numpy takes ten times as long over so short an axis."""
    if values.ndim == 2:
        return values
    blue, green, red = cv2.split(values)
    return np.asarray(cv2.max(cv2.max(blue, green), red))


def _ceiling(image: Image) -> float:
    """Full scale of the image's numbers."""
    if image.dtype == np.uint8:
        return 255.0
    if image.dtype == np.uint16:
        # Cameras of 10 to 14 bits deliver 16: the highest power of two that is needed.
        return float(2 ** max(int(image.max()).bit_length(), 8) - 1)
    return max(float(image.max()), 1e-6)
