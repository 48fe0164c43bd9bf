"""Curved edges of an outline, as of round fingertips: a smooth curve through the points the images show along it.

Straight pieces show where a curve bends, but their vertices lie beside it.  So the curve is measured along itself, one
point per pixel, and a cubic spline is fitted (least squares; de Boor 1978), with denser knots where the pieces are
short.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, CubicSpline, make_lsq_spline

from gripmon.model.camera import Camera
from gripmon.model.gripper.model import MOST_VIA
from gripmon.model.records import Array
from gripmon.teach.image_outline import OpeningSeen
from gripmon.teach.piece_lines import LEAST_SCATTER_PX, STRAIGHT_PX
from gripmon.teach.silhouette import (
    Stations,
    from_ideal_px,
    inner_side,
    lines_in_image,
    measure_transitions,
    to_ideal_px,
)

ON_A_PIECE = (0.5 - 0.5 / math.sqrt(3.0), 0.5 + 0.5 / math.sqrt(3.0))
"""Fractions of its length at which a piece, the least-squares line through a stretch of a curve, crosses the curve:
exact for a parabola."""
KNOTS_PX = 5.0
"""Knot spacing where a curve bends.  Where a straight edge turns into a circle of 15 px (2 mm, 100 mm away) the
curvature jumps, and a cubic spline misses that by up to 0.05 px; five points of 0.1 px give the same error."""
STRAIGHT_FROM_PX = 4.0 * KNOTS_PX
"""Length above which a piece of a curve bends at its ends at most."""
_FEWEST_BETWEEN_KNOTS = 3
_UNSEEN_WEIGHT = 0.1
_ROUNDS = 3


def smooth_curve(
    camera: Camera, seen: OpeningSeen, mask: NDArray[np.bool_], uv_px: Array, tangent: tuple[bool, bool]
) -> tuple[Array, Array]:
    """Points (n, 2) along a curve in the image, including its ends, and the position (n,) of each, counted in pieces.

    ``uv_px`` (v, 2): the vertices of its pieces; ``tangent``: whether the first and the last piece lie on straight
    edges; the curve then begins where it leaves these.  Where the images show nothing the pieces count.
    """
    vertices = to_ideal_px(camera, uv_px)
    steps = np.linalg.norm(np.diff(vertices, axis=0), axis=1)
    at = np.concatenate([[0.0], np.cumsum(steps)])
    places, points = _on_pieces(at, vertices, tangent)
    curve: BSpline | CubicSpline = CubicSpline(places, points)
    s = np.linspace(0.0, at[-1], max(int(at[-1]), 8) + 1)
    for _ in range(_ROUNDS):
        base = curve(s)
        uv = from_ideal_px(camera, base)
        way = np.gradient(uv, axis=0)
        normal = np.column_stack([-way[:, 1], way[:, 0]]) / np.linalg.norm(way, axis=1)[:, None]
        normal = np.where(inner_side(uv, normal, mask)[:, None] > 0.0, -normal, normal)
        stations = Stations(uv, normal, lines_in_image(uv, normal, mask.shape))
        found = measure_transitions(seen.matte.images, stations, seen.matte.noise, wide=False, blur_px=seen.blur_px)
        shown = to_ideal_px(camera, uv + np.where(found.usable, found.offset_px, 0.0)[:, None] * normal)
        curve = _spline(at, s, np.where(found.usable[:, None], shown, base), found.usable, vertices[[0, -1]])
    first, last = (_leaves(curve, s, vertices, end) if tangent[end] else s[end] for end in (0, -1))
    knots = curve.t[3:-3]
    via = np.sort(np.concatenate([knots[1:-1], 0.5 * (knots[1:] + knots[:-1])]))
    via = via[(via > first + 0.5 * KNOTS_PX) & (via < last - 0.5 * KNOTS_PX)]
    if len(via) > MOST_VIA:  # along a whole side of a finger in a large image
        via = via[np.rint(np.linspace(0.0, len(via) - 1.0, MOST_VIA)).astype(int)]
    points = curve(via)
    ends = [curve(at_px) for at_px in (first, last)]
    for end in (0, -1):
        if tangent[end]:
            ends[end] = _foot(vertices[[end, 1 if end == 0 else -2]], ends[end])
    places = np.concatenate([[first], via, [last]])
    uv = from_ideal_px(camera, np.vstack([ends[0], points, ends[1]]))
    return uv, np.interp(places, at, np.arange(len(at)))


def _leaves(curve: BSpline | CubicSpline, s: Array, vertices: Array, end: int) -> float:
    """Position at which a curve leaves the straight edge that its first (0) or last (-1) piece lies on."""
    p = curve(s)
    line = vertices[[end, 1 if end == 0 else -2]]
    off = np.linalg.norm(p - _foot(line, p), axis=1) > STRAIGHT_PX
    if not off.any():
        return float(s[end])
    return float(s[int(np.flatnonzero(off)[end])])


def _foot(line: Array, points: Array) -> Array:
    """Feet of the perpendiculars from points (..., 2) to the line through two points (2, 2)."""
    way = line[1] - line[0]
    return np.asarray(line[0] + ((points - line[0]) @ way / float(way @ way))[..., None] * way)


def _on_pieces(at: Array, vertices: Array, tangent: tuple[bool, bool]) -> tuple[Array, Array]:
    """Points (n, 2) where the curve crosses its pieces, and their position (n,) along them; a piece on a straight edge
    contributes its middle and its end.
    """
    places, points = [at[0]], [vertices[0]]
    for k in range(len(at) - 1):
        straight = (k == 0 and tangent[0]) or (k == len(at) - 2 and tangent[1])
        for share in (0.5,) if straight else ON_A_PIECE:
            places.append(at[k] + share * (at[k + 1] - at[k]))
            points.append(vertices[k] + share * (vertices[k + 1] - vertices[k]))
    return np.array([*places, at[-1]]), np.array([*points, vertices[-1]])


def _knots(at: Array) -> list[float]:
    """Inner knots, densest along short pieces."""
    out: list[float] = []
    for start, end in itertools.pairwise(at.tolist()):
        if end - start > STRAIGHT_FROM_PX:
            out += [start, start + KNOTS_PX, end - KNOTS_PX]
        else:
            out += np.linspace(start, end, max(round((end - start) / KNOTS_PX), 1), endpoint=False).tolist()
    return out[1:]


def _spline(at: Array, s: Array, shown: Array, usable: NDArray[np.bool_], ends: Array) -> BSpline:
    """Robust spline from end to end through points ``shown`` (n, 2) at positions ``s`` (n,) along the pieces."""
    knots = [0.0]
    for knot in _knots(at):
        if np.count_nonzero((s > knots[-1]) & (s < knot)) >= _FEWEST_BETWEEN_KNOTS:
            knots.append(knot)
    if len(knots) > 1 and np.count_nonzero(s > knots[-1]) < _FEWEST_BETWEEN_KNOTS:
        knots.pop()
    t = np.concatenate([np.zeros(4), knots[1:], np.full(4, at[-1])])
    places, points = np.concatenate([[0.0], s[1:-1], [at[-1]]]), np.vstack([ends[:1], shown[1:-1], ends[1:]])
    worth = np.where(usable[1:-1], 1.0, _UNSEEN_WEIGHT)
    robust = np.ones(len(worth))
    for _ in range(_ROUNDS):
        # The ends are known as well as the straight edges on which they lie, so they get a high weight.
        curve = make_lsq_spline(places, points, t, w=np.concatenate([[10.0], worth * robust, [10.0]]))
        off = np.linalg.norm(points[1:-1] - curve(s[1:-1]), axis=1)
        robust = 1.0 / np.maximum(off / max(2.0 * float(np.median(off)), LEAST_SCATTER_PX), 1.0)
    return curve
