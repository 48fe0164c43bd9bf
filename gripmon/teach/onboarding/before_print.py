"""An edge of a finger before a print that is known: where the image stops to look like the plate.

Edge points alone can't tell it there: lines of the print are edges, too, those that end at the outline shift it, and
before squares as dark as the finger there is none.  Instead the image is predicted: a finger of one brightness on one
side of a line, the print on the other, all blurred alike.  How far each profile wants the line moved, and how much it
knows of it, follow by linearisation: profiles along which finger and print look the same know nothing, and the sign of
the contrast may change from square to square.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from gripmon.model.records import Array, Image
from gripmon.teach.onboarding.plate_print import PlatePrint
from gripmon.track.edges.profiles import read_profiles

_FINE = 3
"""Samples of the prediction a pixel."""
_WINDOW_PX = 2.0
"""Standard deviation of the weight about the line: the finger's face is of one brightness only nearby."""
_USUAL_BLUR_PX = 1.0
_BLURS = np.geomspace(0.5, 3.0, 10)
_LEAST_DIFFERENCE = 0.1
"""Of the print's contrast: by so much levels near the line may differ from what they were taken to be."""
_GRID_PX = 0.5


@dataclass(frozen=True, slots=True)
class Scene:
    """Surroundings of an edge, along it and across: ``seen`` (n, x) of the image with its offsets ``across_px`` (x,);
    ``print_shown`` (3n, 3x) as :meth:`PlatePrint.shown`; ``light`` and ``dark`` (n,) levels; ``finger``: 1 if it lies
    on the side of positive offsets, or -1.
    """

    seen: Array
    across_px: Array
    print_shown: Array
    light: Array
    dark: Array
    finger: float


@dataclass(frozen=True, slots=True)
class Moves:
    """``offset_px`` (n,) where each profile has the line, ``worth`` (n,) its information on it (relative)."""

    offset_px: Array
    worth: Array


def look_at(image: Image, printed: PlatePrint, uv_px: Array, normal: Array, aside_px: float, finger: float) -> Scene:
    """The scene about an edge sampled at ``uv_px`` (n, 2) with its ``normal`` (n, 2)."""
    count, half = len(uv_px), int(np.ceil(aside_px))
    across = np.arange(-half, half + 1.0)
    column, row = ((uv_px[:, None, k] + across * normal[:, None, k]).astype(np.float32) for k in (0, 1))
    seen = read_profiles(image, column, row).astype(np.float64)
    fine = (np.arange(_FINE) - 0.5 * (_FINE - 1)) / _FINE
    along = np.clip(np.add.outer(np.arange(count), fine).ravel(), 0.0, count - 1.0)
    aside = np.add.outer(across, fine).ravel()
    base = np.column_stack([np.interp(along, np.arange(count), uv_px[:, k]) for k in (0, 1)])
    turned = np.column_stack([np.interp(along, np.arange(count), normal[:, k]) for k in (0, 1)])
    places = base[:, None] + aside[:, None] * turned[:, None]
    shown = printed.shown(places.reshape(-1, 2)).reshape(places.shape[:2])
    light, dark = printed.levels(uv_px)
    return Scene(seen, across, shown, light, dark, finger)


def rough_line(scene: Scene, way: Array, reach_px: float) -> Array:
    """The line (2,), its offsets at both ends, that parts what looks like the print from what looks like the finger.

    What a finger looks like is taken from where it must be, beyond the reach of the rough line.
    """
    contrast = float(np.median(scene.light - scene.dark))
    share = _pixels(_blurred(np.nan_to_num(scene.print_shown, nan=1.0), _USUAL_BLUR_PX))
    print_level = scene.dark[:, None] + (scene.light - scene.dark)[:, None] * share
    inside = scene.seen[:, scene.finger * scene.across_px > 0.5 * reach_px]
    level = float(np.median(inside))
    spread = max(1.4826 * float(np.median(np.abs(inside - level))), _LEAST_DIFFERENCE * contrast)
    apart = np.square((scene.seen - level) / spread) - np.square(
        (scene.seen - print_level) / (_LEAST_DIFFERENCE * contrast)
    )
    likely = np.clip(0.5 * apart + np.log(spread / (_LEAST_DIFFERENCE * contrast)), -3.0, 3.0)  # of print to finger
    # Sums from the negative side; the line at x has everything below x on one side.
    below = np.concatenate([np.zeros((len(likely), 1)), np.cumsum(likely, axis=1)], axis=1)
    score = scene.finger * (2.0 * below - below[:, -1:])
    starts = scene.across_px[0] - 0.5
    steps = np.arange(-reach_px, reach_px + 0.5 * _GRID_PX, _GRID_PX)
    ends = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    at = ends[:, :1] * (1.0 - way) + ends[:, 1:] * way - starts
    left = np.floor(at).astype(np.intp)
    part = at - left
    row = np.arange(len(way))
    total = (score[row, left] * (1.0 - part) + score[row, left + 1] * part).sum(axis=1)
    best: Array = ends[int(total.argmax())]
    return best


