"""A straight piece of an outline as the images show it: measured on search lines of its own, with its scatter over the
images; and where two such lines meet.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.records import Array
from gripmon.teach.beyond import Background, is_outermost
from gripmon.teach.silhouette import (
    Stations,
    from_ideal_px,
    lines_in_image,
    measure_transitions,
    to_ideal_px,
)

SHORTEST_PIECE_PX = 6.0
"""Shortest piece: what remains of 8 px without half the width of a search line (1 px of 3) at both ends."""
LEAST_SCATTER_PX = 0.05
"""Least scatter of an edge point: no image gives it better, whatever the points themselves show."""
END_MARGIN_PX = 2.5
"""Margin at both ends of a piece: the blur of the next piece reaches this far (3 sigma of 0.8 px)."""
STRAIGHT_PX = 0.2
"""Largest distance of a line from its edge, besides its own scatter: the accuracy wanted of an outline."""
WORST_RMS_PX = 0.5
"""Largest scatter about a piece: at least twice what a curve leaves about its pieces."""
WORST_SIGMA_PX = 1.0
"""Standard deviation of a piece's ends, from the scatter over the images, from which it is left out: search lines at
work reach 3 px to either side."""
LEAST_USABLE = 0.6
"""Least part of a piece's stations that are measured: what lies between others is bridged, not the most of it."""
CORNER_BLUR_PX = 2.0
"""Distance from a corner within which the blur of its two edges mixes."""


def jackknife_sigma(folds: Array) -> Array:
    """Standard deviation from results (f, ...), each with one f-th of the images left out."""
    count = len(folds)
    return np.asarray(np.sqrt((count - 1) / count * np.square(folds - folds.mean(axis=0)).sum(axis=0)))


@dataclass(frozen=True)
class PieceLine:
    """Unit normal and distance, ideal pixels, from all images, and (f,) from the folds; ``rms_px`` of its points;
    ``ends`` (2, 2), between which it is seen, as far as the next piece's blur.
    """

    normal: Array
    distance: float
    fold_normals: Array
    fold_distances: Array
    rms_px: float
    ends: Array


def line_through(p: Array) -> tuple[Array, Array]:
    """Two ends of the best line through points."""
    centre = p.mean(axis=0)
    way = np.linalg.svd(p - centre)[2][0]
    way *= np.sign(way @ (p[-1] - p[0])) or 1.0
    along = (p - centre) @ way
    return centre + along.min() * way, centre + along.max() * way


def measured_line(
    camera: Camera,
    images: NDArray[np.float32],
    noise: float,
    behind: Background,
    ends: tuple[Array, Array],
    outward: Array,
    blur_px: float,
) -> PieceLine | None:
    """Measure a piece on stations of its own."""
    for _ in range(2):
        length = float(np.linalg.norm(ends[1] - ends[0]))
        stations = _stations_on(camera, *ends, outward, min(END_MARGIN_PX, 0.2 * length), images[0].shape)
        if stations is None:
            return None
        uv, normal = stations.uv_px, stations.normal
        found = measure_transitions(images, stations, noise, wide=False, blur_px=blur_px)
        usable = found.usable.copy()
        if np.count_nonzero(usable) < max(4.0, LEAST_USABLE * len(usable)):
            return None
        at = to_ideal_px(camera, uv + found.offset_px[:, None] * normal)
        line, inlier = _robust_line(at, usable)
        folds = [_weighted_line(to_ideal_px(camera, uv + f[:, None] * normal), inlier) for f in found.folds_px]
        way = np.array([-line[0][1], line[0][0]])
        way *= np.sign(way @ (ends[1] - ends[0]))
        foot = line[0] * line[1]
        ends = foot + float((ends[0] - foot) @ way) * way, foot + float((ends[1] - foot) @ way) * way
    residual = at[inlier] @ line[0] - line[1]
    if float(np.sqrt(np.square(residual).mean())) > WORST_RMS_PX:
        return None
    signs = np.array([float(np.sign(n @ line[0])) for n, _ in folds])
    normals = signs[:, None] * np.array([n for n, _ in folds])
    distances = signs * np.array([d for _, d in folds])
    at_ends = jackknife_sigma(normals @ np.transpose(ends) - distances[:, None])
    if float(at_ends.max()) > WORST_SIGMA_PX:
        return None
    stations = _stations_on(camera, *ends, outward, min(END_MARGIN_PX, 0.2 * length), images[0].shape)
    if stations is None or not is_outermost(images, stations, blur_px) or not behind.begins(stations):
        return None
    rms_px = float(np.sqrt(np.square(residual).mean()))
    return PieceLine(line[0], line[1], normals, distances, rms_px, _shown(at, inlier, ends))


