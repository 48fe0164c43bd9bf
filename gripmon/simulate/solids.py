"""Convex solids: fingers from the gripper's faces, bevelled edges, boxes; their occlusion order, and what they hide."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.model.gripper import Gripper
from gripmon.model.records import Array
from gripmon.simulate.scenario import FingerShape

_TOUCH_M = 1e-5  # bodies that touch within this don't hide each other's surface
_AS_MODELLED = FingerShape()


@dataclass(frozen=True)
class Solid:
    """A convex solid in its body's frame: vertices (v, 3), faces as loops counter-clockwise seen from outside.

    ``bevel``: which faces are bevels; ``normals`` (f, 3) point outwards; ``n·x <= offsets`` (f,) inside.
    """

    name: str
    vertices_m: Array
    loops: tuple[NDArray[np.intp], ...]
    bevel: tuple[bool, ...]
    normals: Array
    offsets_m: Array


def make_solid(name: str, polygons: list[Array], bevel: list[bool]) -> Solid:
    """From face polygons (k, 3) each, counter-clockwise seen from outside."""
    vertices = np.concatenate(polygons)
    ends = np.cumsum([len(p) for p in polygons])
    loops = tuple(np.arange(end - len(p), end) for p, end in zip(polygons, ends.tolist(), strict=True))
    normals = np.array([polygon_normal(p) for p in polygons])
    offsets = np.array([float((p @ n).mean()) for p, n in zip(polygons, normals, strict=True)])
    return Solid(name, vertices, loops, tuple(bevel), normals, offsets)


def polygon_normal(polygon: Array) -> Array:
    """Unit normal (3,) of a planar loop (Newell): outwards if it runs counter-clockwise seen from outside."""
    total = np.cross(polygon, np.roll(polygon, -1, axis=0)).sum(axis=0)
    return total / np.linalg.norm(total)


def box(name: str, low_m: Array, high_m: Array) -> Solid:
    """An axis-parallel box between two corners (3,)."""
    corners = np.array([[(high_m if k >> axis & 1 else low_m)[axis] for axis in range(3)] for k in range(8)])
    loops = ((0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6))
    return make_solid(name, [corners[list(loop)] for loop in loops], [False] * 6)


def finger_solids(gripper: Gripper, shape: FingerShape = _AS_MODELLED) -> tuple[Solid, ...]:
    """One solid per finger at nominal opening, with its bevels cut and worn by ``shape``.

    Raises ValueError for a gripper without closed faces.
    """
    points = gripper.points_grip_m(None)
    solids = []
    for finger, name in enumerate(gripper.finger_ids):
        loops = [f.points for f in gripper.faces if f.finger == finger]
        if len(loops) < 4:
            raise ValueError(f"faces: finger '{name}' has {len(loops)}; the simulator needs all faces of each finger")
        solid = make_solid(name, [points[loop] for loop in loops], [False] * len(loops))
        _check_closed(solid, loops, name)
        polygons, marks = [points[loop] for loop in loops], [False] * len(loops)
        bevel_m = _bevel_widths_m(gripper, shape)
        for edge in np.flatnonzero((gripper.edge_finger == finger) & (bevel_m > 0.0)):
            ends = set(gripper.edge_points[edge].tolist())
            sides = [k for k, loop in enumerate(loops) if ends <= set(loop.tolist())]
            if len(sides) == 2:
                on_edge = points[gripper.edge_points[edge, 0]]
                plane = _bevel_plane(solid, sides, on_edge, float(bevel_m[edge]))
                polygons, marks = _cut(polygons, marks, *plane)
        if shape.wear_m > 0.0 and shape.worn_finger in ("", name):
            tip_m = max(float(polygon[:, 2].max()) for polygon in polygons)
            polygons, marks = _cut(polygons, marks, np.array([0.0, 0.0, 1.0]), tip_m - shape.wear_m)
        solids.append(make_solid(name, polygons, marks))
    return tuple(solids)


def _bevel_widths_m(gripper: Gripper, shape: FingerShape) -> Array:
    """Bevel width of every edge: the model's, or the shape's on the edges between two corners of a tip."""
    corner = np.isin(gripper.edge_points, gripper.corner_points).all(axis=1)
    return np.where(corner, np.maximum(gripper.edge_bevel_m, shape.tip_bevel_m), gripper.edge_bevel_m)


def mirrored(solid: Solid) -> Solid:
    """The mirror image of a solid at z = 0, in its body's frame."""
    vertices = solid.vertices_m * (1.0, 1.0, -1.0)
    return make_solid(f"{solid.name} mirrored", [vertices[loop[::-1]] for loop in solid.loops], list(solid.bevel))


