"""What images show of fingers, as a gripper file: points, edges, corners, and how the fingers move."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gripmon.model.camera import Camera
from gripmon.model.errors import NoResultError
from gripmon.model.gripper import EdgeModel, FingerModel, GripperModel, JawModel, PointModel
from gripmon.model.gripper.core import on_a_line
from gripmon.model.provenance import Provenance
from gripmon.model.records import Array
from gripmon.teach.finger_depth import PARALLEL_RAD, Outline, Placed, nearest_on_ray
from gripmon.teach.image_motion import FingerMoved
from gripmon.teach.image_outline import OpeningSeen
from gripmon.teach.inner_edges import InnerEdge

SHORTEST_EDGE_PX = 8.0
MEETS_PX = 2.0
"""By which the line of an inner edge may miss the corner of the outline that it runs to, beside its own scatter: on a
bevel of 0.25 mm, 100 mm away, it lies so far beside it."""
LARGEST_GAP = 0.5
"""Between such an edge and its corner, over its length: its line is then known there as well as along itself."""
_FEWEST_CORNERS = 3


@dataclass(frozen=True)
class Seen:
    """``depth_m`` of the TCP; ``moved`` by opening: each finger's motion."""

    camera: Camera
    opening: OpeningSeen
    outlines: Sequence[Outline]
    placed: Placed
    moved: Mapping[float, Sequence[FingerMoved]]
    depth_m: float
    opening_m: float | None


def finger_outlines(camera: Camera, seen: OpeningSeen) -> list[Outline]:
    """One for each finger, all its chains in one."""
    count = len(seen.fingers)
    names = {1: ["finger"], 2: ["left", "right"]}.get(count, [f"finger{k + 1}" for k in range(count)])
    out = []
    for name, finger in zip(names, seen.fingers, strict=True):
        xy, corner, pieces, first = [], [], [], 0
        for chain in finger.chains:
            xy.append(camera.undistort(chain.uv_px))
            corner.append(chain.corner)
            pieces += [(first + a, first + b) for a, b in chain.pieces]
            first += len(chain.uv_px)
        points = np.vstack(xy)
        lengths = camera.fx_px * np.linalg.norm(points[[b for _, b in pieces]] - points[[a for a, _ in pieces]], axis=1)
        inner = np.reshape([camera.undistort(edge.uv_px) for edge in finger.inner], (-1, 2, 2))
        inner_px = camera.fx_px * np.linalg.norm(inner[:, 1] - inner[:, 0], axis=1)
        out.append(
            Outline(name, points, np.concatenate(corner), tuple(pieces), finger.outwards, lengths, inner, inner_px)
        )
    if any(not (outline.length_px >= SHORTEST_EDGE_PX).any() for outline in out):
        raise NoResultError("a part of what stays has no edge of 8 px; fingertips in view and in focus")
    return out


def tip_width(placed: Placed) -> float:
    """Of a fingertip across the jaws at unit depth: mean over the fingers."""
    widths = []
    for points in placed.points:
        local = (points[np.isfinite(points).all(axis=1)] - placed.tcp) @ placed.rotation
        # What lies within a tenth of the finger's length of its tip.
        tip = local[local[:, 2] > local[:, 2].max() - 0.1 * float(np.ptp(local[:, 2]))]
        widths.append(float(np.ptp(tip[:, 0])))
    if not min(widths) > 0.0:
        raise NoResultError("no fingertip's width is seen; --distance M, or --reference FILE")
    return float(np.mean(widths))


def build_model(seen: Seen, name: str, provenance: Provenance | None, notes: list[str]) -> GripperModel:
    """The gripper file.  Raises :class:`NoResultError`; ``notes`` grow by what was left out."""
    points: dict[str, PointModel] = {}
    edges: dict[str, EdgeModel] = {}
    dropped = inner_dropped = 0
    parts = zip(seen.outlines, seen.placed.points, seen.placed.kept, seen.opening.fingers, strict=True)
    for outline, places, placed, finger in parts:
        dropped += len(outline.pieces) - len(placed)
        long = dict(zip(outline.pieces, (outline.length_px >= SHORTEST_EDGE_PX).tolist(), strict=True))
        kept = [piece for piece in placed if long[piece]]
        local = ((places - seen.placed.tcp) @ seen.placed.rotation) * seen.depth_m
        met = np.bincount(np.ravel(kept).astype(int), minlength=len(local)) if kept else np.zeros(len(local), int)
        known = sorted({k for piece in kept for k in piece})
        for k in known:
            x, y, z = (round(float(v), 7) for v in local[k])
            corner = bool(outline.corner[k] and met[k] >= 2)
            points[f"{outline.name}_{k}"] = PointModel(finger=outline.name, xyz_m=(x, y, z), corner=corner)
        for a, b in kept:
            edges[f"{outline.name}_{a}_{b}"] = EdgeModel(start=f"{outline.name}_{a}", end=f"{outline.name}_{b}")
        for number, edge in enumerate(finger.inner):
            start = _starts_at(seen, outline, known, edge)
            ends = _inner_in_space(seen, outline, places, start, edge)
            if ends is None:
                inner_dropped += 1
                continue
            _add_inner(seen, outline.name, number, ends, start, edge, points, edges)
    if dropped:
        notes.append(f"{dropped} outer edges behind the fingers' long edges aren't used: their depth isn't known")
    if inner_dropped:
        notes.append(
            f"{inner_dropped} inner edges aren't used: they don't start from a corner, so their depth isn't known"
        )
    points = _with_corners(points, edges, notes)
    fingers, jaw = _jaw(seen)
    return GripperModel(name=name, fingers=fingers, points=points, edges=edges, jaw=jaw, provenance=provenance)


