"""The outline of what is static in images in front of changing backgrounds, to a fraction of a pixel.

Across the outline an image k shows ``D = (1 - alpha(s)) (B_k(s) - F)``: how much of the background B_k, against the
finger's grey level F, shows through at a distance s.  A single image can't separate the matte ``alpha`` from the
background's own texture, but many images can.  Weighted by each image's contrast ``c_k`` a few pixels outside, the
textures, which differ, average out, and the transition, which is the same, remains::

    T(s) = sum_k c_k D_k(s) / sum_k c_k²  =  Phi((s - e) / blur) (a + b s) + Phi((e - s) / blur) (c + d s)

a and b describe how fast the background decorrelates from its grey level at c_k, c and d the finger's shading; e is the
position of the edge.  The scatter of e over the images follows from leaving out a tenth of them at a time (the
delete-a-group jackknife), which includes correlated errors of neighbouring points.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, median_filter
from scipy.special import ndtr

from gripmon.model.camera import Camera
from gripmon.model.records import Array

MOST_FOLDS = 10
"""Largest number of groups of images that the jackknife leaves out in turn."""
BLURS_PX = tuple(np.arange(0.5, 4.01, 0.1).tolist())
MOST_RELIGHT = 0.5
"""Largest change of a finger's grey level from image to image, relative: the lamp behind instead of above it."""
ALIKE_STATIONS = 41
"""Stations, a pixel apart, along which a finger's light is about the same: several times what a corner takes up."""
FEWEST_CONTRASTS = 6.0
"""Least contrast over the noise (root of the sum of squares over images): less locates an edge to a sixth of its blur.
"""
CLEAR_NOISES = 6.0
"""Contrast over a pixel's noise, at least a grey level, from which an image alone shows the finger's border there; and
grey levels of two backgrounds so far apart are different ones."""
FEWEST_CLEAR = 4
"""Least number of images that show the border so: one of five may show something else there."""
FEWEST_BACKGROUNDS = 2
"""Least number of different backgrounds among these.  Beside a tone's border within a finger there is always the same;
within a background the grey level on the finger's side changes, and the image isn't used there."""
FROM_BORDER_PX = 6.0
"""Least distance of a search line from the image's border: two sigmas of the contour's smoothing."""
STEP_PX = 0.5
WIDE_PX, NARROW_PX = 8.0, 5.0
"""Step and half lengths of search lines."""
WIDE_SEARCH_PX, NARROW_SEARCH_PX = 4.0, 2.0
"""Reach of the search on them."""
_GRID_PX = 0.125
_SMOOTH_PX = 3.0


@dataclass(frozen=True)
class Stations:
    """Points along an outline: ``uv_px`` (s, 2), ``normal`` (s, 2) away from the gripper; ``inside`` (s,): whether the
    search line lies in the image.
    """

    uv_px: Array
    normal: Array
    inside: NDArray[np.bool_]


@dataclass(frozen=True)
class Transitions:
    """What the images show across an outline.

    ``offset_px`` (s,) of the edge along the normals; ``folds_px`` (f, s), the same with one f-th of the images left
    out; ``usable`` (s,); ``blur_px`` of the transition; ``shift_px`` (n, s), how much farther out an image shows the
    edge than all images do, with the relative information ``worth`` (n, s), its squared contrast; ``sharpness`` (n,) of
    each image's transitions over that of all; ``clear`` and
    ``different`` (s,) as :func:`backgrounds_beside` has them; ``level`` (s,) of the finger, grey.
    """

    offset_px: Array
    folds_px: Array
    usable: NDArray[np.bool_]
    blur_px: float
    shift_px: Array
    worth: Array
    sharpness: Array
    clear: NDArray[np.intp]
    different: NDArray[np.intp]
    level: Array


def folds_of(count: int) -> NDArray[np.intp]:
    """The group (n,) of each image that the jackknife leaves out together: at most ten groups, of equal sizes."""
    return np.arange(count) % min(count, MOST_FOLDS)


def trace(still: NDArray[np.bool_], smallest_px: int) -> list[Array]:
    """Closed contours (k, 2) of a mask's regions and holes, one point per pixel, smoothed; px."""
    found, _ = cv2.findContours(still.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    out = []
    for contour in found:
        points = contour[:, 0].astype(float)
        if len(points) < smallest_px:
            continue
        smooth = gaussian_filter1d(points, _SMOOTH_PX, axis=0, mode="wrap")
        way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(smooth, axis=0, append=smooth[:1]), axis=1))])
        count = int(way[-1])
        around = np.vstack([smooth, smooth[:1]])
        at = np.arange(count) * way[-1] / count
        out.append(np.column_stack([np.interp(at, way, around[:, k]) for k in (0, 1)]))
    return out


