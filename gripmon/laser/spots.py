"""A laser's spot in an image: candidates, with their centres and the covariances of these."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.calibrate.sighting import NotFound
from gripmon.model.records import Array, Image

BACKGROUND_PX = 31
"""Width of the median window for the background, used without a laser-off image (px): larger than spots."""
DETECTION = 8.0
"""Smoothed signal over its noise above which a pixel belongs to a candidate."""
SHARE_OF_PEAK = 0.15
"""Fraction of a blob's own peak above which its pixels count."""
MOST_CANDIDATES = 5
MOST_OF_IMAGE = 0.05
GRAIN_PX = 5
"""Width of a fine speckle grain: gaps up to this size between grains of one spot are closed."""
GRAINS_PX = (5, 9, 13)
"""Widths over which a spot's deviations may be correlated; the one that gives the largest variance counts."""
BESIDE = 12
"""Number of places around a spot that show the effect of its surroundings on the centre."""
_SMALLEST_SIGMA_PX = 0.02
_LEAST_AREA_PX = 4
_MOST_HIDDEN = 0.75
_MOST_CUT = 0.35


@dataclass(frozen=True, slots=True)
class Spot:
    """A candidate: ``uv_px`` (2,), ``covariance_px`` (2, 2) of its error, ``flux`` above the background (grey levels),
    and ``area_px``.
    """

    uv_px: Array
    covariance_px: Array
    flux: float
    area_px: int


def plain_spot(uv_px: Array) -> Spot:
    """A spot of which only the position (2,) is known: its noise is estimated from the calibration's residuals."""
    return Spot(np.asarray(uv_px, dtype=float), np.zeros((2, 2)), 0.0, 0)


def find_spots(image: Image, laser_off: Image | None = None) -> list[Spot] | NotFound:
    """Candidates, the brightest (by flux) first.  ``laser_off`` is the same view without the laser, which removes
    ambient light and its reflections.
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
        found = _candidates(change, _grey(laser_off), ceiling)
        if not isinstance(found, NotFound):
            return found
        # A shadow that moved between the images changes a large area: compare with the local background instead.
        middle = 0.5 * (change + np.float32(ceiling))
        local = 2.0 * (middle - _background(middle, ceiling))
        again = _candidates(local, _grey(laser_off), ceiling)
        return found if isinstance(again, NotFound) else again
    return _candidates(grey - _background(grey, ceiling), grey, ceiling)


def _candidates(signal: Array, ambient: Array, ceiling: float) -> list[Spot] | NotFound:
    """Candidates in a signal; ``ambient``: the light without the laser, as far as known."""
    # Quantisation counts as noise, too; the median is ambient light that changed between the images.
    signal = signal - np.median(signal)
    noise = max(1.4826 * float(np.median(np.abs(signal))), ceiling / 255.0 / np.sqrt(12.0))
    smooth: Array = np.asarray(cv2.GaussianBlur(signal, (0, 0), 1.0))
    # The blur of one pixel divides white noise by 2 sqrt(pi).
    limit = DETECTION * noise / (2.0 * np.sqrt(np.pi))
    peak = float(smooth.max())
    if peak < limit:
        return NotFound(f"no spot: the brightest place is {peak / limit * DETECTION:.1f} times its noise; laser on?")
    blobs, bright = _blobs(smooth, max(limit, 0.02 * peak))
    scene = _Scene(signal, ambient, bright, noise)
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
    """What all candidates of an image share; ``bright`` is the mask of all candidates."""

    signal: Array
    ambient: Array
    bright: NDArray[np.bool_]
    noise: float


@dataclass(frozen=True, slots=True)
class _Blob:
    """A window of the image (rows, columns) around a blob, with a margin of one grain, and the blob's mask in it."""

    window: tuple[slice, slice]
    inside: NDArray[np.bool_]


def _touches_border(blob: _Blob, shape: tuple[int, ...]) -> bool:
    v, u = np.nonzero(blob.inside)
    v, u = v + blob.window[0].start, u + blob.window[1].start
    return bool((v == 0).any() or (u == 0).any() or (v == shape[0] - 1).any() or (u == shape[1] - 1).any())


