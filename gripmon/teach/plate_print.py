"""What a plate's print looks like anywhere in an image: the known background of an outline."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.calibrate.sighting import Sighting
from gripmon.model.camera import Camera
from gripmon.model.records import Array, Image
from gripmon.model.targets import Charuco, Chequerboard, Target
from gripmon.track.edges.profiles import read_profiles

_LEVEL_OFFSET = 0.1
"""Distance from a corner, in squares, along both axes, at which a square shows its own colour, outside of any mark."""
_MARK_PX = 12
"""Size of a mark's cells in the rendered board."""


@dataclass(frozen=True, slots=True)
class PlatePrint:
    """A chequerboard, with or without marks, at ``cam_T_plate`` (4, 4) of ``camera``.

    Squares ``step_m`` long are counted from ``origin_m`` (2,); those from ``first`` (2,) up to ``last`` (2,),
    exclusive, are known to exist, and the square (0, 0) is light if ``first_light``.  ``marked``: the whole print from
    above, if it has marks.  ``light`` and ``dark`` (3,): grey levels, constant and slopes along u and v.
    """

    camera: Camera
    cam_T_plate: Array
    origin_m: Array
    step_m: float
    first: NDArray[np.intp]
    last: NDArray[np.intp]
    first_light: bool
    marked: NDArray[np.bool_] | None
    light: Array
    dark: Array

    def shown(self, uv_px: Array) -> Array:
        """1 where pixels (n, 2) lie on light print, 0 on dark, NaN beyond the pattern: (n,)."""
        with np.errstate(invalid="ignore", divide="ignore"):
            sight = np.column_stack([self.camera.undistort(uv_px), np.ones(len(uv_px))])
            depth = (self.cam_T_plate[:3, 2] @ self.cam_T_plate[:3, 3]) / (sight @ self.cam_T_plate[:3, 2])
            where = (sight * depth[:, None] - self.cam_T_plate[:3, 3]) @ self.cam_T_plate[:3, :2]
            where = (where - self.origin_m) / self.step_m
        known = np.all((where >= self.first) & (where < self.last), axis=1) & (depth > 0.0)
        where = np.where(known[:, None], where, 0.0)
        if self.marked is None:
            light = (np.floor(where).sum(axis=1) % 2 == 0) == self.first_light
        else:
            scale = np.array(self.marked.shape[::-1]) / self.last
            column, row = np.minimum(where * scale, np.array(self.marked.shape[::-1]) - 1).astype(np.intp).T
            light = self.marked[row, column]
        return np.where(known, light.astype(np.float64), np.nan)

    def levels(self, uv_px: Array) -> tuple[Array, Array]:
        """Grey levels (n,) of light and of dark print."""
        terms = np.column_stack([np.ones(len(uv_px)), uv_px])
        return terms @ self.light, terms @ self.dark


def plate_print(
    camera: Camera, cam_T_plate: Array, sighting: Sighting, target: Target | None, image: Image
) -> PlatePrint | None:
    """The print of a chequerboard or ChArUco board, its grey levels taken near its corners; None for discs, whose
    outlines aren't mistaken for a finger's, and where dark and light can't be distinguished.
    """
    if not isinstance(target, Chequerboard | Charuco) or sighting.disc_radius_m > 0.0:
        return None
    step_m = target.square_m
    xy_m = sighting.plate_m[:, :2]
    origin_m = np.zeros(2) if isinstance(target, Charuco) else xy_m[0]
    cells = np.rint((xy_m - origin_m) / step_m).astype(np.intp)
    uv_px, grey = [], []
    for right, down in ((1, 1), (-1, -1), (1, -1), (-1, 1)):
        beside = sighting.plate_m + np.array([right, down, 0.0]) * _LEVEL_OFFSET * step_m
        uv_px.append(camera.project(beside @ cam_T_plate[:3, :3].T + cam_T_plate[:3, 3]))
        grey.append(_at(image, uv_px[-1]))
    sign = np.where(cells.sum(axis=1) % 2 == 0, 1.0, -1.0)
    difference = np.median(sign * (grey[0] + grey[1] - grey[2] - grey[3]))
    if not abs(difference) > 0.0:
        return None
    first_light = bool(difference > 0.0)
    is_light = np.concatenate([(sign > 0.0) == first_light] * 2 + [(sign > 0.0) != first_light] * 2)
    places, levels = np.concatenate(uv_px), np.concatenate(grey)
    light, dark = _plane(places[is_light], levels[is_light]), _plane(places[~is_light], levels[~is_light])
    if isinstance(target, Charuco):
        first, last = np.zeros(2, np.intp), np.array([target.columns, target.rows])
        marked = _pattern(target, first_light)
    else:
        first, last, marked = cells.min(axis=0) - 1, cells.max(axis=0) + 1, None
    return PlatePrint(camera, cam_T_plate, origin_m, step_m, first, last, first_light, marked, light, dark)


