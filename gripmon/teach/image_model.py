"""From what images show of fingers to a gripper file: points, edges, corners, and how the fingers move."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.errors import NoResultError
from gripmon.model.gripper import FingerModel, GripperModel, JawModel
from gripmon.model.provenance import Provenance
from gripmon.model.records import Array
from gripmon.teach.curved_edges import smooth_curve
from gripmon.teach.finger_depth import PlacedOutlines, leaves_smoothly, nearest_on_ray
from gripmon.teach.image_motion import FingerMoved
from gripmon.teach.image_outline import FingerSeen, OpeningSeen
from gripmon.teach.inner_edges import InnerEdge
from gripmon.teach.piece_lines import jackknife_sigma
from gripmon.teach.shape import Shape, model_of
from gripmon.teach.vanishing import PARALLEL_RAD, Outline
from gripmon.track.edges.roles import PARALLEL_COSINE

SHORTEST_EDGE_PX = 4.0
"""Shortest edge of a file: what may remain of a piece of 6 px between the lines of its neighbours.  Too short to be
measured, it still joins them, so that they are seen to end there."""
MEETS_PX = 2.0
"""Largest distance, besides its own scatter, by which the line of an inner edge may miss the outline's corner that it
runs to: with a bevel of 0.25 mm, 100 mm away, it misses it by as much."""
LARGEST_GAP = 0.5
"""Largest gap between such an edge and its corner, over its length: there its line is less than twice as uncertain as
at its end."""
LONG_SIDE = 0.5
"""Least length of a finger's side over its longest side; shorter pieces belong to the curve at its end."""
LONGEST_SHARE = 0.25
"""Largest part of a straight side that is fitted with the curve that continues it."""


@dataclass(frozen=True)
class MeasuredGripper:
    """What images show of a gripper.  ``depth_m`` of the TCP and ``scale_sigma``, of the gripper file; ``moved``: by
    opening, each finger's motion; ``jaw_range_m``: that of the jaws, if it is known.
    """

    camera: Camera
    opening: OpeningSeen
    outlines: Sequence[Outline]
    placed: PlacedOutlines
    moved: Mapping[float, Sequence[FingerMoved]]
    depth_m: float
    scale_sigma: float
    opening_m: float | None
    jaw_range_m: tuple[float, float] | None = None


def finger_outlines(camera: Camera, seen: OpeningSeen) -> list[Outline]:
    """One outline per finger, all its chains combined."""
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
        raise NoResultError(f"a static part has no edge of {SHORTEST_EDGE_PX:g} px; fingertips in view and in focus")
    return out


def tip_width(placed: PlacedOutlines) -> float:
    """Width of a fingertip across the jaws at unit depth: mean over the fingers."""
    widths = [float(np.ptp(across)) for across in _tips_across(placed)]
    if not min(widths) > 0.0:
        raise NoResultError("no fingertip's width is seen; --distance M, or --reference FILE")
    return float(np.mean(widths))


def as_gaps(
    placed: PlacedOutlines, moved: Mapping[float, Sequence[FingerMoved]], depth_m: float
) -> tuple[float, dict[float, Sequence[FingerMoved]]]:
    """The gap between the fingertips (m) at the first opening, and the motions by the gaps at the other openings."""
    first, *_, last = _tips_across(placed)
    gap = float(last.min() - first.max())
    by_gap = {}
    for fingers in moved.values():
        more = float((fingers[-1].shift - fingers[0].shift) @ placed.rotation[:, 0])
        by_gap[round(max(gap + more, 0.0) * depth_m, 6)] = fingers
    return round(gap * depth_m, 6), by_gap


def _tips_across(placed: PlacedOutlines) -> list[Array]:
    """Positions of the vertices of each finger's tip across the jaws, at unit depth."""
    out = []
    for points in placed.points:
        local = (points[np.isfinite(points).all(axis=1)] - placed.tcp) @ placed.rotation
        # The tip is what lies within a tenth of the finger's length of its end.
        out.append(local[local[:, 2] > local[:, 2].max() - 0.1 * float(np.ptp(local[:, 2])), 0])
    return out


def build_model(seen: MeasuredGripper, name: str, provenance: Provenance | None, notes: list[str]) -> GripperModel:
    """The gripper file.  Raises :class:`NoResultError`; adds to ``notes`` what was left out."""
    parts = list(zip(seen.outlines, seen.placed.points, seen.placed.kept, seen.opening.fingers, strict=True))
    shapes = {part[0].name: _shape(seen, *part) for part in parts}
    dropped = sum(len(outline.pieces) - len(placed) for outline, _, placed, _ in parts)
    if dropped:
        notes.append(f"{dropped} outer edges behind the fingers' long edges aren't used: their depth isn't known")
    inner_dropped = sum(len(finger.inner) - sum(shapes[outline.name].crease) for outline, _, _, finger in parts)
    if inner_dropped:
        notes.append(
            f"{inner_dropped} inner edges aren't used: they don't start from a corner, so their depth isn't known"
        )
    model = model_of(name, shapes, 0.0, *_jaw(seen), provenance)
    tilt_sigma_rad = round(seen.placed.tilt_sigma_rad, 4)
    return msgspec.structs.replace(model, scale_sigma=seen.scale_sigma, tilt_sigma_rad=tilt_sigma_rad)


