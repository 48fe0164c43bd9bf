"""What lies beside an edge: the grey level of the finger's own side, and which side is the brighter one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array
from gripmon.teach.edges.estimate import EdgeLines
from gripmon.teach.edges.views import View, Viewer
from gripmon.track.edges.prediction import STEP_PX
from gripmon.track.edges.profiles import full_scale
from gripmon.track.edges.taught import Look

NEAR_PX, FAR_PX = 1.5, 3.0
"""Where a side's grey level is taken: beyond the edge's blur, before the next feature (px, times the zoom)."""

AGREEING_SHARE = 0.95
"""Part of the edge points of all images that must have the same side brighter."""

FEWEST_BACKGROUNDS = 3
"""Images that an outline's brighter side must be seen in: it depends on the background."""

DIFFERENT_SHARE = 0.1
"""Backgrounds differ clearly if their levels beside an edge span at least this part of the full scale."""

Side = Literal["left", "right", "any"]


class EdgeLook(NamedTuple):
    """``brighter`` side, and the look of those sides that are the finger's."""

    brighter: Side
    left: Look | None
    right: Look | None


class _Sides(NamedTuple):
    """Grey levels (k,) to the left and to the right of an edge's points, their steps (k,) and images (k,)."""

    left: Array
    right: Array
    step: Array
    image: NDArray[np.intp]


def edge_looks(viewer: Viewer, views: Sequence[View], lines: Mapping[int, EdgeLines]) -> dict[int, EdgeLook]:
    """The looks of all edges that have lines.

    Levels count relative to the median over all edges of an image, which takes exposure out.
    """
    sides = {index: _sides(views, edge) for index, edge in lines.items() if edge.line is not None}
    gains = [_usual_level(viewer, sides, number) for number in range(len(views))]
    scale = full_scale(views[0].image.image)
    looks = {}
    for index, side in sides.items():
        gain = np.array(gains)[side.image]
        inside, crease = viewer.inside[index], viewer.crease[index]
        left = _look(side.left / gain) if crease or inside < 0.0 else None
        right = _look(side.right / gain) if crease or inside > 0.0 else None
        sure = crease or (inside != 0.0 and _shows_on_any_background(side, inside, scale))
        looks[index] = EdgeLook(_brighter(side.step) if sure else "any", left, right)
    return looks


def _sides(views: Sequence[View], edge: EdgeLines) -> _Sides:
    assert edge.line is not None
    points, inlier = edge.sampled.points, edge.line.inlier
    parts = []
    for number, view in enumerate(views):
        candidate = points.candidate[inlier & (points.image == number)]
        found, grey = view.candidates, view.profiles
        sample, step = found.sample[candidate], found.step[candidate]
        # Samples lie farther apart where the image is measured on a coarser scale, and edges are wider there.
        middle = grey.shape[1] // 2 + found.offset_px[candidate] / (STEP_PX * found.zoom)
        near, far = NEAR_PX / STEP_PX, FAR_PX / STEP_PX
        levels = [_level(grey[sample], middle + side * near, middle + side * far) for side in (-1.0, 1.0)]
        parts.append((*levels, step, np.full(len(sample), number)))
    return _Sides(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _level(grey: NDArray[np.float32], start: Array, end: Array) -> Array:
    """(k,) mean of each row of ``grey`` (k, s) between two places on it, samples; NaN where they leave it."""
    places = np.linspace(start, end, 4)
    low = np.floor(places).astype(int)
    outside = (low < 0) | (low + 1 >= grey.shape[1])
    low = np.clip(low, 0, grey.shape[1] - 2)
    rows = np.arange(len(grey))
    values = grey[rows, low] + (places - low) * (grey[rows, low + 1] - grey[rows, low])
    return np.asarray(np.where(outside, np.nan, values).mean(axis=0))


def _usual_level(viewer: Viewer, sides: Mapping[int, _Sides], image: int) -> float:
    """Median over all edges of the finger's level beside them, in one image."""
    levels = []
    for index, side in sides.items():
        for sign, grey in ((-1.0, side.left), (1.0, side.right)):
            own = grey[(side.image == image) & np.isfinite(grey)]
            if len(own) and (viewer.crease[index] or viewer.inside[index] == sign):
                levels.append(float(np.median(own)))
    return max(float(np.median(levels)), 1e-9) if levels else 1.0


def _look(relative: Array) -> Look | None:
    relative = relative[np.isfinite(relative)]
    if not len(relative):
        return None
    level = float(np.median(relative))
    spread = 1.4826 * float(np.median(np.abs(relative - level)))
    return Look(level=round(max(level, 0.0), 4), spread=round(spread, 4))


def _brighter(step: Array) -> Side:
    right = float(np.mean(step > 0.0))
    return "right" if right >= AGREEING_SHARE else "left" if right <= 1.0 - AGREEING_SHARE else "any"


def _shows_on_any_background(side: _Sides, inside: float, scale: float) -> bool:
    """Whether an outline's polarity can be relied on: several clearly different backgrounds, all of them on one side of
    the finger's level and farther from it than they differ among themselves.
    """
    finger, beyond = (side.right, side.left) if inside > 0.0 else (side.left, side.right)
    images = np.unique(side.image)
    if len(images) < FEWEST_BACKGROUNDS:
        return False
    levels = np.array([np.nanmedian(beyond[side.image == number]) for number in images])
    span = float(levels.max() - levels.min())
    nearest = float(np.nanpercentile(np.abs(beyond - finger), 100.0 * (1.0 - AGREEING_SHARE)))
    return span >= DIFFERENT_SHARE * scale and nearest >= span
