"""What a plate's print looks like wherever it may be seen: the background of an outline, known beforehand."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.calibrate.sighting import Sighting
from gripmon.model.camera import Camera
from gripmon.model.records import Array, Image
from gripmon.model.targets import Charuco, Chequerboard, Target
from gripmon.track.edges.profiles import read_profiles

_BESIDE = 0.1
"""Of a square, from a corner along both axes: so near a square shows its own colour, before any mark in it."""
_MARK_PX = 12
"""Size of a mark's cells in the picture that is looked up."""


@dataclass(frozen=True, slots=True)
class PlatePrint:
    """A chequerboard, with or without marks, at ``cam_T_plate`` (4, 4) of ``camera``.

    Squares ``step_m`` long are counted from ``origin_m`` (2,); those from ``first`` (2,) to before ``last`` (2,) are
    known to be there, and the square (0, 0) is light if ``first_light``.  ``marked``: the whole print from above, if it
    has marks.  ``light`` and ``dark`` (3,): grey levels, constant and slopes along u and v.
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
        """(n,) 1 where pixels (n, 2) lie on light print, 0 on dark, nan beyond the pattern."""
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
    """The print of a chequerboard or ChArUco board, its colours from the image about its corners; None for discs, whose
    outlines nobody takes for a finger's, and where dark and light can't be told.
    """
    if not isinstance(target, Chequerboard | Charuco) or sighting.disc_radius_m > 0.0:
        return None
    step_m = target.square_m
    xy_m = sighting.plate_m[:, :2]
    origin_m = np.zeros(2) if isinstance(target, Charuco) else xy_m[0]
    cells = np.rint((xy_m - origin_m) / step_m).astype(np.intp)
    uv_px, grey = [], []
    for right, down in ((1, 1), (-1, -1), (1, -1), (-1, 1)):
        beside = sighting.plate_m + np.array([right, down, 0.0]) * _BESIDE * step_m
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
    """The board from above: of both patterns that OpenCV has had, the one that begins with this colour."""
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
    """Constant and slopes (3,) of grey levels; half of them, the nearest to their plane, settle it."""
    terms = np.column_stack([np.ones(len(uv_px)), uv_px])
    out: Array = np.linalg.lstsq(terms, levels, rcond=None)[0]
    for _ in range(3):
        off = np.abs(levels - terms @ out)
        near = off <= 3.0 * np.median(off) + 1e-9
        out = np.linalg.lstsq(terms[near], levels[near], rcond=None)[0]
    return out