def _check_closed(solid: Solid, loops: list[NDArray[np.intp]], name: str) -> None:
    """Check that every edge belongs to two faces, and that no vertex lies outside any face."""
    sides: dict[tuple[int, int], int] = {}
    for loop in loops:
        for a, b in zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True):
            sides[(a, b)] = sides.get((a, b), 0) + 1
    if any(count != 1 or (b, a) not in sides for (a, b), count in sides.items()):
        raise ValueError(f"faces: finger '{name}' is not closed; each edge in two faces, once in each direction")
    outside = solid.vertices_m @ solid.normals.T - solid.offsets_m
    if outside.max() > 1e-4:
        raise ValueError(f"faces: finger '{name}' is not convex by {outside.max():.2g} m; a convex solid, flat faces")


def _bevel_plane(solid: Solid, sides: list[int], point_m: Array, width_m: float) -> tuple[Array, float]:
    """Plane ``n·x = d`` that replaces an edge by a facet of a given width, equally inclined to both faces."""
    a, b = solid.normals[sides[0]], solid.normals[sides[1]]
    normal = a + b
    length = float(np.linalg.norm(normal))
    normal /= length
    # The facet's half width over its depth below the edge is the tangent of half the inner angle = cot(half the angle
    # between the normals).
    cosine = 0.5 * length
    depth = 0.5 * width_m * np.sqrt(1.0 - cosine**2) / cosine
    return normal, float(normal @ point_m) - depth


def _cut(polygons: list[Array], marks: list[bool], normal: Array, offset: float) -> tuple[list[Array], list[bool]]:
    """Cut a convex solid with a plane, keep ``n·x <= d``, and close it with a new face marked as bevel."""
    kept: list[Array] = []
    kept_marks: list[bool] = []
    rim: list[Array] = []
    for polygon, mark in zip(polygons, marks, strict=True):
        height = polygon @ normal - offset
        corners: list[Array] = []
        for k in range(len(polygon)):
            j = (k + 1) % len(polygon)
            if height[k] <= 0.0:
                corners.append(polygon[k])
            if (height[k] < 0.0 < height[j]) or (height[j] < 0.0 < height[k]):
                share = height[k] / (height[k] - height[j])
                crossing = polygon[k] + share * (polygon[j] - polygon[k])
                corners.append(crossing)
                rim.append(crossing)
        if len(corners) >= 3:
            kept.append(np.array(corners))
            kept_marks.append(mark)
    points = np.array(rim)
    centre = points.mean(axis=0)
    u = points[0] - centre
    u /= np.linalg.norm(u)
    angle = np.arctan2((points - centre) @ np.cross(normal, u), (points - centre) @ u)
    ordered = points[np.argsort(angle)]
    # Each rim point came from two faces: drop duplicates.
    distinct = np.linalg.norm(ordered - np.roll(ordered, 1, axis=0), axis=1) > 1e-9
    return [*kept, ordered[distinct]], [*kept_marks, True]


@dataclass(frozen=True)
class PlacedSolid:
    """A solid as the camera sees it: vertices (v, 3) and face planes in the camera frame."""

    solid: Solid
    cam_T_body: Array
    vertices_cam_m: Array
    normals_cam: Array
    offsets_m: Array
    facing: NDArray[np.bool_]


