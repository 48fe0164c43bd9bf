"""The geometry of a prediction in machine code.

n samples, s places along each search line, r rows of them, e edges of the gripper, v of them sampled; points in the
camera frame (m), images of them in px.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from gripmon.model.compiled import compiled


@compiled
def sampled_ranges(uv_px: Any, inside_px: Any, wanted: Any, margin_px: float, shortest_px: float) -> Any:
    """First and last fraction and length in px (e, 3) of the longest run of each edge inside the image, less the margin
    at the edge's own ends: none where the image's border cuts it.  Zeros if nothing is left, or the edge isn't
    ``wanted`` (e,).  Of edges ``uv_px`` (e, c, 2) c places, evenly spaced, which lie ``inside_px`` (e, c) inside the
    border, outside if negative; the lens maps those that are NaN nowhere.

    Of a short edge the margin leaves twice ``shortest_px``, if half of it suffices for that, or else what half of it
    leaves.
    """
    edges, places = inside_px.shape
    out, travelled = np.zeros((edges, 3)), np.empty(places)
    for e in range(edges):
        if not wanted[e]:
            continue
        travelled[0] = 0.0
        for k in range(1, places):
            dx, dy = uv_px[e, k, 0] - uv_px[e, k - 1, 0], uv_px[e, k, 1] - uv_px[e, k - 1, 1]
            step_px = math.sqrt(dx * dx + dy * dy)
            travelled[k] = travelled[k - 1] + (step_px if step_px == step_px else 0.0)
        first, last, longest, low = 0.0, 0.0, -1.0, 0.0
        starts, ends = 0, 0  # whether the run goes to the edge's own ends
        for k in range(places):
            if not inside_px[e, k] >= 0.0:
                continue
            if k == 0 or not inside_px[e, k - 1] >= 0.0:
                low, begins = travelled[k] - _beyond(travelled, inside_px[e], k, k - 1), int(k == 0)
            if k + 1 == places or not inside_px[e, k + 1] >= 0.0:
                high = travelled[k] + _beyond(travelled, inside_px[e], k, k + 1)
                if high - low > longest:
                    first, last, longest = low, high, high - low
                    starts, ends = begins, int(k + 1 == places)
        if longest < 0.0:
            continue
        off_px = min(margin_px, max(0.5 * margin_px, (longest - 2.0 * shortest_px) / max(starts + ends, 1)))
        low, high = first + off_px * starts, last - off_px * ends
        if high - low >= shortest_px:
            out[e, 0], out[e, 1], out[e, 2] = _fraction(travelled, low), _fraction(travelled, high), high - low
    return out


@compiled
def _beyond(travelled: Any, inside_px: Any, k: int, other: int) -> float:
    """How far (px) an edge goes on from its place ``k`` to the border, before an ``other`` place that lies outside."""
    if other < 0 or other >= len(travelled) or not inside_px[other] < 0.0:
        return 0.0
    return abs(travelled[other] - travelled[k]) * inside_px[k] / (inside_px[k] - inside_px[other])


@compiled
def _fraction(travelled: Any, at_px: float) -> float:
    """Where (0 to 1) an edge has ``travelled`` so far, its places being evenly spaced."""
    last, k = len(travelled) - 1, 0
    if at_px >= travelled[last]:
        return 1.0
    while travelled[k + 1] <= at_px:
        k += 1
    return (k + (at_px - travelled[k]) / (travelled[k + 1] - travelled[k])) / last


@compiled
def levers(start: Any, end: Any, fraction: Any, translation: Any) -> tuple[Any, Any]:
    """Samples (n, 3) at the ``fraction`` of the way from ``start`` to ``end`` (n, 3), which are given from the
    gripper's origin; and the same from the camera's.
    """
    lever, points_cam_m = np.empty(start.shape), np.empty(start.shape)
    for n in range(len(start)):
        for i in range(3):
            lever[n, i] = start[n, i] + fraction[n] * (end[n, i] - start[n, i])
            points_cam_m[n, i] = lever[n, i] + translation[i]
    return lever, points_cam_m


@compiled
def across_edges(
    d_uv: Any, start: Any, end: Any, lever: Any, edge: Any, rate: Any, jaw_unknown: bool
) -> tuple[Any, Any, Any]:
    """Normals (n, 2) of edges that go from ``start`` to ``end`` (n, 3), gradients (n, 3) of the motion along them by a
    point's, and Jacobian (n, 6 or 7); ``rate`` (e, 3): motion of the edges by the opening.

    With the derivative D (2, 3) of a pixel by its point, ``d_uv`` (n, 2, 3), the tangent is D times the edge's span,
    the normal n is across it, to the right, and the gradient g = n' D; a motion (rho, omega) of a point with the
    ``lever`` l moves the edge by g rho + (l x g) omega, and the opening by g rate (equations (3), (15)).
    """
    count = len(edge)
    normal, gradient, jacobian = np.empty((count, 2)), np.empty((count, 3)), np.empty((count, 7 if jaw_unknown else 6))
    for n in range(count):
        tangent_u, tangent_v = 0.0, 0.0
        for i in range(3):
            span = end[n, i] - start[n, i]
            tangent_u += d_uv[n, 0, i] * span
            tangent_v += d_uv[n, 1, i] * span
        length = math.sqrt(tangent_u * tangent_u + tangent_v * tangent_v)
        normal[n, 0], normal[n, 1] = -tangent_v / length, tangent_u / length
        for i in range(3):
            gradient[n, i] = normal[n, 0] * d_uv[n, 0, i] + normal[n, 1] * d_uv[n, 1, i]
            jacobian[n, i] = gradient[n, i]
        x, y, z = lever[n, 0], lever[n, 1], lever[n, 2]
        jacobian[n, 3] = y * gradient[n, 2] - z * gradient[n, 1]
        jacobian[n, 4] = z * gradient[n, 0] - x * gradient[n, 2]
        jacobian[n, 5] = x * gradient[n, 1] - y * gradient[n, 0]
        if jaw_unknown:
            own = rate[edge[n]]
            jacobian[n, 6] = gradient[n, 0] * own[0] + gradient[n, 1] * own[1] + gradient[n, 2] * own[2]
    return normal, gradient, jacobian


@compiled
def maps(uv_px: Any, normal: Any, offsets_px: Any, rows_px: Any) -> tuple[Any, Any]:
    """Columns and rows of the image (r, n, s) where r rows of each search line are read: ``offsets_px`` (s,) along the
    normal and ``rows_px`` (r,) along the edge from ``uv_px`` (n, 2), in single precision as it is kept.
    """
    map_x = np.empty((len(rows_px), len(uv_px), len(offsets_px)), np.float32)
    map_y = np.empty(map_x.shape, np.float32)
    for r in range(len(rows_px)):
        for n in range(len(uv_px)):
            u, v = np.float32(uv_px[n, 0]), np.float32(uv_px[n, 1])
            x, y = np.float32(normal[n, 0]), np.float32(normal[n, 1])
            for k in range(len(offsets_px)):
                map_x[r, n, k] = (u + x * offsets_px[k]) + rows_px[r] * y
                map_y[r, n, k] = (v + y * offsets_px[k]) - rows_px[r] * x
    return map_x, map_y


@compiled
def ideal_lines(
    points_cam_m: Any, edge: Any, edges: Any, first: Any, edge_count: int
) -> tuple[Any, Any, Any, Any, Any]:
    """The edges as straight lines in ideal coordinates: samples ``xy`` and the line's direction there (n, 2), the place
    ``along`` (n,) it; origins and directions (e, 2) of the lines.

    Lines of edges that are not sampled are NaN; a curved edge's is that from its first sample to its last.
    """
    count = len(edge)
    xy, way_xy, along = np.empty((count, 2)), np.empty((count, 2)), np.empty(count)
    origin, direction = np.full((edge_count, 2), np.nan), np.full((edge_count, 2), np.nan)
    for n in range(count):
        for i in range(2):
            xy[n, i] = points_cam_m[n, i] / points_cam_m[n, 2]
    for v in range(len(edges)):
        a, b, e = first[v], (first[v + 1] if v + 1 < len(first) else count) - 1, edges[v]
        square = 0.0
        for i in range(2):
            origin[e, i], direction[e, i] = 0.5 * (xy[a, i] + xy[b, i]), xy[b, i] - xy[a, i]
            square += direction[e, i] * direction[e, i]
        for i in range(2):
            direction[e, i] /= math.sqrt(square)
    for n in range(count):
        e = edge[n]
        way_xy[n, 0], way_xy[n, 1] = direction[e, 0], direction[e, 1]
        along[n] = (xy[n, 0] - origin[e, 0]) * direction[e, 0] + (xy[n, 1] - origin[e, 1]) * direction[e, 1]
    return xy, way_xy, along, origin, direction


@compiled
def gains(points_cam_m: Any, normal: Any, d_uv: Any, way_xy: Any) -> Any:
    """(n,) by how much an offset of a pixel along the image normal moves a point off its edge in ideal coordinates.

    ``d_uv`` (n, 2, 3) holds the lens: its first two columns times z are the derivative of pixels by ideal coordinates,
    the inverse of which takes the normal there; what of that is across ``way_xy`` (n, 2) counts.
    """
    gain = np.empty(len(normal))
    for n in range(len(normal)):
        z = points_cam_m[n, 2]
        a, b, c, d = d_uv[n, 0, 0] * z, d_uv[n, 0, 1] * z, d_uv[n, 1, 0] * z, d_uv[n, 1, 1] * z
        determinant = a * d - b * c
        step_x = (d * normal[n, 0] - b * normal[n, 1]) / determinant
        step_y = (a * normal[n, 1] - c * normal[n, 0]) / determinant
        gain[n] = step_y * way_xy[n, 0] - step_x * way_xy[n, 1]
    return gain