@lru_cache(maxsize=4)
def _pattern(target: Charuco, first_light: bool) -> NDArray[np.bool_]:
    """The board from above: of OpenCV's two patterns, current and legacy, the one that starts with this colour."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, target.dictionary))
    cells = dictionary.markerSize + 2
    square_px = round(_MARK_PX * cells * target.square_m / target.marker_m)
    size = (target.columns, target.rows)
    out = np.zeros((0, 0), np.bool_)
    for legacy in (False, True):
        board = cv2.aruco.CharucoBoard(size, target.square_m, target.marker_m, dictionary)
        board.setLegacyPattern(legacy)
        drawn = board.generateImage((target.columns * square_px, target.rows * square_px), marginSize=0, borderBits=1)
        out = np.asarray(drawn) > 127
        if bool(out[1, 1]) == first_light:
            break
    return out


def _at(image: Image, uv_px: Array) -> Array:
    column, row = np.ascontiguousarray(uv_px.T, np.float32)
    return read_profiles(image, column[:, None], row[:, None])[:, 0].astype(np.float64)


def _plane(uv_px: Array, levels: Array) -> Array:
    """Constant and slopes (3,) of grey levels, by robust least squares."""
    terms = np.column_stack([np.ones(len(uv_px)), uv_px])
    out: Array = np.linalg.lstsq(terms, levels, rcond=None)[0]
    for _ in range(3):
        off = np.abs(levels - terms @ out)
        near = off <= 3.0 * np.median(off) + 1e-9
        out = np.linalg.lstsq(terms[near], levels[near], rcond=None)[0]
    return out


_FINE = 3
"""Samples of the prediction per pixel, along each axis."""
_WINDOW_PX = 2.0
"""Standard deviation of the weight about the line: only close to it is the finger's face uniformly bright."""
_USUAL_BLUR_PX = 1.0
_BLURS = np.geomspace(0.5, 3.0, 10)
_LEAST_DIFFERENCE = 0.1
"""Least assumed deviation of levels near the line from their model, over the print's contrast."""
_GRID_PX = 0.5


@dataclass(frozen=True, slots=True)
class Scene:
    """Surroundings of an edge, along it and across: ``seen`` (n, x) of the image with its offsets ``across_px`` (x,);
    ``print_shown`` (3n, 3x) as from :meth:`PlatePrint.shown`; ``light`` and ``dark`` (n,) levels; ``finger``: 1 if it
    lies on the side of positive offsets, or -1.
    """

    seen: Array
    across_px: Array
    print_shown: Array
    light: Array
    dark: Array
    finger: float


@dataclass(frozen=True, slots=True)
class LineOffsets:
    """``offset_px`` (n,) of the edge on each search line, and its relative information ``worth`` (n,)."""

    offset_px: Array
    worth: Array


def look_at(image: Image, printed: PlatePrint, uv_px: Array, normal: Array, aside_px: float, finger: float) -> Scene:
    """The surroundings of an edge sampled at ``uv_px`` (n, 2) with its ``normal`` (n, 2)."""
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
    """The line (2,), its offsets at both ends, that separates what looks like the print from what looks like the
    finger.  The finger's level is taken beyond the reach of the rough line, where it must be.
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


def line_offsets(scene: Scene, way: Array, ends_px: Array, blur_px: float) -> LineOffsets:
    """Where each search line shows the edge, linearised about the line ``ends_px`` (2,)."""
    line = ends_px[0] * (1.0 - way) + ends_px[1] * way
    fit = _fit(scene, way, line, blur_px)
    step = (_predicted(scene, line + 0.25, blur_px) - _predicted(scene, line - 0.25, blur_px)) / 0.5
    slope, weight, left, finger = fit.applied(step, way), fit.weight, fit.left, fit.finger
    # Each search line has its own brightness of the finger: faces are brushed.
    gg, gf, ff = ((weight * a * b).sum(axis=1) for a, b in ((slope, slope), (slope, finger), (finger, finger)))
    gr, fr = ((weight * a * left).sum(axis=1) for a in (slope, finger))
    worth = np.maximum(gg - gf**2 / ff, 0.0)
    move = (gr - gf / ff * fr) / np.maximum(worth, 1e-6 * max(float(worth.max()), 1e-12))
    return LineOffsets(line + move, worth)


def estimate_blur_px(scene: Scene, way: Array, ends_px: Array) -> float:
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
    """``levels`` (4, 2) of finger, light, dark and unknown background: in the middle, and their change along the edge;
    ``left`` (n, x), the residual of the image, ``weight`` of its pixels, and the ``finger``'s share in them.
    """

    levels: Array
    left: Array
    weight: Array
    finger: Array

    def applied(self, shares: Array, way: Array) -> Array:
        """The image (n, x) that ``shares`` (n, x, 4) give."""
        each = self.levels[:, 0] + self.levels[:, 1] * (way[:, None] - 0.5)
        out: Array = np.einsum("nxk,nk->nx", shares, each)
        return out


def _fit(scene: Scene, way: Array, line: Array, blur_px: float) -> _Fit:
    shares = _predicted(scene, line, blur_px)
    weight = np.exp(-0.5 * np.square((scene.across_px - line[:, None]) / _WINDOW_PX))
    root = np.sqrt(weight)
    columns = (np.concatenate([shares, shares * (way[:, None, None] - 0.5)], axis=2) * root[..., None]).reshape(-1, 8)
    # A kind of background may be absent, hence the pseudo-inverse.
    levels = np.linalg.pinv(columns.T @ columns, rcond=1e-6, hermitian=True) @ (columns.T @ (scene.seen * root).ravel())
    fit = _Fit(levels.reshape(2, 4).T, scene.seen, weight, shares[..., 0])
    return replace(fit, left=scene.seen - fit.applied(shares, way))


def _predicted(scene: Scene, line: Array, blur_px: float) -> Array:
    """Shares (n, x, 4) of the finger, and of light, dark and unknown background, in each pixel."""
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
    """The middle one of three samples: the blur includes the pixel's own extent."""
    return fine[_FINE // 2 :: _FINE, _FINE // 2 :: _FINE]
