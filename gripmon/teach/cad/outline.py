"""The edges and curves of a finger of any shape in one view: outlines and creases, cut where something hides them.

Such edges are valid near this view.  A sharp edge stays in place; the outline of a round part moves over it as the view
changes, which the ``round`` of its points describes.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from gripmon.model.gripper.model import MOST_VIA
from gripmon.model.gripper.rounds import LARGEST_RADIUS_M
from gripmon.model.records import Array
from gripmon.teach.cad.curves import Curve, curves_of, pieces_of
from gripmon.teach.cad.depth import DepthMap, Pinhole
from gripmon.teach.cad.solid import REAR_M
from gripmon.teach.cad.surface import Surface
from gripmon.teach.shape import Shape

STEP_PX = 0.5
"""Distance of the points at which a curve is sampled."""

STRAIGHT_PX = 0.03
"""Largest distance of a straight part from its chord, which is at least :data:`LONG_PX` long: a circle of 2400 px
radius deviates by as much."""

LONG_PX = 24.0

VIA_PX = 6.0
"""Distance of the points through which a curve passes: a cubic spline then differs from a circle of 16 px radius by
0.001 px."""

SHADED_PX = 0.1
"""Standard deviation of the observed outline of a round part, since its shade changes towards it.  In pictures of tips
of 2 to 8 mm, rendered with a lamp from the side, outlines were 0.05 to 0.17 px off."""

SHORTEST_PX = 8.0
"""Shortest edge that the monitor samples.  A shorter one is kept only where it joins two others: a bridge."""

SHORTEST_M = 1e-4  # of a gripper file's edges

TURN_RAD = 0.524
"""Turn (30 degrees) within a few pixels above which a curve has a corner there."""

LARGEST_GAP_PX = 8.0
"""Largest gap over which two straight edges are extended to a corner: the monitor doesn't sample so close to one."""

_AROUND_PX = 3.0
_TOGETHER_PX = 0.75
_LONGEST_GAP_PX = 2.0


@dataclass(frozen=True, slots=True)
class _Run:
    """A visible stretch of a curve, every :data:`STEP_PX`: ``points_m`` (n, 3), ``centre_m`` (n, 3), ``px`` (n, 2)."""

    points_m: Array
    centre_m: Array
    px: Array
    crease: bool


@dataclass(frozen=True, slots=True)
class _Edge:
    """A straight edge, or a curve through ``via_m`` (n, 3): its ends in space and in the image (2, 3 and 2), the
    centres of the roundings there (2, 3), and ``spread_m``, the standard deviation of the observed edge from it.  A
    ``bridge`` is too short to be measured; it only shows which edges are connected.
    """

    points_m: Array
    centre_m: Array
    px: Array
    via_m: Array
    crease: bool
    spread_m: float
    bridge: bool


def outline_shape(surface: Surface, view: Pinhole, depth: DepthMap, lowest_m: float | None, mounted: bool) -> Shape:
    """The edges of a finger (gripper frame) that ``view`` shows.  ``lowest_m``: parts below this z are left out;
    ``mounted``: so are those at the rear end, where the finger is held.
    """
    rear = float(surface.points_m[:, 2].min())
    edges: list[_Edge] = []
    for curve in curves_of(pieces_of(surface, view.eye_grip_m)):
        if mounted and (curve.points_m[:, 2] <= rear + REAR_M).all():
            continue
        for run in _visible(curve, view, depth, -np.inf if lowest_m is None else lowest_m):
            edges += [edge for stretch in _stretches(run) for edge in _edges(stretch, view)]
    return _joined(edges, view)


