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
from scipy.ndimage import median_filter

from gripmon.model.camera import Camera
from gripmon.model.records import Array
from gripmon.teach.beyond import WITHIN_PX, Background
from gripmon.teach.piece_lines import (
    LEAST_SCATTER_PX,
    SHORTEST_PIECE_PX,
    STRAIGHT_PX,
    WORST_RMS_PX,
    PieceLine,
    foot_on,
    goes_on,
    jackknife_sigma,
    line_through,
    measured_line,
    where_met,
)
from gripmon.teach.silhouette import from_ideal_px, to_ideal_px
from gripmon.track.edges.prediction import STRETCH

CORNER_SAG_PX = 0.6
"""Largest sag, length * turn / 8, of two pieces that approximate a curve; beyond it they form a corner.  Pieces miss
their curve by STRAIGHT_PX, or up to four times that where the points scatter."""
LONGEST_CUT_PX = 24.0
"""Largest length of a piece that may be only the smoothed contour cutting a corner off; its two neighbours decide."""
_GAP_PX = 12.0
_OUTLIER_PX = 1.0
_MOST_POINTS = 1500


@dataclass(frozen=True)
class Chain:
    """Consecutive vertices ``uv_px`` (v, 2) in the image, ``closed`` or from end to end.  ``folds_px`` (f, v, 2): the
    same with one tenth of the images left out; ``corner`` (v,): whether two pieces meet at an angle; ``rms_px`` (m,)
    scatter about each measured piece, which steps from one to the next aren't; ``sigma_px`` (v,) of a vertex.  Going
    along the chain the gripper is on the left in the image.
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
    return chain[np.abs(values - median_filter(values, 11, mode="nearest")) < _OUTLIER_PX]


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

    def measure(first: int, last: int) -> PieceLine | None:
        part = slice(first, last + 1)
        return measured_line(camera, images, noise, behind, line_through(ideal[part]), outward[part], blur_px)

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
        near = float(np.linalg.norm(ends[1] - ends[0])) <= _GAP_PX
        # A step between them as long as a piece would be one.
        if near and _is_smooth(before, after, ideal) and _apart_px(one, other) < SHORTEST_PIECE_PX:
            return True
        # What lies between is a corner that the smoothed contour cut off, if both edges go on until they meet.
        distances = np.array([[one.distance], [other.distance]])
        meet = where_met(one.normal[None], distances[0], other.normal[None], distances[1])[0]
        return all(
            float(np.linalg.norm(meet - end)) < LONGEST_CUT_PX
            and goes_on(camera, images, noise, end, meet, outward[[(first + last) // 2]], blur_px, WORST_RMS_PX)
            for end, ((first, last), _) in zip(ends, (before, after), strict=True)
        )

    out = []
    for part, whole in _connected(found, joined, closed):
        part = _without_rounding(camera, images, noise, ideal, outward, blur_px, part, whole)
        if not whole or len(part) >= 3:
            out.append(_joined(camera, ideal, [line for _, line in part], [span for span, _ in part], whole))
    return out


_Found = tuple[tuple[int, int], PieceLine]


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
        lines = [np.atleast_1d(v) for line in (before[1], after[1]) for v in (line.normal[None], line.distance)]
        meet = where_met(*lines)[0]
        near = float(np.linalg.norm(meet - 0.5 * (ideal[first] + ideal[last]))) < LONGEST_CUT_PX
        short = float(np.linalg.norm(ideal[last] - ideal[first])) < LONGEST_CUT_PX
        if near and short and all(
            goes_on(camera, images, noise, end, meet, outward[first : last + 1], blur_px)
            for end in (before[1].ends[1], after[1].ends[0])
        ):  # fmt: skip
            del out[k]
        else:
            k += 1
    return out


def _is_one(both: PieceLine, parts: list[tuple[tuple[int, int], PieceLine]], ideal: Array) -> bool:
    """Whether one line explains two pieces, within a tolerance plus twice their ends' scatter, at most doubled."""
    for span, line in parts:
        for k in span:
            end = foot_on(line.normal[None], np.array([line.distance]), ideal[k])[0]
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


def _joined(camera: Camera, ideal: Array, lines: list[PieceLine], spans: list[tuple[int, int]], closed: bool) -> Chain:
    """The chain with vertices where adjacent pieces meet, and at the ends."""
    count = len(lines)
    normals = np.stack([np.vstack([line.normal[None], line.fold_normals]) for line in lines])  # (pieces, 1 + f, 2)
    distances = np.stack([np.append(line.distance, line.fold_distances) for line in lines])
    vertices, corner = [], []
    if not closed:
        vertices.append(foot_on(normals[0], distances[0], lines[0].ends[0]))
        corner.append(False)
    for k in range(count if closed else count - 1):
        a, b = k, (k + 1) % count
        gap = lines[b].ends[0] - lines[a].ends[1]
        joint = lines[a].ends[1] + 0.5 * gap
        met = where_met(normals[a], distances[a], normals[b], distances[b])
        if not _is_smooth((spans[a], lines[a]), (spans[b], lines[b]), ideal):
            vertices.append(met)
            corner.append(True)
            continue
        # Pieces of a curve meet between what is seen of them, on both lines; or, as the intersection of nearly parallel
        # lines is uncertain, halfway.
        feet = [foot_on(normals[i], distances[i], joint) for i in (a, b)]
        share = float(np.clip((met[0] - lines[a].ends[1]) @ gap / max(float(gap @ gap), 1e-9), 0.0, 1.0))
        near = np.linalg.norm(met[0] - lines[a].ends[1] - share * gap) < 2.0
        # Where they pass each other at a step that is farther beside both than an outline may be: each goes on to it.
        step = not near and 0.5 * float(np.linalg.norm(feet[1][0] - feet[0][0])) > WITHIN_PX
        vertices += [met] if near else feet if step else [0.5 * (feet[0] + feet[1])]
        corner += [False] * (1 + step)
    if not closed:
        vertices.append(foot_on(normals[-1], distances[-1], lines[-1].ends[1]))
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


def _apart_px(one: PieceLine, other: PieceLine) -> float:
    """How far apart the lines of two adjacent pieces are halfway between their ends."""
    joint = 0.5 * (one.ends[1] + other.ends[0])
    feet = [foot_on(line.normal[None], np.array([line.distance]), joint)[0] for line in (one, other)]
    return float(np.linalg.norm(feet[1] - feet[0]))


def _turn(a: Array, b: Array) -> float:
    """Angle between two lines from their normals, 0 to 90 degrees."""
    return math.asin(min(abs(float(a[0] * b[1] - a[1] * b[0])), 1.0))
