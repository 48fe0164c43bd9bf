"""How far a gripper file's outline lies beside polylines that were drawn by hand over the images."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gripmon.model.camera import Camera
from gripmon.model.geometry import invert
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array

BORDER_PX = 10.0
"""Width of the strip along the image's border in which nothing is drawn and nothing is compared."""
_PLACES = 200
"""On a projected edge: at most 10 px apart in an image of 2000 px."""


class Drawn(NamedTuple):
    """Polylines (n, 2) in pixels: the fingers' ``outline``, and other true borders that a file ``may`` have; the
    image's size.
    """

    outline: list[Array]
    may: list[Array]
    size_px: tuple[int, int]


class Beside(NamedTuple):
    """Distances (px) in the median and at 95 %: of the ``written`` outline from the nearest drawn line, and of the
    ``drawn`` one from the written; infinite where there is no line.  ``covered``: share of the drawn outline within
    a pixel of the written one.
    """

    written: tuple[float, float]
    drawn: tuple[float, float]
    covered: float


def drawn_outlines(path: Path, name: str) -> Drawn | None:
    """A set's polylines, from a file of them; None for a set for which none are drawn."""
    sets = json.loads(path.read_text(encoding="utf-8"))
    if name not in sets:
        return None
    lines: dict[str, list[Array]] = {"outline": [], "may": []}
    for chain in sets[name]["chains"]:
        lines[chain["role"]].append(np.array(chain["uv_px"], float))
    width, height = sets[name]["size_px"]
    return Drawn(lines["outline"], lines["may"], (width, height))


def projected_outline(
    gripper: Gripper, camera: Camera, cam_T_grip: Array, jaw_opening_m: float | None = None
) -> list[Array]:
    """Polylines (n, 2), px: the edges that are its outline as seen from the camera, not those within it; nominal
    opening if None.  Places that no pixel shows are left out.
    """
    eye_grip_m = invert(cam_T_grip)[:3, 3]
    points_grip_m = gripper.points_grip_m(jaw_opening_m, eye_grip_m)
    view = gripper.edge_view(points_grip_m, eye_grip_m)
    edges = np.flatnonzero(view.visible & ~view.crease)
    places = gripper.outlines_m(points_grip_m, edges, _PLACES) @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3]
    lines = [camera.project(line) for line in places]
    return [line for line in (line[np.isfinite(line).all(axis=1)] for line in lines) if len(line) > 1]


def beside(drawn: Drawn, written: Sequence[Array]) -> Beside:
    """How far they lie beside each other, at a point each pixel of either."""
    every = points_on(written, drawn.size_px)
    own = _each_px(drawn.outline)
    to_drawn = _distances(every, [*drawn.outline, *drawn.may])
    to_written = _distances(own, written)
    return Beside(_figures(to_drawn), _figures(to_written), float(np.mean(to_written <= 1.0)))


def _figures(distances: Array) -> tuple[float, float]:
    if not len(distances) or not np.isfinite(distances).all():
        return math.inf, math.inf
    return float(np.median(distances)), float(np.quantile(distances, 0.95))


def _each_px(lines: Sequence[Array]) -> Array:
    """Points (n, 2) on polylines, about a pixel apart."""
    out = [np.zeros((0, 2))]
    for line in lines:
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
        at = np.linspace(0.0, along[-1], max(math.ceil(along[-1]), 1) + 1)
        out.append(np.column_stack([np.interp(at, along, line[:, k]) for k in (0, 1)]))
    return np.vstack(out)


def points_on(lines: Sequence[Array], size_px: tuple[int, int]) -> Array:
    """Points (n, 2) on polylines, about a pixel apart, that aren't in the strip along the image's border."""
    points = _each_px(lines)
    last = np.array(size_px) - 1.0 - BORDER_PX
    return np.asarray(points[((points >= BORDER_PX) & (points <= last)).all(axis=1)])


def _distances(points: Array, lines: Sequence[Array]) -> Array:
    """Of each point (n, 2) from the nearest place on any polyline; infinite without one."""
    nearest = np.full(len(points), np.inf)
    for line in lines:
        for start, end in itertools.pairwise(line):
            way = end - start
            share = np.clip((points - start) @ way / max(float(way @ way), 1e-12), 0.0, 1.0)
            np.minimum(nearest, np.linalg.norm(points - start - share[:, None] * way, axis=1), out=nearest)
    return nearest