def _shown(at: Array, inlier: NDArray[np.bool_], ends: tuple[Array, Array]) -> Array:
    """The part (2, 2) of a piece's line between its ``ends`` that its stations ``at`` (s, 2), a pixel apart, follow:
    from where the shortest piece of them would be measured.
    """
    size = min(int(SHORTEST_PIECE_PX), len(inlier))
    enough = np.flatnonzero(np.convolve(inlier, np.ones(size), "valid") >= LEAST_USABLE * size)
    if not len(enough):
        return np.array(ends)
    follows = np.flatnonzero(inlier)
    follows = follows[(follows >= enough[0]) & (follows < enough[-1] + size)]
    way = (ends[1] - ends[0]) / float(np.linalg.norm(ends[1] - ends[0]))
    out = np.array(ends)
    for side, k in enumerate((follows[0], follows[-1])):
        if k not in (0, len(inlier) - 1):
            out[side] = ends[0] + float((at[k] - ends[0]) @ way) * way
    return out


def _stations_on(
    camera: Camera, start: Array, end: Array, outward: Array, margin_px: float, shape: tuple[int, ...]
) -> Stations | None:
    """Stations one pixel apart between two ends, ideal pixels, leaving out a margin at both."""
    length = float(np.linalg.norm(end - start))
    count = max(int(length - 2.0 * margin_px), 4)
    share = np.linspace(margin_px / length, 1.0 - margin_px / length, count)
    uv = from_ideal_px(camera, start + share[:, None] * (end - start))
    if not np.isfinite(uv).all():
        return None
    tangent = np.gradient(uv, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    if float((normal * outward.mean(axis=0)).sum()) < 0.0:
        normal = -normal
    return Stations(uv, normal, lines_in_image(uv, normal, shape))


def _weighted_line(p: Array, chosen: NDArray[np.bool_]) -> tuple[Array, float]:
    centre = p[chosen].mean(axis=0)
    way = np.linalg.svd(p[chosen] - centre, full_matrices=False)[2][0]
    normal = np.array([-way[1], way[0]])
    return normal, float(normal @ centre)


def _robust_line(p: Array, usable: NDArray[np.bool_]) -> tuple[tuple[Array, float], NDArray[np.bool_]]:
    chosen = usable.copy()
    for _ in range(5):
        line = _weighted_line(p, chosen)
        off = np.abs(p @ line[0] - line[1])
        limit = max(3.0 * 1.4826 * float(np.median(off[usable])), 3.0 * LEAST_SCATTER_PX)
        again = usable & (off < limit)
        if np.count_nonzero(again) < 4 or (again == chosen).all():
            break
        chosen = again
    return line, chosen


def goes_on(
    camera: Camera,
    images: NDArray[np.float32],
    noise: float,
    start: Array,
    meet: Array,
    outward: Array,
    blur_px: float,
    within_px: float = STRAIGHT_PX + LEAST_SCATTER_PX,
) -> bool:
    """Whether an edge follows its line from its end to a corner, ideal pixels."""
    length = float(np.linalg.norm(meet - start))
    if length < 2.0 * CORNER_BLUR_PX:
        return True
    end = start + (1.0 - CORNER_BLUR_PX / length) * (meet - start)
    stations = _stations_on(camera, start, end, outward, 0.0, images[0].shape)
    if stations is None:
        return False
    found = measure_transitions(images, stations, noise, wide=False, blur_px=blur_px)
    off = np.abs(found.offset_px[found.usable])
    return len(off) >= max(1.0, LEAST_USABLE * len(found.usable)) and float(np.quantile(off, 0.9)) < within_px


def foot_on(normals: Array, distances: Array, point: Array) -> Array:
    """Feet (1 + f, 2) of a point on lines."""
    return np.asarray(point - ((normals @ point) - distances)[:, None] * normals)


def where_met(na: Array, da: Array, nb: Array, db: Array) -> Array:
    """Intersections of lines (1 + f); far away if they are parallel."""
    det = na[:, 0] * nb[:, 1] - na[:, 1] * nb[:, 0]
    det = np.where(np.abs(det) < 1e-9, 1e-9, det)
    x = (da * nb[:, 1] - db * na[:, 1]) / det
    y = (na[:, 0] * db - nb[:, 0] * da) / det
    return np.column_stack([x, y])
