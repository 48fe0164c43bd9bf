"""What ``track.edges.prediction_kernel`` compiles, function by function, by NumPy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array


def largest_motion(jacobian: Array, xi: Array) -> float:
    """``Prediction.moved_px``."""
    return float(np.abs(jacobian[:, : len(xi)] @ xi).max(initial=0.0))


def sampled_ranges(
    uv_px: Array, inside_px: Array, wanted: NDArray[np.bool_], margin_px: float, shortest_px: float
) -> Array:
    """First and last fraction and length in px (e, 3) of the longest run of each edge inside the image, less the margin
    at the edge's own ends: none where the image's border cuts it.  Zeros if nothing is left, or the edge isn't
    ``wanted`` (e,).  Of edges (e, c, 2) c places, evenly spaced, which lie ``inside_px`` (e, c) inside the border.

    Of a short edge the margin leaves twice ``shortest_px``, if half of it suffices for that, or else what half of it
    leaves.
    """
    out, places = np.zeros((len(uv_px), 3)), uv_px.shape[1]
    step_px = np.linalg.norm(np.diff(uv_px, axis=1), axis=2)
    with np.errstate(invalid="ignore"):
        inside = inside_px >= 0.0
    for e in np.flatnonzero(wanted & inside.any(axis=1)).tolist():
        change = np.flatnonzero(np.diff(np.concatenate([[0], inside[e].astype(np.int8), [0]])))
        travelled = np.concatenate([[0.0], np.cumsum(np.nan_to_num(step_px[e]))])
        runs = []
        for start, stop in zip(change[::2].tolist(), (change[1::2] - 1).tolist(), strict=True):
            ends = [travelled[start], travelled[stop]]
            for i, (own, other) in enumerate(((start, start - 1), (stop, stop + 1))):
                if 0 <= other < places and inside_px[e, other] < 0.0:
                    falls = [inside_px[e, other], inside_px[e, own]]
                    ends[i] = float(np.interp(0.0, falls, [travelled[other], travelled[own]]))
            runs.append((*ends, start == 0, stop == places - 1))
        begin, end, *own_ends = runs[int(np.argmax([run[1] - run[0] for run in runs]))]
        each_px = (end - begin - 2.0 * shortest_px) / max(sum(own_ends), 1)
        off_px = min(margin_px, max(0.5 * margin_px, each_px))
        low, high = begin + off_px * own_ends[0], end - off_px * own_ends[1]
        if high - low >= shortest_px:
            fractions = np.interp([low, high], travelled, np.linspace(0.0, 1.0, places))
            out[e] = fractions[0], fractions[1], high - low
    return out


def levers(start: Array, end: Array, fraction: Array, translation: Array) -> tuple[Array, Array]:
    """Samples (n, 3) at the ``fraction`` of the way from ``start`` to ``end`` (n, 3), which are given from the
    gripper's origin; and the same from the camera's.
    """
    lever = start + fraction[:, None] * (end - start)
    return lever, lever + translation


def across_edges(
    d_uv: Array, start: Array, end: Array, lever: Array, edge: NDArray[np.intp], rate: Array, jaw_unknown: bool
) -> tuple[Array, Array, Array]:
    """Normals (n, 2) of edges that go from ``start`` to ``end`` (n, 3), gradients (n, 3) of the motion along them by a
    point's, and Jacobian (n, 6 or 7); ``rate`` (e, 3): motion of the edges by the opening.
    """
    tangent = np.einsum("nij,nj->ni", d_uv, end - start)
    tangent /= np.sqrt(np.einsum("ni,ni->n", tangent, tangent))[:, None]
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    gradient = np.einsum("ni,nij->nj", normal, d_uv)
    jacobian = np.empty((len(edge), 7 if jaw_unknown else 6))
    jacobian[:, :3] = gradient
    for i, j, k in ((3, 1, 2), (4, 2, 0), (5, 0, 1)):  # lever x gradient, without np.cross's overhead
        jacobian[:, i] = lever[:, j] * gradient[:, k] - lever[:, k] * gradient[:, j]
    if jaw_unknown:
        jacobian[:, 6] = np.einsum("ni,ni->n", gradient, rate[edge])
    return normal, gradient, jacobian


def maps(
    uv_px: Array, normal: Array, offsets_px: NDArray[np.float32], rows_px: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where ``r`` rows of each profile are read, (r, n, s) each, in single precision as it is kept."""
    uv, across, along = uv_px.astype(np.float32), normal.astype(np.float32), rows_px[:, None, None]
    map_x: NDArray[np.float32] = (uv[:, 0:1] + across[:, 0:1] * offsets_px) + along * across[:, 1:2]
    map_y: NDArray[np.float32] = (uv[:, 1:2] + across[:, 1:2] * offsets_px) - along * across[:, 0:1]
    return map_x, map_y


def ideal_lines(
    points_cam_m: Array,
    edge: NDArray[np.intp],
    edges: NDArray[np.intp],
    first: NDArray[np.intp],
    edge_count: int,
) -> tuple[Array, Array, Array, Array, Array]:
    """The edges as straight lines in ideal coordinates: samples ``xy`` and the line's direction there (n, 2), the place
    ``along`` (n,) it; origins and directions (e, 2) of the lines.

    Lines of edges that are not sampled are NaN; a curved edge's is that from its first sample to its last.
    """
    origin, direction = np.full((edge_count, 2), np.nan), np.full((edge_count, 2), np.nan)
    xy = points_cam_m[:, :2] / points_cam_m[:, 2:]
    if len(edges) == 0:
        return xy, np.zeros((0, 2)), np.zeros(0), origin, direction
    last = np.append(first[1:], len(xy)) - 1
    origin[edges] = 0.5 * (xy[first] + xy[last])
    span = xy[last] - xy[first]
    direction[edges] = span / np.sqrt(np.einsum("ei,ei->e", span, span))[:, None]
    way_xy = direction[edge]
    return xy, way_xy, np.einsum("ni,ni->n", xy - origin[edge], way_xy), origin, direction


def gains(points_cam_m: Array, normal: Array, d_uv: Array, way_xy: Array) -> Array:
    """(n,) by how much an offset of a pixel along the image normal moves a point off its edge in ideal coordinates.

    ``d_uv`` (n, 2, 3) holds the lens: its first two columns times z are the derivative of pixels by ideal
    coordinates.
    """
    lens = d_uv[:, :, :2] * points_cam_m[:, 2][:, None, None]
    determinant = lens[:, 0, 0] * lens[:, 1, 1] - lens[:, 0, 1] * lens[:, 1, 0]
    step_x = (lens[:, 1, 1] * normal[:, 0] - lens[:, 0, 1] * normal[:, 1]) / determinant
    step_y = (lens[:, 0, 0] * normal[:, 1] - lens[:, 1, 0] * normal[:, 0]) / determinant
    return np.asarray(step_y * way_xy[:, 0] - step_x * way_xy[:, 1])
