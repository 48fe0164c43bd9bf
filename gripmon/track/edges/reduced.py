"""The reduced image that a search looks at: a window about the gripper, without the lens, and what its pixels say for
an outline.

Its coordinates are cells: ideal coordinates from the window's first cell, in steps of its pitch.  Two things speak for
an outline: the grey level changes across it, and on one of its sides, the finger's, it changes less than elsewhere.
What a strong change is differs from scene to scene and from place to place: it is divided by the mean about it, and
both count by how rare they are in this image.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.pixels import GREY_BGR
from gripmon.model.records import Array, Image

Floats = NDArray[np.float32]

ORIENTATIONS = 16
"""Number of orientations of edges, evenly spaced in [0, pi)."""

HALF_LENGTH = 4
"""Cells to both sides over which strengths are averaged along an edge: texture cancels, straight edges don't."""

HIDDEN_PROBABILITY = 0.3
"""Probability that an edge of the gripper doesn't show at a place: hidden, or of too little contrast."""

RANK_EXPONENT = 0.35
"""Exponent of the distribution of an edge's rank where it shows: median at the strongest 14 % of all places."""

SMALLEST_RANK = 0.004
"""Smallest share of the image that is taken to be stronger: a rarer strength says no more."""

BESIDE_CELLS = 3
"""Cells from an outline to where its sides are looked at."""

QUIET_GRADIENT_SHARE = 0.1
"""Gradients below this fraction of the image's 95th percentile all count as calm alike."""

RANK_LEVELS = 256
"""Steps in which values are ranked."""

_NODE = 8  # cells between places at which the lens is evaluated


@dataclass(frozen=True, slots=True)
class Window:
    """``low_xy`` (2,) ideal coordinates of the first cell, ``pitch`` of the cells (no unit), and their number."""

    low_xy: Array
    pitch: float
    columns: int
    rows: int

    def finer(self, factor: int) -> Window:
        """The same part of the view in cells of a fraction of the size."""
        return Window(self.low_xy, self.pitch / factor, self.columns * factor, self.rows * factor)


def window_about(camera: Camera, xy: Array, margin: float, columns: int) -> Window:
    """A window that holds ideal points (n, 2) with a margin (ideal), as far as the image goes; ``columns`` wide, but
    its cells no smaller than pixels.
    """
    u, v = np.linspace(0.0, camera.width_px - 1.0, 17), np.linspace(0.0, camera.height_px - 1.0, 17)
    view = camera.undistort(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))
    low = np.maximum(xy.min(axis=0) - margin, np.nanmin(view, axis=0))
    high = np.minimum(xy.max(axis=0) + margin, np.nanmax(view, axis=0))
    size = np.maximum(high - low, 0.0)
    pitch = max(float(size[0]) / columns, 1.0 / camera.fx_px)
    count = np.ceil(size / pitch).astype(int) + 1
    return Window(low, pitch, int(count[0]), int(count[1]))