def _shape(
    seen: MeasuredGripper, outline: Outline, places: Array, placed: Sequence[tuple[int, int]], finger: FingerSeen
) -> Shape:
    """A finger by the ``placed`` pieces of its outline, whose vertices are at ``places`` (v, 3) at unit depth: straight
    edges, curves, and those of its inner edges whose depth is known.
    """
    long = dict(zip(outline.pieces, (outline.length_px >= SHORTEST_EDGE_PX).tolist(), strict=True))
    curves = _curves(outline, placed, places @ seen.placed.rotation)
    of_curves = {piece for curve in curves for piece in curve}
    kept = [piece for piece in placed if long[piece] and piece not in of_curves]
    places = places.copy()
    vias: list[Array] = [np.zeros((0, 3))] * len(kept)
    vias += [_curve_in_space(seen, outline, finger.mask, places, curve, kept) for curve in curves]
    edges = [*kept, *((curve[0][0], curve[-1][1]) for curve in curves)]
    piece_m = _spreads_m(seen, finger)
    spread_m = [piece_m[piece] for piece in kept]
    spread_m += [float(np.sqrt(np.mean([piece_m[piece] ** 2 for piece in curve]))) for curve in curves]
    met = np.bincount(np.ravel(kept).astype(int), minlength=len(places))
    known = sorted({k for edge in edges for k in edge})
    outer = len(edges)
    brighter: dict[int, Literal["left", "right"]] = {}
    for edge in finger.inner:
        start = _starts_at(seen, outline, known, edge)
        ends = _inner_in_space(seen, outline, places, start, edge)
        if ends is None:
            continue
        own = [len(places), len(places) + 1]
        if start is not None:
            own[start[1]] = start[0]
        places = np.vstack([places, ends])
        brighter[len(edges)] = "right" if edge.step > 0.0 else "left"
        edges.append((own[0], own[1]))
    inner = len(edges) - outer
    return Shape(
        points_m=_in_gripper(seen, places),
        corners={k for k in known if outline.corner[k] and met[k] >= 2},
        edges=edges,
        crease=[False] * outer + [True] * inner,
        spread_m=spread_m + [0.0] * inner,
        via_m=[_in_gripper(seen, via) for via in vias] + [np.zeros((0, 3))] * inner,
        brighter=brighter,
    )


def _in_gripper(seen: MeasuredGripper, places: Array) -> Array:
    """Points (n, 3) at unit depth in the gripper's frame, m."""
    return np.asarray(((places - seen.placed.tcp) @ seen.placed.rotation) * seen.depth_m)


def _spreads_m(seen: MeasuredGripper, finger: FingerSeen) -> dict[tuple[int, int], float]:
    """Standard deviation of each piece of a finger's outline across itself, from the scatter over the images (m)."""
    out: dict[tuple[int, int], float] = {}
    first = 0
    for chain in finger.chains:
        for a, b in chain.pieces:
            u, v = chain.uv_px[b] - chain.uv_px[a]
            across_px = chain.folds_px[:, [a, b]] @ (np.array([-v, u]) / math.hypot(u, v))
            sigma_px = float(np.sqrt(np.square(jackknife_sigma(across_px)).mean()))
            out[first + a, first + b] = sigma_px / seen.camera.fx_px * seen.depth_m
        first += len(chain.uv_px)
    return out


def _curves(outline: Outline, placed: Sequence[tuple[int, int]], local: Array) -> list[list[tuple[int, int]]]:
    """Runs of consecutive pieces without a corner between them, as on a round fingertip, without the fingers' long
    sides: these are straight and edges of their own, so that the end of the finger is seen.
    """
    way = np.array([local[b] - local[a] for a, b in placed]).reshape(-1, 3)
    length = np.linalg.norm(way, axis=1)
    along = np.abs(way[:, 2]) > PARALLEL_COSINE * length
    side = along & (length >= LONG_SIDE * length[along].max(initial=0.0))
    runs: list[list[tuple[int, int]]] = [[]]
    for piece, straight in zip(placed, side.tolist(), strict=True):
        if runs[-1] and (straight or runs[-1][-1][1] != piece[0] or outline.corner[piece[0]]):
            runs.append([])
        if not straight:
            runs[-1].append(piece)
    if (
        len(runs) > 1
        and runs[-1]
        and runs[0]
        and runs[-1][-1][1] == runs[0][0][0]
        and not outline.corner[runs[0][0][0]]
    ):
        runs[0] = runs.pop() + runs[0]  # a closed outline may begin within a run
    return [run for run in runs if len(run) > 1]