def _visible(curve: Curve, view: Pinhole, depth: DepthMap, lowest_m: float) -> Iterator[_Run]:
    """A curve's visible stretches that are at least :data:`SHORTEST_PX` long."""
    px, _ = view.project(curve.points_m)
    if not np.isfinite(px).all():
        return
    lengths = np.linalg.norm(np.diff(px, axis=0), axis=1)
    parts = np.maximum(np.ceil(lengths / STEP_PX).astype(int), 1)
    piece = np.append(np.repeat(np.arange(len(parts)), parts), len(parts) - 1)
    first = np.cumsum(parts) - parts
    share = (np.arange(len(piece)) - first[piece]) / parts[piece]
    points, centre = (v[piece] + share[:, None] * (v[piece + 1] - v[piece]) for v in (curve.points_m, curve.centre_m))
    seen = depth.visible(points) & (points[:, 2] >= lowest_m)
    px, _ = view.project(points)
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(px, axis=0), axis=1))])
    for start, stop in _runs(seen, travelled):
        own = slice(start, stop)
        if travelled[stop - 1] - travelled[start] >= SHORTEST_PX:
            yield _Run(points[own], centre[own], px[own], curve.crease)


def _runs(seen: NDArray[np.bool_], travelled: Array) -> list[tuple[int, int]]:
    """Start and stop of the visible runs, joined over gaps of up to :data:`_LONGEST_GAP_PX`."""
    change = np.flatnonzero(np.diff(np.concatenate([[0], seen.astype(np.int8), [0]])))
    out: list[tuple[int, int]] = []
    for start, stop in change.reshape(-1, 2).tolist():
        if out and travelled[start] - travelled[out[-1][1] - 1] <= _LONGEST_GAP_PX:
            out[-1] = (out[-1][0], stop)
        else:
            out.append((start, stop))
    return out


def _stretches(run: _Run) -> Iterator[_Run]:
    """Parts of a run between its corners."""
    around = max(int(_AROUND_PX / STEP_PX), 1)
    count = len(run.px)
    at = np.arange(around, count - around)
    before, after = run.px[at] - run.px[at - around], run.px[at + around] - run.px[at]
    cosine = np.einsum("ni,ni->n", before, after) / np.maximum(
        np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1), 1e-12
    )
    turn = np.arccos(np.clip(cosine, -1.0, 1.0))
    cuts = [0]
    for k in np.argsort(-turn, kind="stable").tolist():
        if turn[k] < TURN_RAD:
            break
        if all(abs(at[k] - c) > around for c in cuts):
            cuts.append(int(at[k]))
    cuts = sorted({*cuts, count - 1})
    for start, stop in itertools.pairwise(cuts):
        own = slice(start, stop + 1)
        yield _Run(run.points_m[own], run.centre_m[own], run.px[own], run.crease)


def _edges(run: _Run, view: Pinhole) -> Iterator[_Edge]:
    """A smooth stretch as its straight parts and the curves between them."""
    m_per_px = float(np.linalg.norm(run.points_m - view.eye_grip_m, axis=1).mean()) / view.focal_px
    for first, last, straight in _parts(run.px):
        length_px = float(np.linalg.norm(np.diff(run.px[first : last + 1], axis=0), axis=1).sum())
        ends, bridge = [first, last], length_px < SHORTEST_PX
        # On what is nearly flat an outline runs away with the least turn of the view.
        if (np.linalg.norm(run.points_m[ends] - run.centre_m[ends], axis=1) > LARGEST_RADIUS_M).any():
            continue
        if bridge and np.linalg.norm(run.points_m[last] - run.points_m[first]) <= SHORTEST_M:
            continue
        count = 0 if straight or bridge else int(np.clip(length_px / VIA_PX, 1, MOST_VIA))
        via = run.points_m[np.rint(np.linspace(first, last, count + 2)[1:-1]).astype(int)]
        spread_m = SHADED_PX * m_per_px if np.isfinite(run.centre_m[ends]).all() else 0.0
        yield _Edge(run.points_m[ends], run.centre_m[ends], run.px[ends], via, run.crease, spread_m, bridge)