def stations_along(contour: Array, still: NDArray[np.bool_]) -> Stations:
    """A station at each point (s, 2) of a closed contour."""
    tangent = np.roll(contour, -2, axis=0) - np.roll(contour, 2, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1), 1e-9)[:, None]
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    side = inner_side(contour, normal, still)
    normal = normal if float(side.sum()) < 0.0 else -normal
    return Stations(contour, normal, lines_in_image(contour, normal, still.shape, WIDE_PX))


def stations_ahead(uv_px: Array, ahead_px: Array, shape: tuple[int, ...], reach_px: float) -> Stations:
    """Stations at points (s, 2) of an outline that leads on to others (s, 2), the gripper on its left; so their normals
    point away from it.
    """
    way = ahead_px - uv_px
    way /= np.maximum(np.linalg.norm(way, axis=1), 1e-12)[:, None]
    normal = np.column_stack([-way[:, 1], way[:, 0]])
    return Stations(uv_px, normal, lines_in_image(uv_px, normal, shape, reach_px))


def inner_side(uv_px: Array, normal: Array, still: NDArray[np.bool_]) -> Array:
    """Positive (n,) where the normals (n, 2) point into a mask."""
    soft = cv2.GaussianBlur(still.astype(np.float32), (0, 0), 2.0)
    at = [(uv_px + s * normal).astype(np.float32) for s in (-3.0, 3.0)]
    behind, ahead = (cv2.remap(soft, p[:, :1], p[:, 1:], cv2.INTER_LINEAR)[:, 0] for p in at)
    return np.asarray(ahead - behind, dtype=float)


def in_image(uv_px: Array, shape: tuple[int, ...], margin_px: float) -> NDArray[np.bool_]:
    """Mask (n,) of points at least a margin inside of an image of this shape."""
    limit = np.array([shape[1] - 1.0, shape[0] - 1.0]) - margin_px
    return np.asarray(((uv_px >= margin_px) & (uv_px <= limit)).all(axis=-1))


def lines_in_image(
    uv_px: Array, normal: Array, shape: tuple[int, ...], reach_px: float = NARROW_PX
) -> NDArray[np.bool_]:
    """Mask (n,) of search lines that end in an image of this shape; along a finger that leaves it they reach almost to
    its border.
    """
    ends = np.stack([uv_px - reach_px * normal, uv_px + reach_px * normal])
    return np.asarray(in_image(uv_px, shape, FROM_BORDER_PX) & in_image(ends, shape, 1.0).all(axis=0))


def measure_transitions(
    images: NDArray[np.float32], stations: Stations, noise: float, *, wide: bool, blur_px: float | None = None
) -> Transitions:
    """The edge's position at each station in ``images`` (n, h, w); ``wide`` searches within 4 px, otherwise within 2 px
    and more exactly.  ``blur_px`` is estimated if None.
    """
    reach = WIDE_PX if wide else NARROW_PX
    search = WIDE_SEARCH_PX if wide else NARROW_SEARCH_PX
    s = np.arange(-reach, reach + 0.25, STEP_PX)
    profiles = across(images, stations, s)
    within, beyond = s <= -search - 0.5, s >= search + 0.5
    if not wide:
        within, beyond = (s <= -2.0) & (s >= -4.0), (s >= 2.0) & (s <= 4.0)
    finger = _finger_levels(profiles, s, wide=wide)
    d = profiles - finger[None]
    off = d[:, :, within].mean(axis=2)
    # Light changes on a finger, much alike along it; where its grey level is another than beside, or changes along the
    # search line, something else is in front of it, or it has ended, and the image isn't used at this station.
    light = median_filter(off, (1, ALIKE_STATIONS), mode="nearest")
    usual = _usual(finger, within)
    d -= (light / usual)[:, :, None] * finger[None]
    sound = (np.abs(off - light) < 4.0 * max(noise, 1.0)) & (np.abs(light) < MOST_RELIGHT * usual)
    contrast = np.where(sound, d[:, :, beyond].mean(axis=2), 0.0)
    # Beyond a few times the usual contrast more doesn't help: errors then grow with the contrast.
    weight = contrast / np.maximum(1.0, np.abs(contrast) / 60.0)
    shading = 1.0 if wide else _shading(finger[:, s <= -search], d, contrast, s, search)
    weight = weight - shading * weight.mean(axis=0)
    upper, lower = weight[:, :, None] * d, weight * contrast
    total_upper, total_lower = upper.sum(axis=0), lower.sum(axis=0)
    usable = stations.inside & (np.sqrt(np.square(contrast).sum(axis=0)) > FEWEST_CONTRASTS * noise)
    clear, different = backgrounds_beside(contrast, usual + light, noise)
    usable &= (clear >= FEWEST_CLEAR) & (different >= FEWEST_BACKGROUNDS)
    transition = total_upper / np.maximum(total_lower, 1e-6)[:, None]
    near = (s >= -search - 2.0) & (s <= search + 2.5)
    if blur_px is None:
        blur_px = _usual_blur(transition[usable][:, near], s[near], search)
    offset, fits = _edge(transition[:, near], s[near], blur_px, search)
    usable &= fits
    fold = folds_of(len(images))
    without = []
    for f in range(int(fold.max()) + 1):
        part = fold == f
        rest = np.maximum(total_lower - lower[part].sum(axis=0), 1e-6)
        without.append(((total_upper - upper[part].sum(axis=0)) / rest[:, None])[:, near])
    folds = _edge(np.concatenate(without), s[near], blur_px, search)[0].reshape(len(without), -1)
    shift, worth, sharpness = _of_each(d, contrast, s, offset, blur_px, usable)
    return Transitions(offset, folds, usable, blur_px, shift, worth, sharpness, clear, different, usual)


