"""Where the pieces of edges are predicted, in machine code.

s pieces of edges, f fingers; points in the camera frame (m), places in ideal image coordinates.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from gripmon.model.compiled import compiled

POSE, JAW, FOCAL, FINGERS = slice(0, 6), 6, 7, 8
"""Places of the unknowns; finger f has the six from ``FINGERS + 6 f`` on: translation, then rotation about the middle
of its points, camera axes."""


@compiled
def beside_edges(
    start: Any, end: Any, xy: Any, by_focal: Any, per_px: Any, rate: Any, finger: Any, origin: Any, pivots: Any
) -> tuple[Any, Any, Any]:
    """Measured minus predicted places (s,) across edges from ``start`` to ``end`` (s, 3), px; the derivative (s, m) of
    the predicted ones by all unknowns; and the fraction (s,) of the edge beside which each place ``xy`` (s, 2) lies.

    The image of an edge is the line l = start x end; with the unit normal n across it a place is (l x) / (l n) off.
    The point of the edge that shows beside it is as far along the image line.  A point's motion m moves the edge by
    n (m_xy - x m_z) / z; ``by_focal`` (s, 2) is what the logarithm of the focal length moves predictions by,
    ``per_px`` (s,) ideal units a pixel, ``rate`` (s, 3) the motion by the jaw opening.  Rotations are about ``origin``
    (3,), the gripper's, and for each ``finger`` (s,) about one of the ``pivots`` (f, 3).
    """
    count = len(xy)
    residual, fraction = np.empty(count), np.empty(count)
    jacobian = np.zeros((count, FINGERS + 6 * len(pivots)))
    for s in range(count):
        x, y = xy[s, 0], xy[s, 1]
        a, b = start[s], end[s]
        along_x, along_y = b[0] / b[2] - a[0] / a[2], b[1] / b[2] - a[1] / a[2]
        length = math.sqrt(along_x * along_x + along_y * along_y)
        along_x, along_y = along_x / length, along_y / length
        n_x, n_y = -along_y, along_x
        line_x, line_y = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2]
        line_z = a[0] * b[1] - a[1] * b[0]
        off = (line_x * x + line_y * y + line_z) / (line_x * n_x + line_y * n_y)
        residual[s] = off / per_px[s]
        at = along_x * x + along_y * y
        above = at * a[2] - along_x * a[0] - along_y * a[1]
        below = along_x * (b[0] - a[0]) + along_y * (b[1] - a[1]) - at * (b[2] - a[2])
        fraction[s] = above / below
        spot_x, spot_y = a[0] + fraction[s] * (b[0] - a[0]), a[1] + fraction[s] * (b[1] - a[1])
        spot_z = a[2] + fraction[s] * (b[2] - a[2])
        scale = 1.0 / (spot_z * per_px[s])
        g_x, g_y = n_x * scale, n_y * scale
        g_z = -(n_x * spot_x + n_y * spot_y) / spot_z * scale
        own, middle = jacobian[s], pivots[finger[s]]
        _moved(own, 0, g_x, g_y, g_z, spot_x - origin[0], spot_y - origin[1], spot_z - origin[2])
        own[JAW] = g_x * rate[s, 0] + g_y * rate[s, 1] + g_z * rate[s, 2]
        own[FOCAL] = (n_x * by_focal[s, 0] + n_y * by_focal[s, 1]) / per_px[s]
        first = FINGERS + 6 * finger[s]
        _moved(own, first, g_x, g_y, g_z, spot_x - middle[0], spot_y - middle[1], spot_z - middle[2])
    return residual, jacobian, fraction


@compiled
def _moved(out: Any, first: int, g_x: float, g_y: float, g_z: float, x: float, y: float, z: float) -> None:
    """The gradient g by a translation, and lever x gradient by a rotation, from the place ``first`` of ``out`` on."""
    out[first], out[first + 1], out[first + 2] = g_x, g_y, g_z
    out[first + 3], out[first + 4], out[first + 5] = y * g_z - z * g_y, z * g_x - x * g_z, x * g_y - y * g_x


def warm_up() -> None:
    """Compile what the first analysis needs, or load what was compiled."""
    piece, place, one = np.ones((1, 3)), np.ones((1, 2)), np.ones(1)
    beside_edges(piece, piece, place, place, one, piece, np.zeros(1, dtype=np.intp), np.ones(3), piece)