def moves(scene: Scene, way: Array, ends_px: Array, blur_px: float) -> Moves:
    """What each profile wants of the line ``ends_px`` (2,)."""
    line = ends_px[0] * (1.0 - way) + ends_px[1] * way
    fit = _fit(scene, way, line, blur_px)
    step = (_predicted(scene, line + 0.25, blur_px) - _predicted(scene, line - 0.25, blur_px)) / 0.5
    slope, weight, left, finger = fit.applied(step, way), fit.weight, fit.left, fit.finger
    # The finger's brightness is each profile's own: faces are brushed.
    gg, gf, ff = ((weight * a * b).sum(axis=1) for a, b in ((slope, slope), (slope, finger), (finger, finger)))
    gr, fr = ((weight * a * left).sum(axis=1) for a in (slope, finger))
    worth = np.maximum(gg - gf**2 / ff, 0.0)
    move = (gr - gf / ff * fr) / np.maximum(worth, 1e-6 * max(float(worth.max()), 1e-12))
    return Moves(line + move, worth)


def sharpness(scene: Scene, way: Array, ends_px: Array) -> float:
    """Standard deviation (px) of the blur that explains the image best."""
    line = ends_px[0] * (1.0 - way) + ends_px[1] * way
    left = []
    for blur_px in _BLURS:
        fit = _fit(scene, way, line, float(blur_px))
        own = (fit.weight * fit.finger * fit.left).sum(axis=1) / (fit.weight * fit.finger**2).sum(axis=1)
        left.append(float(np.median((fit.weight * np.square(fit.left - fit.finger * own[:, None])).sum(axis=1))))
    return float(_BLURS[int(np.argmin(left))])


@dataclass(frozen=True, slots=True)
class _Fit:
    """``levels`` (4, 2) of finger, light, dark and unknown background, in the middle and their growth along the edge;
    what is ``left`` (n, x) of the image, the ``weight`` of its pixels, and the ``finger``'s share in them.
    """

    levels: Array
    left: Array
    weight: Array
    finger: Array

    def applied(self, shares: Array, way: Array) -> Array:
        """The image (n, x) that ``shares`` (n, x, 4) make."""
        each = self.levels[:, 0] + self.levels[:, 1] * (way[:, None] - 0.5)
        out: Array = np.einsum("nxk,nk->nx", shares, each)
        return out


def _fit(scene: Scene, way: Array, line: Array, blur_px: float) -> _Fit:
    shares = _predicted(scene, line, blur_px)
    weight = np.exp(-0.5 * np.square((scene.across_px - line[:, None]) / _WINDOW_PX))
    root = np.sqrt(weight)
    columns = (np.concatenate([shares, shares * (way[:, None, None] - 0.5)], axis=2) * root[..., None]).reshape(-1, 8)
    # Some kinds of background may be missing, hence no plain solution.
    levels = np.linalg.pinv(columns.T @ columns, rcond=1e-6, hermitian=True) @ (columns.T @ (scene.seen * root).ravel())
    fit = _Fit(levels.reshape(2, 4).T, scene.seen, weight, shares[..., 0])
    return replace(fit, left=scene.seen - fit.applied(shares, way))


def _predicted(scene: Scene, line: Array, blur_px: float) -> Array:
    """Shares (n, x, 4) of the finger, and of light, dark and unknown background, in what each pixel sees."""
    fine = (np.arange(_FINE) - 0.5 * (_FINE - 1)) / _FINE
    at = np.interp(np.add.outer(np.arange(len(line)), fine).ravel(), np.arange(len(line)), line)
    aside = np.add.outer(scene.across_px, fine).ravel()
    mask = np.clip(0.5 + scene.finger * _FINE * (aside - at[:, None]), 0.0, 1.0)
    shown = scene.print_shown
    kinds = [np.ones_like(mask), shown == 1.0, shown == 0.0, np.isnan(shown)]
    parts = np.stack([m * kind for m, kind in zip((mask, *[1.0 - mask] * 3), kinds, strict=True)], axis=-1)
    return _pixels(_blurred(parts, blur_px))


def _blurred(fine: Array, blur_px: float) -> Array:
    blur = blur_px * _FINE
    size = 2 * int(np.ceil(3.5 * blur)) + 1
    out = cv2.GaussianBlur(fine.astype(np.float32), (size, size), blur, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(out, dtype=np.float64)


def _pixels(fine: Array) -> Array:
    """Of three samples the middle one: the blur holds the pixel's own extent."""
    return fine[_FINE // 2 :: _FINE, _FINE // 2 :: _FINE]