def _parts(px: Array) -> list[tuple[int, int, bool]]:
    """Start, end, and whether it is straight, of each part of a smooth curve (n, 2), by Ramer, Douglas and Peucker."""
    kept, stack = {0, len(px) - 1}, [(0, len(px) - 1)]
    while stack:
        first, last = stack.pop()
        off = _beside_px(px, first, last)
        middle = first + int(off.argmax())
        if off.max() > STRAIGHT_PX and first < middle < last:
            kept.add(middle)
            stack += [(first, middle), (middle, last)]
    out: list[tuple[int, int, bool]] = []
    whole = len(kept) == 2
    for first, last in itertools.pairwise(sorted(kept)):
        straight = whole or float(np.linalg.norm(px[last] - px[first])) >= LONG_PX
        if out and not straight and not out[-1][2]:
            out[-1] = (out[-1][0], last, False)
        else:
            out.append((first, last, straight))
    return out


def _beside_px(px: Array, first: int, last: int) -> Array:
    """Distances of a curve's points from one of its chords; from its end if the chord has no length."""
    way, beside = px[last] - px[first], px[first : last + 1] - px[first]
    length = float(np.linalg.norm(way))
    if length < 1e-9:
        return np.linalg.norm(beside, axis=1)
    return np.abs(beside[:, 0] * way[1] - beside[:, 1] * way[0]) / length


def _joined(edges: list[_Edge], view: Pinhole) -> Shape:
    """The finger's shape, with the ends of edges merged where they meet."""
    if not edges:
        return Shape(np.zeros((0, 3)), set(), [], [])
    ends = np.concatenate([edge.points_m for edge in edges])
    centres = np.concatenate([edge.centre_m for edge in edges])
    px = np.concatenate([edge.px for edge in edges])
    m_per_px = float(np.linalg.norm(ends - view.eye_grip_m, axis=1).min()) / view.focal_px
    close = cKDTree(ends).query_pairs(_TOGETHER_PX * m_per_px, output_type="ndarray").reshape(-1, 2)
    graph = coo_matrix((np.ones(len(close), np.int8), close.T), shape=(len(ends),) * 2)
    count, label = connected_components(graph, directed=False)
    bridging = np.repeat([edge.bridge for edge in edges], 2)
    straight = np.repeat([not len(edge.via_m) for edge in edges], 2)
    count, label = _met(ends, px, label, straight, bridging, STEP_PX * m_per_px)
    sharp = ~np.isfinite(centres).all(axis=1)
    points: Array = np.zeros((count, 3))
    rounds: dict[int, tuple[Array, Array]] = {}
    for k in range(count):
        own = np.flatnonzero(label == k)
        own = own[~bridging[own]] if not bridging[own].all() else own
        # The end of a sharp edge is exact, the end of an outline near it isn't.
        exact = own[sharp[own]] if sharp[own].any() else own
        points[k] = ends[exact].mean(axis=0)
        # Where an outline meets a sharp edge it slides along it: the round part ends in this edge.
        wanders = own[~sharp[own]]
        if len(wanders):
            way = ends[wanders ^ 1] - ends[wanders]
            way *= np.where(way @ way[0] < 0.0, -1.0, 1.0)[:, None]
            axis = way.sum(axis=0) / np.linalg.norm(way.sum(axis=0))
            rounds[k] = (centres[wanders].mean(axis=0), axis)
    curved_on = [k for k in np.flatnonzero(~straight & sharp).tolist() if int(label[k]) in rounds]
    points, label = _left_in_place(points, label, curved_on)
    found = [(int(label[2 * n]), int(label[2 * n + 1])) for n in range(len(edges))]
    once: dict[tuple[int, int], int] = {}
    for n, (a, b) in enumerate(found):
        if a != b:
            once.setdefault((min(a, b), max(a, b)), n)
    kept = _bridged(sorted(once.values()), edges, found)
    shape = Shape(points, set(), [found[n] for n in kept], [edges[n].crease for n in kept], round_m=rounds)
    shape.spread_m = [edges[n].spread_m for n in kept]
    shape.via_m = [edges[n].via_m for n in kept]
    straight_ones = [n for n in kept if not edges[n].bridge and not len(edges[n].via_m)]
    shape.corners = _corners(shape, straight_ones, label, px)
    return shape


