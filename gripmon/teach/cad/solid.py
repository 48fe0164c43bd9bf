"""Convex fingers with flat faces: their points, edges and faces, for all views."""

from __future__ import annotations

import numpy as np

from gripmon.model.gripper.faces import normal_of
from gripmon.teach.cad.files import mesh_library
from gripmon.teach.cad.surface import FLAT_M, Surface, surface_of
from gripmon.teach.shape import Shape

MOST_FACES = 64
"""Most faces of a finger; more are a coarsely cut rounding."""

REAR_M = 5e-4
"""Distance from a finger's rear end within which edges are left out: it is mounted there, and they aren't seen."""


def is_solid(surface: Surface) -> bool:
    """Whether a finger is a convex solid with flat faces, which a gripper file describes for all views."""
    faces = int(surface.patch.max(initial=-1)) + 1
    if not 4 <= faces <= MOST_FACES or not surface.closed or not surface.flat():
        return False
    normals = np.array([surface.normals[surface.patch == k].mean(axis=0) for k in range(faces)])
    first = np.array([surface.points_m[surface.triangles[surface.patch == k][0, 0]] for k in range(faces)])
    used = surface.points_m[np.unique(surface.triangles)]
    above = used @ normals.T - np.einsum("fi,fi->f", first, normals)
    return bool(above.max() <= 2.0 * FLAT_M)


def cut(surface: Surface, lowest_m: float) -> Surface:
    """The part of a convex solid above z = ``lowest_m``, closed there."""
    trimesh, z = mesh_library("a cut"), np.array([0.0, 0.0, 1.0])
    kept = trimesh.intersections.slice_faces_plane(surface.points_m, surface.triangles, z, lowest_m * z)[0]
    return surface_of(trimesh.convex.convex_hull(kept))


def solid_shape(surface: Surface, mounted: bool) -> Shape:
    """Points where three faces meet, edges where two do, and the faces.  ``mounted``: z points to the tip, and the
    finger is held at its other end; then only points of the front half are corners.
    """
    patches_at: dict[int, set[int]] = {}
    for triangle, patch in zip(surface.triangles.tolist(), surface.patch.tolist(), strict=True):
        for point in triangle:
            patches_at.setdefault(point, set()).add(patch)
    vertices = sorted(p for p, patches in patches_at.items() if len(patches) >= 3)
    vertices.sort(key=lambda p: -round(float(surface.points_m[p, 2]), 6))
    number = {p: k for k, p in enumerate(vertices)}
    loops = [_loop(surface, patch, number) for patch in range(int(surface.patch.max()) + 1)]
    points = surface.points_m[vertices]
    pairs = sorted({(min(a, b), max(a, b)) for loop in loops for a, b in zip(loop, [*loop[1:], loop[0]], strict=True)})
    foremost, rear = float(points[:, 2].max()), float(points[:, 2].min())
    edges = [(a, b) for a, b in pairs if not (mounted and (points[[a, b], 2] <= rear + REAR_M).all())]
    corners = {k for k, z in enumerate(points[:, 2].tolist()) if z > 0.5 * (foremost + rear) or not mounted}
    return Shape(points, corners, edges, [False] * len(edges), loops)


def _loop(surface: Surface, patch: int, number: dict[int, int]) -> list[int]:
    """A flat face's corners, counter-clockwise seen from outside."""
    own = surface.triangles[surface.patch == patch]
    sides = np.concatenate([own[:, [0, 1]], own[:, [1, 2]], own[:, [2, 0]]]).tolist()
    there = {(a, b) for a, b in sides}
    after = {a: b for a, b in sides if (b, a) not in there}
    start = next(iter(after))
    loop, at = [start], after[start]
    while at != start and len(loop) <= len(after):
        loop.append(at)
        at = after[at]
    loop = [p for p in loop if p in number]
    if normal_of(surface.points_m[loop]) @ surface.normals[surface.patch == patch][0] < 0.0:
        loop.reverse()
    return [number[p] for p in loop]
