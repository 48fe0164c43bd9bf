"""From chains of edge points to straight pieces: long ones where an edge is straight, short ones where it is curved.

The pieces of a whole chain are chosen at once by dynamic programming (Bellman 1961).  The cost is the sum of squares
about the pieces, in units of the points' scatter, plus a price per piece: Schwarz's criterion for its unknowns.  Each
piece is then measured again on stations of its own, without its ends, and adjacent pieces meet in vertices.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
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
from gripmon.track.edges.prediction import STRETCH

SHORTEST_PIECE_PX = 6.0
"""Shortest piece: what remains of 8 px without half the width of a search line (1 px of 3) at both ends."""
LEAST_SCATTER_PX = 0.05
"""Least scatter of an edge point: no image gives it better, whatever the points themselves show."""
CORNER_SAG_PX = 0.6
"""Largest sag, length * turn / 8, of two pieces that approximate a curve; beyond it they form a corner.  Pieces miss
their curve by STRAIGHT_PX, or up to four times that where the points scatter."""
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
LONGEST_CUT_PX = 24.0
"""Largest length of a piece that may be only the smoothed contour cutting a corner off; its two neighbours decide."""
CORNER_BLUR_PX = 2.0
"""Distance from a corner within which the blur of its two edges mixes."""
_GAP_PX = 12.0
_OUTLIER_PX = 1.0
_MOST_POINTS = 1500


@dataclass(frozen=True)
class Chain:
    """Consecutive vertices ``uv_px`` (v, 2) in the image, ``closed`` or from end to end.  ``folds_px`` (f, v, 2): the
    same with one tenth of the images left out; ``corner`` (v,): whether two pieces meet at an angle; ``rms_px``
    (pieces,) scatter about each piece, ``sigma_px`` (v,) of a vertex.  Going along the chain the gripper is on the left
    in the image.
    """

    uv_px: Array
    folds_px: Array
    closed: bool
    corner: NDArray[np.bool_]
    rms_px: Array

    @property
    def pieces(self) -> list[tuple[int, int]]:
        """Vertex indices of the two ends of each piece."""
        n = len(self.uv_px)
        return [(k, (k + 1) % n) for k in range(n if self.closed else n - 1)]

    @property
    def sigma_px(self) -> Array:
        """Standard deviation (v,) of a vertex along its larger axis, from the scatter over the images (delete-a-group
        jackknife).
        """
        return jackknife_sigma(self.folds_px).max(axis=1)


def jackknife_sigma(folds: Array) -> Array:
    """Standard deviation from results (f, ...), each with one f-th of the images left out."""
    count = len(folds)
    return np.asarray(np.sqrt((count - 1) / count * np.square(folds - folds.mean(axis=0)).sum(axis=0)))


def runs(usable: NDArray[np.bool_], uv_px: Array) -> list[tuple[NDArray[np.intp], bool]]:
    """Chains of a closed contour's usable points, as consecutive indices, split where more than 12 px are missing; and
    whether each is closed.
    """
    at = np.flatnonzero(usable)
    if len(at) < 2 * SHORTEST_PIECE_PX:
        return []
    apart = np.linalg.norm(uv_px[np.roll(at, -1)] - uv_px[at], axis=1) > _GAP_PX
    steps = np.diff(np.append(at, at[0] + len(usable)))
    breaks = np.flatnonzero(apart | (steps > _GAP_PX))
    if not len(breaks):
        return [(at, True)]
    rolled = np.roll(at, -(breaks[0] + 1))
    ends = np.append((breaks[1:] - breaks[0]), len(at))
    out, first = [], 0
    for end in ends.tolist():
        if end - first >= 2 * SHORTEST_PIECE_PX:
            out.append((rolled[first:end], False))
        first = end
    return out


def without_outliers(offset_px: Array, chain: NDArray[np.intp]) -> NDArray[np.intp]:
    """A chain's points without those far from the median of their neighbours."""
    values = offset_px[chain]
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(values, 5, mode="edge"), 11)
    return chain[np.abs(values - np.median(windows, axis=1)) < _OUTLIER_PX]