def _curve_in_space(
    seen: MeasuredGripper,
    outline: Outline,
    mask: NDArray[np.bool_],
    places: Array,
    curve: Sequence[tuple[int, int]],
    straight: Sequence[tuple[int, int]],
) -> Array:
    """Points (n, 3) on a curve between its ends, at unit depth.  Where the curve continues a straight edge smoothly, it
    begins on the edge, at the point where it leaves it: its end in ``places`` (v, 3) is moved there.
    """
    vertices = [curve[0][0], *(b for _, b in curve)]
    of_curve = places[vertices]
    tangent = [False, False]
    for side, (end, piece) in enumerate(((vertices[0], curve[0]), (vertices[-1], curve[-1]))):
        behind = [a + b - end for a, b in straight if end in (a, b)]
        if len(behind) != 1 or not leaves_smoothly(outline, set(vertices), end, behind[0]):
            continue
        tangent[side] = True
        length = float(np.linalg.norm(outline.xy[behind[0]] - outline.xy[end]))
        share = min(float(np.linalg.norm(np.subtract(*outline.xy[list(piece)]))) / length, LONGEST_SHARE)
        far, near = places[behind[0]], places[end]
        in_space = share * near[2] / ((1.0 - share) * far[2] + share * near[2])
        on_side = near + in_space * (far - near)
        of_curve = np.vstack([on_side, of_curve] if side == 0 else [of_curve, on_side])
    uv_px = seen.camera.project(of_curve)
    curve_px, along = smooth_curve(seen.camera, seen.opening, mask, uv_px, (tangent[0], tangent[1]))
    rays = np.column_stack([seen.camera.undistort(curve_px), np.ones(len(curve_px))])
    # In a plane the inverse depth is linear over the image.
    points = rays / np.interp(along, np.arange(len(of_curve)), 1.0 / of_curve[:, 2])[:, None]
    for side, end in enumerate((vertices[0], vertices[-1])):
        if tangent[side]:
            places[end] = points[-side]
    return np.asarray(points[1:-1])


def _starts_at(
    seen: MeasuredGripper, outline: Outline, known: Sequence[int], edge: InnerEdge
) -> tuple[int, int] | None:
    """The vertex among ``known`` that an inner edge runs to, and the edge's end next to it; None if there is none."""
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
    seen: MeasuredGripper, outline: Outline, places: Array, start: tuple[int, int] | None, edge: InnerEdge
) -> Array | None:
    """Both ends (2, 3) at unit depth; None where the depth can't be determined."""
    xy = seen.camera.undistort(edge.uv_px)
    rays = np.column_stack([xy, np.ones(2)])
    plane = seen.placed.normal
    if plane is not None:
        return np.asarray(rays * (float(plane @ seen.placed.tcp) / (rays @ plane))[:, None])
    if start is None:
        return None
    direction = seen.placed.rotation[:, 2]
    way = xy[1] - xy[0]
    along = direction[:2] - direction[2] * xy.mean(axis=0)
    if abs(float(way @ along)) < math.cos(2.0 * PARALLEL_RAD) * float(np.linalg.norm(way) * np.linalg.norm(along)):
        return None
    return np.array([nearest_on_ray(ray, places[start[0]], direction) for ray in rays])


def _jaw(seen: MeasuredGripper) -> tuple[dict[str, FingerModel], JawModel | None]:
    """Motion of the fingers as a table over the openings seen, and the range of the jaws."""
    names = [outline.name for outline in seen.outlines]
    if seen.opening_m is None or not seen.moved:
        return {name: FingerModel() for name in names}, None
    openings = sorted([seen.opening_m, *seen.moved])
    low, high = openings[0], openings[-1]
    # Beyond what the images show the motion is less certain, but possible: as far again, unless the range is known.
    least, most = seen.jaw_range_m or (max(2.0 * low - high, 0.0), 2.0 * high - low)
    jaw = JawModel(nominal_m=seen.opening_m, min_m=min(least, low), max_m=max(most, high))
    fingers = {}
    for number, name in enumerate(names):
        rows = []
        for opening in openings:
            moved = seen.moved.get(opening)
            shift = np.zeros(3) if moved is None else moved[number].shift @ seen.placed.rotation * seen.depth_m
            rows.append([opening, *(round(float(v), 7) for v in shift)])
        fingers[name] = FingerModel(motion={"table": rows})
    return fingers, jaw