def backgrounds_beside(contrast: Array, finger: Array, noise: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """How many images (s,) show a clear contrast (n, s) to the ``finger``'s grey level (n, s) at each station, and how
    many different backgrounds (s,) these have: ranges of grey levels, as wide as a clear contrast is high, that hold
    some.  A pad has the same grey in all images, or one that follows the finger's light, whatever its contrast does.
    """
    least = CLEAR_NOISES * max(noise, 1.0)
    clear = np.abs(contrast) > least
    behind = contrast + finger
    light = np.maximum(finger, 1.0) / np.maximum(np.median(finger, axis=0), 1.0)
    different = np.minimum(*(_ranges(np.where(clear, each, np.inf), least) for each in (behind, behind / light)))
    return np.count_nonzero(clear, axis=0), np.asarray(different, np.intp)


def _ranges(levels: Array, width: float) -> NDArray[np.intp]:
    """How many ranges (s,) of this width hold some of the finite levels (n, s)."""
    levels = np.sort(levels, axis=0)
    lowest = np.where(np.isfinite(levels[0]), levels[0], 0.0)
    # Of many images the levels leave no gaps, so that their range is divided.
    steps = np.floor((np.where(np.isfinite(levels), levels, lowest) - lowest) / width)
    return np.asarray(np.count_nonzero(np.diff(steps, axis=0) > 0.0, axis=0) + np.isfinite(levels[0]), np.intp)


def _usual(finger: Array, within: NDArray[np.bool_]) -> Array:
    """Grey level (stations,) inside of the finger; at least 10 of 255."""
    return np.maximum(finger[:, within].mean(axis=1), 10.0)


def _finger_levels(profiles: NDArray[np.float32], s: Array, *, wide: bool) -> Array:
    """Grey levels (stations, samples) of the finger, to be subtracted: inside of it, its median over the images; across
    the edge and beyond, the last of these.
    """
    last = int(np.flatnonzero(s <= (-4.5 if wide else -1.5))[-1])
    usual = np.median(profiles[:, :, : last + 1], axis=0)
    beyond = usual[:, max(last - 1, 0) :].mean(axis=1, keepdims=True)
    return np.hstack([usual[:, :last], np.repeat(beyond, len(s) - last, axis=1)])


def _shading(own: Array, d: Array, contrast: Array, s: Array, search_px: float) -> float:
    """Part, 0 to 1, of the contrasts' mean to leave out.  The mean also contains the finger's own shading, which is the
    same in all images; the contrasts' differences contain only the background.  ``own``: grey levels (stations,
    samples) of the finger before the edge.  With the shading's variance t² and the
    backgrounds' texture v, known from n images: ``n t² / (n t² + v)`` (the shrinkage of a random intercept).
    """
    design = np.vander(s[s <= -search_px], 2)
    trend = own @ np.linalg.pinv(design).T @ design.T
    shading = float(np.median(np.square(own - trend).sum(axis=1) / max(own.shape[1] - 2, 1)))
    texture = d[:, :, s >= 1.5][:, :, 0] - contrast
    rest = float(np.median(np.square(texture).mean(axis=0)))
    return len(d) * shading / max(len(d) * shading + rest, 1e-6)


def across(images: NDArray[np.float32], stations: Stations, s: Array) -> NDArray[np.float32]:
    """Grey levels (n, stations, samples)."""
    maps = [(stations.uv_px[:, k, None] + stations.normal[:, k, None] * s).astype(np.float32) for k in (0, 1)]
    return np.stack([
        cv2.remap(image, maps[0], maps[1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE) for image in images
    ])  # fmt: skip


@lru_cache(maxsize=128)
def _bases(samples: tuple[float, ...], blur_px: float, search_px: float) -> tuple[Array, Array]:
    """Positions to try (g,), and the four vectors of an orthonormal basis of the transition at each (samples, 4 g)."""
    s = np.array(samples)
    grid = np.arange(-search_px, search_px + 0.5 * _GRID_PX, _GRID_PX)
    bases = []
    for e in grid:
        rise = ndtr((s - e) / blur_px)
        bases.append(np.linalg.qr(np.column_stack([rise, rise * (s - e), 1.0 - rise, (1.0 - rise) * (s - e)]))[0])
    return grid, np.stack(bases, axis=2).reshape(len(s), -1)


def _misfit(transition: Array, s: Array, blur_px: float, search_px: float) -> tuple[Array, Array]:
    grid, bases = _bases(tuple(s.tolist()), blur_px, search_px)
    within = np.square(transition @ bases).reshape(-1, 4, len(grid)).sum(axis=1)
    return grid, np.square(transition).sum(axis=1) - within.T


def _usual_blur(transition: Array, s: Array, search_px: float) -> float:
    if not len(transition):
        return BLURS_PX[0]
    sample = transition[:: max(1, len(transition) // 400)]
    costs = [float(np.median(_misfit(sample, s, b, search_px)[1].min(axis=0))) for b in BLURS_PX]
    return float(BLURS_PX[int(np.argmin(costs))])


def _edge(transition: Array, s: Array, blur_px: float, search_px: float) -> tuple[Array, NDArray[np.bool_]]:
    """Position (stations,) by least squares, and whether it lies inside of the search range."""
    grid, cost = _misfit(transition, s, blur_px, search_px)
    best = cost.argmin(axis=0)
    inner = (best > 0) & (best < len(grid) - 1)
    at = np.clip(best, 1, len(grid) - 2)
    column = np.arange(cost.shape[1])
    low, mid, high = cost[at - 1, column], cost[at, column], cost[at + 1, column]
    bend = np.maximum(low - 2.0 * mid + high, 1e-12)
    return grid[at] + 0.5 * _GRID_PX * np.clip((low - high) / bend, -1.0, 1.0), inner


def _of_each(
    d: Array, contrast: Array, s: Array, offset: Array, blur_px: float, usable: NDArray[np.bool_]
) -> tuple[Array, Array, Array]:
    """To first order: shift of the edge in each image against all, its information, and each image's sharpness."""
    away = (s[None] - offset[:, None]) / blur_px
    near = np.abs(away) < 2.5
    rise, slope = ndtr(away), np.where(near, np.exp(-0.5 * away**2) / (blur_px * (2.0 * np.pi) ** 0.5), 0.0)
    strength = np.square(slope).sum(axis=1)
    rest = d - contrast[:, :, None] * rise[None]
    shift = -np.einsum("nij,ij->ni", rest, slope) / np.where(np.abs(contrast) > 1e-3, contrast, 1e-3) / strength
    worth = np.where(usable[None], np.square(contrast), 0.0)
    # The transition's slope in each image over the expected one.
    steep = np.gradient(d, s, axis=2)
    own = np.einsum("nij,ij,ni->n", steep, slope, np.where(usable, contrast, 0.0))
    expected = np.einsum("ij,ni->n", np.square(slope), worth)
    return shift, worth, own / np.maximum(expected, 1e-9)


def to_ideal_px(camera: Camera, uv_px: Array) -> Array:
    """Image coordinates (n, 2) without the lens's distortion, in pixels: there straight edges are straight."""
    return np.asarray(camera.undistort(uv_px) * camera.fx_px)


def from_ideal_px(camera: Camera, ideal_px: Array) -> Array:
    """The inverse of :func:`to_ideal_px`."""
    return np.asarray(camera.distort(ideal_px / camera.fx_px))