def rectify(image: Image, camera: Camera, window: Window) -> tuple[Floats, NDArray[np.bool_]]:
    """Grey levels (rows, columns) in the window, and which cells the image shows."""
    # Averaged first, so that cells far apart leave no pixel out.
    factor = max(1.0, window.pitch * camera.fx_px)
    size = (max(16, round(image.shape[1] / factor)), max(16, round(image.shape[0] / factor)))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    if small.ndim == 3:
        small = small @ GREY_BGR
    if not np.isfinite(small).all():
        # Dead pixels of a float camera: the usual level makes no edge that would outshine all others.
        small[~np.isfinite(small)] = np.nanmedian(small)
    x, y = (
        low + window.pitch * _NODE * np.arange(math.ceil(count / _NODE) + 2)
        for low, count in zip(window.low_xy, (window.columns, window.rows), strict=True)
    )
    nodes_px = camera.distort(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)).reshape(len(y), len(x), 2)
    scale = np.array([image.shape[1] / size[0], image.shape[0] / size[1]])
    nodes = ((nodes_px + 0.5) / scale - 0.5).astype(np.float32)
    steps = np.array([[1.0 / _NODE, 0.0, 0.0], [0.0, 1.0 / _NODE, 0.0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    places = cv2.warpAffine(nodes, steps, (window.columns, window.rows), flags=flags)
    with np.errstate(invalid="ignore"):
        inside = (places >= 0.0) & (places <= np.array(size, dtype=np.float32) - 1.0)
    seen: NDArray[np.bool_] = np.all(inside, axis=2)
    places[~seen] = 0.0
    columns, rows = np.ascontiguousarray(places[..., 0]), np.ascontiguousarray(places[..., 1])
    grey = cv2.remap(small, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    # Beside the image's border an edge can't be distinguished from the border.
    inner = cv2.erode(
        np.asarray(seen, np.uint8), np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0
    )
    return np.asarray(grey, dtype=np.float32), inner.astype(bool)


def gradients(grey: Floats) -> tuple[Floats, Floats]:
    """By Scharr, grey levels a cell."""
    gx, gy = (cv2.Scharr(grey, cv2.CV_32F, *order, scale=1.0 / 32.0) for order in ((1, 0), (0, 1)))
    return np.asarray(gx, dtype=np.float32), np.asarray(gy, dtype=np.float32)


def against_surroundings(strength: Floats, seen: NDArray[np.bool_]) -> Floats:
    """Factor (rows, columns) that makes a strength one of its surroundings; with a floor, half the image's mean."""
    shown = strength * seen
    mean = float(shown.sum()) / max(int(np.count_nonzero(seen)), 1)
    side = 2 * HALF_LENGTH + 1
    level = cv2.blur(shown, (side, side)) + (0.5 * mean + 1e-12)
    return np.asarray(seen / level, dtype=np.float32)


def evidence_table(counts: Array) -> Floats:
    """From how often each level of strength occurs (l,) to what it says for an edge of the gripper: log of its
    probability on such an edge over that anywhere, with mean zero.

    The rank of a place's strength, the share of the image that is stronger, is uniform anywhere; on an edge that
    shows it is distributed as Beta(``RANK_EXPONENT``, 1), on one that doesn't as anywhere.
    """
    total = max(float(counts.sum()), 1.0)
    rank = np.maximum((np.cumsum(counts[::-1])[::-1] - 0.5 * counts) / total, SMALLEST_RANK)
    table = np.log(HIDDEN_PROBABILITY + (1.0 - HIDDEN_PROBABILITY) * RANK_EXPONENT * rank ** (RANK_EXPONENT - 1.0))
    return np.asarray(table - (table @ counts) / total, dtype=np.float32)


def calmness(gx: Floats, gy: Floats, seen: NDArray[np.bool_]) -> Floats:
    """One over the mean gradient (rows, columns) about each cell; what is small against the image's strong ones counts
    alike.
    """
    strength = np.hypot(gx, gy)
    some = strength[::2, ::2][seen[::2, ::2]]
    least = QUIET_GRADIENT_SHARE * float(np.quantile(some, 0.95)) if some.size else 0.0
    return np.asarray(1.0 / np.maximum(cv2.blur(strength, (3, 3)), least + 1e-12), dtype=np.float32)


def evidence_maps(grey: Floats, seen: NDArray[np.bool_]) -> Floats:
    """(o, rows, columns) what each cell says for an outline through it or its neighbours, by the orientation of the
    outline's normal; zero where the image doesn't reach.
    """
    maps = np.zeros((ORIENTATIONS, *grey.shape), dtype=np.float32)
    if not seen.any():
        return maps
    gx, gy = gradients(grey)
    calm, calmer = calmness(gx, gy, seen), np.empty_like(maps)
    block = np.ones((3, 3), np.uint8)
    for k in range(ORIENTATIONS):
        angle = math.pi * k / ORIENTATIONS
        c, s = math.cos(angle), math.sin(angle)
        maps[k] = cv2.dilate(np.abs(cv2.filter2D(c * gx + s * gy, -1, _line_kernel(angle))), block)
        calmer[k] = np.maximum(
            *(_moved(calm, round(sign * BESIDE_CELLS * c), round(sign * BESIDE_CELLS * s)) for sign in (1, -1))
        )
    maps *= against_surroundings(maps.mean(axis=0), seen)
    _add_evidence(maps, calmer, seen)
    maps *= seen
    return maps


def _moved(values: Floats, right: int, down: int) -> Floats:
    """Whole cells on, the border repeated."""
    shift = np.array([[1.0, 0.0, right], [0.0, 1.0, down]])
    size = (values.shape[1], values.shape[0])
    moved = cv2.warpAffine(values, shift, size, flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved, dtype=np.float32)


def _add_evidence(maps: Floats, calmer: Floats, seen: NDArray[np.bool_]) -> None:
    """Replace strengths (o, rows, columns) by their evidence and that of the calmer sides, each orientation ranked
    among its own.
    """
    mask = seen.astype(np.uint8)
    levels = [_levels(values) for values in (maps, calmer)]
    for k in range(ORIENTATIONS):
        for which, level in enumerate(levels):
            counts = cv2.calcHist([level[k]], [0], mask, [RANK_LEVELS], [0, RANK_LEVELS]).ravel().astype(float)
            found = cv2.LUT(level[k], evidence_table(counts))
            maps[k] = maps[k] + found if which else found


def _levels(values: Floats) -> NDArray[np.uint8]:
    top = float(np.quantile(values[:, ::3, ::3], 0.998)) + 1e-12
    return np.minimum(values * ((RANK_LEVELS - 1) / top), RANK_LEVELS - 1).astype(np.uint8)


@lru_cache(maxsize=ORIENTATIONS)
def _line_kernel(angle: float) -> Floats:
    """Mean along a line whose normal has this angle."""
    kernel = np.zeros((2 * HALF_LENGTH + 1, 2 * HALF_LENGTH + 1), np.float32)
    for way in np.linspace(-HALF_LENGTH, HALF_LENGTH, 4 * HALF_LENGTH + 1).tolist():
        kernel[round(HALF_LENGTH + way * math.cos(angle)), round(HALF_LENGTH - way * math.sin(angle))] += 1.0
    return np.asarray(kernel / kernel.sum(), dtype=np.float32)