def _measured(scene: _Scene, blob: _Blob) -> Spot | None:
    """Centroid of the signal in a blob; None if it isn't a spot, or not completely visible."""
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
        return None  # its centre can't be determined
    centre = weight @ places / flux
    offset = places - centre
    shape = np.einsum("n,ni,nj->ij", weight, offset, offset) / flux
    covariance = _centre_covariance(part, mask, weight, offset, shape, noise)
    # The border is assumed to cut off as much as is visible along it.
    missing = weight[border] @ offset[border] / flux
    covariance += np.outer(missing, missing)
    covariance += _surroundings(scene, np.stack([v + top, u + left], axis=1), weight, offset)
    return Spot(centre, covariance, flux, int(mask.sum()))


def _centre_covariance(
    part: Array, mask: NDArray[np.bool_], weight: Array, offset: Array, shape: Array, noise: float
) -> Array:
    """Covariance of the centroid: each pixel's deviation from a smooth spot with the same moments moves it by its lever
    arm.  Deviations that are symmetric about the centre (a saturated core) cancel; speckle is correlated over a grain,
    so that neighbours are summed.
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
    # the difference of two pixels has twice the variance of one.
    sensor = noise**2 * (offset.T @ offset) / flux**2
    speckle = 0.0
    for width in GRAINS_PX:
        # All levers cancel at the centre: a window as wide as the spot would see none of their variance.
        hidden = min(width**2 / len(offset), _MOST_HIDDEN)
        if width > GRAIN_PX and hidden == _MOST_HIDDEN:
            break
        together = np.asarray(cv2.blur(lever, (width, width), borderType=cv2.BORDER_CONSTANT)) * width**2
        wider = float((lever * together).sum()) / flux**2 - 2.0 * float(np.trace(sensor))
        speckle = max(speckle, wider / (1.0 - hidden))
    # A few grains show the size of the error, not its direction: take that from the spot's shape.
    levers = (offset.T * np.square(model)) @ offset
    out: Array = speckle * levers / np.trace(levers) + sensor + _SMALLEST_SIGMA_PX**2 * np.eye(2)
    return out


def _surroundings(scene: _Scene, places: NDArray[np.intp], weight: Array, offset: Array) -> Array:
    """(2, 2): the effect of ambient light and uneven reflectance on the centre, from the same sums at places beside the
    spot: other light adds to the spot, and a darker surface reflects less of the laser.  Opposite places are summed,
    which cancels the effect of the spot's own rim.
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
    """``values`` mirrored at the centre, with bilinear interpolation; zero outside."""
    grid = np.indices(values.shape).astype(float)
    other_v = (2.0 * (rows[0] - offset[0, 1]) - grid[0]).astype(np.float32)
    other_u = (2.0 * (columns[0] - offset[0, 0]) - grid[1]).astype(np.float32)
    out = cv2.remap(values.astype(np.float32), other_u, other_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(out, dtype=float)[rows, columns]


def _blobs(smooth: Array, limit: float) -> tuple[list[_Blob], NDArray[np.bool_]]:
    """Connected blobs above a limit, with the grains of one spot merged, and the mask of all of them.  Those with the
    most light are kept: without a laser-off image an uneven plane shows many blobs.
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
    """Median over a window, in 8 bits: OpenCV supports only those for large windows."""
    eight = np.clip(grey * (255.0 / ceiling), 0.0, 255.0).astype(np.uint8)
    width = min(BACKGROUND_PX, (min(grey.shape) - 1) // 2 * 2 - 1)
    return cv2.medianBlur(eight, width).astype(np.float32) * np.float32(ceiling / 255.0)


def _brightest_change(image: Image, laser_off: Image) -> Array:
    """Change in the channel that the laser lights the most: a red laser is faint in grey."""
    change = image.astype(np.float32) - laser_off.astype(np.float32)
    return _brightest(change)


def _grey(image: Image) -> Array:
    return _brightest(image.astype(np.float32))


def _brightest(values: Array) -> Array:
    """Maximum over the channels at each pixel; numpy takes ten times as long over such a short axis."""
    if values.ndim == 2:
        return values
    blue, green, red = cv2.split(values)
    return np.asarray(cv2.max(cv2.max(blue, green), red))


def _ceiling(image: Image) -> float:
    """Full scale of the image's values."""
    if image.dtype == np.uint8:
        return 255.0
    if image.dtype == np.uint16:
        # Cameras with 10 to 14 bits deliver 16: take the smallest power of two that holds the maximum.
        return float(2 ** max(int(image.max()).bit_length(), 8) - 1)
    return max(float(image.max()), 1e-6)