def split(points: Array) -> list[int]:
    """Indices at which the pieces of a chain (n, 2) begin and end."""
    stride = max(1, math.ceil(len(points) / _MOST_POINTS))
    p = points[::stride]
    n = len(p)
    least = max(3, round(SHORTEST_PIECE_PX / stride))
    if n < 2 * least:
        return [0, len(points) - 1]
    scatter = max(_scatter(p), LEAST_SCATTER_PX)
    # Errors of neighbouring points are correlated: about one in four of a stretch's points is independent.
    price = 3.0 * math.log(n) * STRETCH / 4.0
    sums = np.vstack([np.zeros(5), np.cumsum(_moments(p - p.mean(axis=0)), axis=0)])
    best, before = np.full(n + 1, np.inf), np.zeros(n + 1, dtype=int)
    best[0] = 0.0
    for end in range(least, n + 1):
        starts = np.arange(0, end - least + 1)
        total = best[starts] + _misfit(sums, starts, end) / scatter**2 + price
        before[end] = int(total.argmin())
        best[end] = float(total.min())
    cuts, at = [n], n
    while at > 0:
        at = int(before[at])
        cuts.append(at)
    out = [min(c * stride, len(points) - 1) for c in reversed(cuts)]
    return sorted(set(out))


def _moments(p: Array) -> Array:
    x, y = p.T
    return np.column_stack([x, y, x * x, x * y, y * y])


def _misfit(sums: Array, starts: NDArray[np.intp], end: int) -> Array:
    """Sum of squares of the points from each start to the end about their best line."""
    count = end - starts
    x, y, xx, xy, yy = (sums[end] - sums[starts]).T
    a, b, c = xx - x * x / count, xy - x * y / count, yy - y * y / count
    return np.maximum(0.5 * (a + c) - np.sqrt(0.25 * (a - c) ** 2 + b**2), 0.0)


def _scatter(p: Array) -> float:
    """Scatter of points about a smooth curve, from second differences across the chain."""
    second = p[:-2] - 2.0 * p[1:-1] + p[2:]
    along = p[2:] - p[:-2]
    along /= np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
    across = second[:, 1] * along[:, 0] - second[:, 0] * along[:, 1]
    return float(1.4826 * np.median(np.abs(across)) / math.sqrt(6.0))


@dataclass(frozen=True)
class _Line:
    """Unit normal and distance, ideal pixels, from all images, and (f,) from the folds; ``rms_px`` of its points;
    ``ends`` (2, 2), between which it is seen, as far as the next piece's blur.
    """

    normal: Array
    distance: float
    fold_normals: Array
    fold_distances: Array
    rms_px: float
    ends: Array