def _left_in_place(points: Array, label: NDArray[np.intp], ends: list[int]) -> tuple[Array, NDArray[np.intp]]:
    """Give ``ends`` of curves on the body a point of their own at the same place: the outline of a round part ends
    there on such a curve and moves along it, but the curve stays.
    """
    left = sorted({int(label[end]) for end in ends})
    label = label.copy()
    for new, k in enumerate(left, start=len(points)):
        label[[end for end in ends if label[end] == k]] = new
    return np.concatenate([points, points[left]]), label


def _bridged(kept: list[int], edges: list[_Edge], found: list[tuple[int, int]]) -> list[int]:
    """The edges ``kept`` without bridges to nowhere; ``found``: the two points of each edge."""
    while True:
        meeting = Counter(itertools.chain.from_iterable(found[n] for n in kept))
        left = [n for n in kept if not edges[n].bridge or min(meeting[p] for p in found[n]) > 1]
        if len(left) == len(kept):
            return kept
        kept = left


def _met(
    ends: Array,
    px: Array,
    label: NDArray[np.intp],
    straight: NDArray[np.bool_],
    bridging: NDArray[np.bool_],
    apart_m: float,
) -> tuple[int, NDArray[np.intp]]:
    """Join loose ends of two straight edges with no more than a few pixels of a tight curve between them, if their
    lines meet to ``apart_m``: at this distance that is a corner.  Moves ``ends`` there.  Returns the number of points,
    and the point of each end (e,).
    """
    others = np.where(bridging, -1, label)
    loose = np.flatnonzero((np.bincount(label, ~bridging)[label] == 1) & straight & ~bridging)
    for a, b in cKDTree(px[loose]).query_pairs(LARGEST_GAP_PX) if len(loose) > 1 else ():
        i, j = loose[[a, b]].tolist()
        if label[i] == label[j] or i ^ 1 == j or np.count_nonzero(np.isin(others, label[[i, j]])) > 2:
            continue
        way_i, way_j = px[i] - px[i ^ 1], px[j] - px[j ^ 1]
        cross = float(way_i[0] * way_j[1] - way_i[1] * way_j[0])
        if not _turns(way_i, way_j):
            continue
        gap = px[j] - px[i]
        shares = np.array([gap[0] * way_j[1] - gap[1] * way_j[0], gap[0] * way_i[1] - gap[1] * way_i[0]]) / cross
        beyond_px = shares * [np.linalg.norm(way_i), np.linalg.norm(way_j)]
        if (np.abs(beyond_px) > LARGEST_GAP_PX).any():
            continue
        # Move along each edge, so that its line stays; edges that pass each other in depth form no corner.
        met = [ends[k] + share * (ends[k] - ends[k ^ 1]) for k, share in ((i, shares[0]), (j, shares[1]))]
        if np.linalg.norm(met[1] - met[0]) > apart_m:
            continue
        ends[i] = ends[j] = 0.5 * (met[0] + met[1])
        others[others == label[j]] = label[i]
        label[label == label[j]] = label[i]
    names, label = np.unique(label, return_inverse=True)
    return len(names), label.astype(np.intp)


def _corners(shape: Shape, kept: list[int], label: NDArray[np.intp], px: Array) -> set[int]:
    """Points in the front half where two straight edges meet at an angle."""
    away: dict[int, list[Array]] = {}
    for n in kept:
        for end in (2 * n, 2 * n + 1):
            away.setdefault(int(label[end]), []).append(px[end ^ 1] - px[end])
    z = shape.points_m[sorted({p for edge in shape.edges for p in edge}), 2]
    return {
        point
        for point, ways in away.items()
        if shape.points_m[point, 2] >= 0.5 * (z.max() + z.min())
        and any(_turns(one, other) for one, other in itertools.combinations(ways, 2))
    }


def _turns(one: Array, other: Array) -> bool:
    cross = abs(float(one[0] * other[1] - one[1] * other[0]))
    return cross >= np.sin(TURN_RAD) * float(np.linalg.norm(one) * np.linalg.norm(other))