def _starts_at(seen: Seen, outline: Outline, known: Sequence[int], edge: InnerEdge) -> tuple[int, int] | None:
    """The vertex among ``known`` that an inner edge runs to, and the edge's end that is next to it; None for none."""
    uv = seen.camera.distort(outline.xy[list(known)])
    way = edge.uv_px[1] - edge.uv_px[0]
    length = float(np.linalg.norm(way))
    off = uv - edge.uv_px[0]
    across = np.abs(off[:, 0] * way[1] - off[:, 1] * way[0]) / length
    along = off @ way / length
    beyond = np.maximum(-along, along - length)
    fits = (across < MEETS_PX + 3.0 * edge.sigma_px) & (beyond > -MEETS_PX) & (beyond < LARGEST_GAP * length)
    if not fits.any():
        return None
    best = int(np.where(fits, beyond, np.inf).argmin())
    return known[best], int(along[best] > 0.5 * length)


def _inner_in_space(
    seen: Seen, outline: Outline, places: Array, start: tuple[int, int] | None, edge: InnerEdge
) -> Array | None:
    """Both ends (2, 3) at unit depth; None where nothing tells how deep it lies."""
    xy = seen.camera.undistort(edge.uv_px)
    rays = np.column_stack([xy, np.ones(2)])
    if seen.placed.flat:
        plane = seen.placed.tcp / np.linalg.norm(seen.placed.tcp)
        return np.asarray(rays * (float(plane @ seen.placed.tcp) / (rays @ plane))[:, None])
    if start is None:
        return None
    direction = seen.placed.rotation[:, 2]
    way = xy[1] - xy[0]
    along = direction[:2] - direction[2] * xy.mean(axis=0)
    if abs(float(way @ along)) < math.cos(2.0 * PARALLEL_RAD) * float(np.linalg.norm(way) * np.linalg.norm(along)):
        return None
    return np.array([nearest_on_ray(ray, places[start[0]], direction) for ray in rays])


def _add_inner(
    seen: Seen,
    finger: str,
    number: int,
    ends: Array,
    start: tuple[int, int] | None,
    edge: InnerEdge,
    points: dict[str, PointModel],
    edges: dict[str, EdgeModel],
) -> None:
    local = ((ends - seen.placed.tcp) @ seen.placed.rotation) * seen.depth_m
    names = [f"{finger}_inner_{number}_{side}" for side in ("a", "b")]
    for end, place in enumerate(local):
        if start is not None and start[1] == end:
            names[end] = f"{finger}_{start[0]}"
            continue
        x, y, z = (round(float(v), 7) for v in place)
        points[names[end]] = PointModel(finger=finger, xyz_m=(x, y, z))
    edges[f"{finger}_inner_{number}"] = EdgeModel(
        start=names[0], end=names[1], kind="crease", brighter="right" if edge.step > 0.0 else "left"
    )


def _with_corners(
    points: dict[str, PointModel], edges: Mapping[str, EdgeModel], notes: list[str]
) -> dict[str, PointModel]:
    """At least three corners that aren't on a line: where there are fewer, the vertices in which the outline turns
    most count as such.
    """

    def enough(table: Mapping[str, PointModel]) -> bool:
        corners = np.array([p.xyz_m for p in table.values() if p.corner])
        return len(corners) >= _FEWEST_CORNERS and not on_a_line(corners)

    turns: dict[str, list[Array]] = {}
    for edge in edges.values():
        way = np.subtract(points[edge.end].xyz_m, points[edge.start].xyz_m)
        turns.setdefault(edge.start, []).append(way / np.linalg.norm(way))
        turns.setdefault(edge.end, []).append(-way / np.linalg.norm(way))
    by_turn = sorted((float(w[0] @ w[1]), k) for k, w in turns.items() if len(w) == 2 and not points[k].corner)
    table, more = dict(points), 0
    while not enough(table) and by_turn:
        _, key = by_turn.pop()
        old = table[key]
        table[key] = PointModel(finger=old.finger, xyz_m=old.xyz_m, corner=True)
        more += 1
    if not enough(table):
        raise NoResultError(
            "the outline has fewer than three corners that aren't on a line; more of the fingertips in view"
        )
    if more:
        notes.append(f"{more} of the corners are places where a curve turns most: less exact along it than across")
    return table


def _jaw(seen: Seen) -> tuple[dict[str, FingerModel], JawModel | None]:
    """How the fingers move: a line between two openings, a table with more."""
    names = [outline.name for outline in seen.outlines]
    if seen.opening_m is None or not seen.moved:
        return {name: FingerModel() for name in names}, None
    openings = sorted([seen.opening_m, *seen.moved])
    jaw = JawModel(nominal_m=seen.opening_m, min_m=openings[0], max_m=openings[-1])
    fingers = {}
    for number, name in enumerate(names):
        rows = []
        for opening in openings:
            moved = seen.moved.get(opening)
            shift = np.zeros(3) if moved is None else moved[number].shift @ seen.placed.rotation * seen.depth_m
            rows.append([opening, *(round(float(v), 7) for v in shift)])
        fingers[name] = FingerModel(motion={"table": rows})
    return fingers, jaw