def fit_chains(
    camera: Camera,
    images: NDArray[np.float32],
    noise: float,
    behind: Background,
    points: Array,
    outward: Array,
    closed: bool,
    blur_px: float,
) -> list[Chain]:
    """Pieces and vertices of a chain of edge points (n, 2) in the image; ``outward`` (n, 2): the normals away from the
    gripper.  Several chains where pieces between them can't be measured, none where no piece of at least 8 px is left.
    """
    if closed:
        points, outward = _from_a_corner(points, outward)
    ideal = to_ideal_px(camera, points)
    cuts = split(ideal)

    def measure(first: int, last: int) -> _Line | None:
        part = slice(first, last + 1)
        return _measured(camera, images, noise, behind, _line_through(ideal[part]), outward[part], blur_px)

    spans = list(itertools.pairwise(cuts))
    measured = [(span, measure(*span)) for span in spans]
    found = [(span, line) for span, line in measured if line is not None]
    k = 0
    while k + 1 < len(found):
        first, last = found[k][0][0], found[k + 1][0][1]
        both = measure(first, last)
        if both is not None and _is_one(both, [found[k], found[k + 1]], ideal):
            found[k : k + 2] = [((first, last), both)]
            k = max(k - 1, 0)
        else:
            k += 1

    def joined(before: _Found, after: _Found) -> bool:
        (_, one), (_, other) = before, after
        ends = one.ends[1], other.ends[0]
        if float(np.linalg.norm(ends[1] - ends[0])) <= _GAP_PX and _is_smooth(before, after, ideal):
            return True
        # What lies between is a corner that the smoothed contour cut off, if both edges go on until they meet.
        distances = np.array([[one.distance], [other.distance]])
        meet = _meet(one.normal[None], distances[0], other.normal[None], distances[1])[0]
        return all(
            float(np.linalg.norm(meet - end)) < LONGEST_CUT_PX
            and _goes_on(camera, images, noise, end, meet, outward[[(first + last) // 2]], blur_px, WORST_RMS_PX)
            for end, ((first, last), _) in zip(ends, (before, after), strict=True)
        )

    out = []
    for part, whole in _connected(found, joined, closed):
        part = _without_rounding(camera, images, noise, ideal, outward, blur_px, part, whole)
        if not whole or len(part) >= 3:
            out.append(_joined(camera, ideal, [line for _, line in part], [span for span, _ in part], whole))
    return out


_Found = tuple[tuple[int, int], _Line]


def _connected(
    found: list[_Found], joined: Callable[[_Found, _Found], bool], closed: bool
) -> list[tuple[list[_Found], bool]]:
    """Pieces in groups, each of which is ``joined`` to the next; and whether each group is closed."""
    if not found:
        return []
    count = len(found)
    apart = [not joined(found[k], found[(k + 1) % count]) for k in range(count if closed else count - 1)]
    if not any(apart):
        return [(found, closed)]
    first = apart.index(True) + 1 if closed else 0
    groups: list[list[_Found]] = [[]]
    for k in range(count):
        at = (first + k) % count
        groups[-1].append(found[at])
        if k + 1 < count and apart[at]:
            groups.append([])
    return [(group, False) for group in groups]


def _without_rounding(
    camera: Camera,
    images: NDArray[np.float32],
    noise: float,
    ideal: Array,
    outward: Array,
    blur_px: float,
    found: list[_Found],
    closed: bool,
) -> list[_Found]:
    """Remove short pieces that only cut a sharp corner off, as the smoothed contour below the points does: their two
    neighbours continue straight until they meet.
    """  # fmt: skip
    out = list(found)
    k = 0 if closed else 1
    while k < len(out) - (0 if closed else 1) and len(out) > 2:
        (first, last), _ = out[k]
        before, after = out[k - 1], out[(k + 1) % len(out)]
        meet = _meet(*(np.atleast_1d(v) for line in (before[1], after[1]) for v in (line.normal[None], line.distance)))[
            0
        ]
        near = float(np.linalg.norm(meet - 0.5 * (ideal[first] + ideal[last]))) < LONGEST_CUT_PX
        short = float(np.linalg.norm(ideal[last] - ideal[first])) < LONGEST_CUT_PX
        if near and short and all(
            _goes_on(camera, images, noise, end, meet, outward[first : last + 1], blur_px)
            for end in (before[1].ends[1], after[1].ends[0])
        ):  # fmt: skip
            del out[k]
        else:
            k += 1
    return out


def _goes_on(
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


def _is_one(both: _Line, parts: list[tuple[tuple[int, int], _Line]], ideal: Array) -> bool:
    """Whether one line explains two pieces, within a tolerance plus twice their ends' scatter, at most doubled."""
    for span, line in parts:
        for k in span:
            end = _foot(line.normal[None], np.array([line.distance]), ideal[k])[0]
            folds = line.fold_normals @ end - line.fold_distances
            sigma_px = float(jackknife_sigma(folds[:, None])[0])
            if abs(float(end @ both.normal - both.distance)) > STRAIGHT_PX + min(2.0 * sigma_px, STRAIGHT_PX):
                return False
    return True


def _from_a_corner(points: Array, outward: Array) -> tuple[Array, Array]:
    """Start a closed chain where it turns most, so that no piece is cut in two."""
    ahead, behind = np.roll(points, -8, axis=0) - points, points - np.roll(points, 8, axis=0)
    turn = np.abs(ahead[:, 0] * behind[:, 1] - ahead[:, 1] * behind[:, 0])
    k = int(turn.argmax())
    return np.roll(points, -k, axis=0), np.roll(outward, -k, axis=0)


def _line_through(p: Array) -> tuple[Array, Array]:
    """Two ends of the best line through points."""
    centre = p.mean(axis=0)
    way = np.linalg.svd(p - centre)[2][0]
    way *= np.sign(way @ (p[-1] - p[0])) or 1.0
    along = (p - centre) @ way
    return centre + along.min() * way, centre + along.max() * way


def _measured(
    camera: Camera,
    images: NDArray[np.float32],
    noise: float,
    behind: Background,
    ends: tuple[Array, Array],
    outward: Array,
    blur_px: float,
) -> _Line | None:
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
    return _Line(line[0], line[1], normals, distances, rms_px, _shown(at, inlier, ends))


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


def _joined(camera: Camera, ideal: Array, lines: list[_Line], spans: list[tuple[int, int]], closed: bool) -> Chain:
    """The chain with vertices where adjacent pieces meet, and at the ends."""
    count = len(lines)
    normals = np.stack([np.vstack([line.normal[None], line.fold_normals]) for line in lines])  # (pieces, 1 + f, 2)
    distances = np.stack([np.append(line.distance, line.fold_distances) for line in lines])
    vertices, corner = [], []
    if not closed:
        vertices.append(_foot(normals[0], distances[0], lines[0].ends[0]))
        corner.append(False)
    for k in range(count if closed else count - 1):
        a, b = k, (k + 1) % count
        gap = lines[b].ends[0] - lines[a].ends[1]
        joint = lines[a].ends[1] + 0.5 * gap
        met = _meet(normals[a], distances[a], normals[b], distances[b])
        if not _is_smooth((spans[a], lines[a]), (spans[b], lines[b]), ideal):
            vertices.append(met)
            corner.append(True)
            continue
        # Pieces of a curve meet between what is seen of them, on both lines; or, as the intersection of nearly parallel
        # lines is uncertain, halfway.
        feet = [_foot(normals[i], distances[i], joint) for i in (a, b)]
        share = float(np.clip((met[0] - lines[a].ends[1]) @ gap / max(float(gap @ gap), 1e-9), 0.0, 1.0))
        near = np.linalg.norm(met[0] - lines[a].ends[1] - share * gap) < 2.0
        vertices.append(met if near else 0.5 * (feet[0] + feet[1]))
        corner.append(False)
    if not closed:
        vertices.append(_foot(normals[-1], distances[-1], lines[-1].ends[1]))
        corner.append(False)
    if closed:
        vertices, corner = vertices[-1:] + vertices[:-1], corner[-1:] + corner[:-1]
    stacked = np.stack(vertices, axis=1)  # (1 + f, v, 2)
    uv = from_ideal_px(camera, stacked.reshape(-1, 2)).reshape(stacked.shape)
    rms = np.array([line.rms_px for line in lines])
    return Chain(uv[0], uv[1:], closed, np.array(corner), rms)


def _is_smooth(before: _Found, after: _Found, ideal: Array) -> bool:
    """Whether two pieces approximate a curve, instead of meeting in a corner."""
    shorter_px = min(float(np.linalg.norm(ideal[last] - ideal[first])) for (first, last), _ in (before, after))
    return shorter_px * _turn(before[1].normal, after[1].normal) / 8.0 <= CORNER_SAG_PX


def _turn(a: Array, b: Array) -> float:
    """Angle between two lines from their normals, 0 to 90 degrees."""
    return math.asin(min(abs(float(a[0] * b[1] - a[1] * b[0])), 1.0))


def _foot(normals: Array, distances: Array, point: Array) -> Array:
    """Feet (1 + f, 2) of a point on lines."""
    return np.asarray(point - ((normals @ point) - distances)[:, None] * normals)


def _meet(na: Array, da: Array, nb: Array, db: Array) -> Array:
    """Intersections of lines (1 + f); far away if they are parallel."""
    det = na[:, 0] * nb[:, 1] - na[:, 1] * nb[:, 0]
    det = np.where(np.abs(det) < 1e-9, 1e-9, det)
    x = (da * nb[:, 1] - db * na[:, 1]) / det
    y = (na[:, 0] * db - nb[:, 0] * da) / det
    return np.column_stack([x, y])