def place(solid: Solid, cam_T_body: Array) -> PlacedSolid:
    """Transform a solid to the camera frame, whose origin is the camera: a face is turned towards it if d < 0."""
    rotation, translation = cam_T_body[:3, :3], cam_T_body[:3, 3]
    normals = solid.normals @ rotation.T
    offsets = solid.offsets_m + normals @ translation
    return PlacedSolid(solid, cam_T_body, solid.vertices_m @ rotation.T + translation, normals, offsets, offsets < 0.0)


def paint_order(placed: list[PlacedSolid]) -> list[PlacedSolid]:
    """From back to front.  Two convex bodies are ordered by a face plane between them, otherwise by their distance."""
    order: list[PlacedSolid] = []
    rest = list(placed)
    while rest:
        for candidate in rest:
            if not any(_hides(candidate, other) for other in rest if other is not candidate):
                break
        else:  # a cycle: farthest first
            candidate = max(rest, key=_distance)
        rest.remove(candidate)
        order.append(candidate)
    return order


def _distance(body: PlacedSolid) -> float:
    return float(np.linalg.norm(body.vertices_cam_m.mean(axis=0)))


def _hides(a: PlacedSolid, b: PlacedSolid) -> bool:
    """Whether a may hide b: a lies on the camera's side of a plane between them."""
    beyond_a = (b.vertices_cam_m @ a.normals_cam.T - a.offsets_m).min(axis=0) >= -_TOUCH_M
    beyond_b = (a.vertices_cam_m @ b.normals_cam.T - b.offsets_m).min(axis=0) >= -_TOUCH_M
    # The camera is inside the half space of a face that is turned away from it.
    if (beyond_a & a.facing).any() or (beyond_b & ~b.facing).any():
        return False
    if (beyond_a & ~a.facing).any() or (beyond_b & b.facing).any():
        return True
    return _hides_across_edges(a, b)


def _hides_across_edges(a: PlacedSolid, b: PlacedSolid) -> bool:
    """Like ``_hides`` if no face separates the two: then only a plane along one edge of each can."""
    normals = np.cross(_edge_directions(a)[:, None], _edge_directions(b)[None]).reshape(-1, 3)
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals[lengths > 1e-9] / lengths[lengths > 1e-9, None]
    of_a, of_b = a.vertices_cam_m @ normals.T, b.vertices_cam_m @ normals.T
    gap_up, gap_down = of_b.min(axis=0) - of_a.max(axis=0), of_a.min(axis=0) - of_b.max(axis=0)
    best = int(np.maximum(gap_up, gap_down).argmax())
    if max(gap_up[best], gap_down[best]) < -_TOUCH_M:
        return _distance(a) < _distance(b)  # the bodies intersect
    if gap_up[best] >= gap_down[best]:  # a below, b above: the camera at height 0
        return bool(of_a[:, best].max() + of_b[:, best].min() > 0.0)
    return bool(of_a[:, best].min() + of_b[:, best].max() < 0.0)


def _edge_directions(body: PlacedSolid) -> Array:
    """Directions (e, 3) of all sides of all faces, camera frame."""
    vertices = body.vertices_cam_m
    return np.concatenate([np.roll(vertices[loop], -1, axis=0) - vertices[loop] for loop in body.solid.loops])


def hidden_by(body: PlacedSolid, points_cam_m: Array) -> NDArray[np.bool_]:
    """(n,) whether the body lies between the camera and the points (n, 3); touching is not hiding."""
    length = np.linalg.norm(points_cam_m, axis=1)
    # Along s * point, s from 0 to just before the point, inside the half space n·x s <= d.
    rate = points_cam_m @ body.normals_cam.T
    depth = body.offsets_m - _TOUCH_M
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = depth / rate
    enter = np.where(rate < 0.0, crossing, -np.inf).max(axis=1)
    leave = np.where(rate > 0.0, crossing, np.inf).min(axis=1)
    outside = ((rate == 0.0) & (depth < 0.0)).any(axis=1)
    first = np.maximum(enter, 0.0)
    last = np.minimum(leave, 1.0 - _TOUCH_M / length)
    return ~outside & (first < last)
