"""A body's surface: neighbouring triangles, sharp edges between them, flat patches, and the radius of round parts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from gripmon.model.records import Array
from gripmon.teach.cad.files import mesh_library

if TYPE_CHECKING:
    from trimesh import Trimesh

SHARP_RAD = 0.524
"""Angle between two triangles (30 degrees) above which they meet in a sharp edge.  Exports cut roundings finer: Open
CASCADE's mesher, which FreeCAD and others use, by 0.5 rad by default."""

FLAT_M = 5e-6
"""Largest distance of a face's points from its plane: float32 coordinates of a metre are off by 0.03 of it."""

WELD_M = 2e-6
"""Distance within which points on borders are merged: exports have single precision, or six digits of millimetres."""


@dataclass(frozen=True, slots=True)
class Surface:
    """``points_m`` (p, 3), ``triangles`` (t, 3) with unit ``normals`` (t, 3).  ``edges`` (e, 2) points, ``sides``
    (e, 2) their triangles, -1 where there is none; ``sharp`` (e,): an edge of the body, or its border.  ``patch`` (t,):
    number of the part that is connected without crossing a sharp edge.  ``alike`` (e,): whether its two triangles have
    the same orientation.
    """

    points_m: Array
    triangles: NDArray[np.intp]
    normals: Array
    edges: NDArray[np.intp]
    sides: NDArray[np.intp]
    sharp: NDArray[np.bool_]
    alike: NDArray[np.bool_]
    patch: NDArray[np.intp]

    @property
    def border(self) -> NDArray[np.bool_]:
        """Mask (e,) of edges with a triangle on one side only."""
        return np.asarray(self.sides[:, 1] < 0)

    @property
    def closed(self) -> bool:
        """Whether it bounds a solid, its triangles oriented outwards."""
        if not len(self.triangles) or self.border.any() or not self.alike.all():
            return False
        a, b, c = np.moveaxis(self.points_m[self.triangles], 1, 0)
        return bool(np.einsum("ti,ti->", a, np.cross(b, c)) > 0.0)

    def flat(self) -> bool:
        """Whether every patch is flat."""
        return all(self.off_plane_m(k) <= FLAT_M for k in range(int(self.patch.max(initial=-1)) + 1))

    def off_plane_m(self, patch: int) -> float:
        """Largest distance of a patch's points from its mean plane."""
        own = self.patch == patch
        corners = self.points_m[self.triangles[own]]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).sum(axis=0)
        height = corners.reshape(-1, 3) @ (normal / max(float(np.linalg.norm(normal)), 1e-30))
        return float(0.5 * np.ptp(height))


def surface_of(body: Trimesh) -> Surface:
    """A body's surface: its points merged, triangles without area left out; a solid turned inside out is corrected."""
    points, triangles = welded(body)
    a, b, c = np.moveaxis(points[triangles] - points.mean(axis=0), 1, 0)
    if np.einsum("ti,ti->", a, np.cross(b, c)) < 0.0:
        triangles = triangles[:, ::-1]
    corners = points[triangles]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(area, axis=1)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    # Flat to the rounding of single precision: such a sliver has no reliable normal.
    kept = size > 2e-7 * longest * np.maximum(longest, 1e-3)
    triangles, normals = triangles[kept], area[kept] / size[kept, None]
    edges, sides, alike = _neighbours(triangles)
    turn = np.einsum("ei,ei->e", normals[sides[:, 0]], normals[sides[:, 1]]) * np.where(alike, 1.0, -1.0)
    sharp = (sides[:, 1] < 0) | (turn < np.cos(SHARP_RAD))
    smooth = sides[~sharp]
    graph = coo_matrix((np.ones(len(smooth), np.int8), smooth.T), shape=(len(triangles),) * 2)
    patch = connected_components(graph, directed=False)[1].astype(np.intp) if len(triangles) else np.zeros(0, np.intp)
    return Surface(points, triangles, normals, edges, sides, sharp, alike, patch)


def _neighbours(triangles: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
    """Edges (e, 2), the two triangles of each (e, 2), and whether these traverse it in opposite directions, as on a
    consistently oriented surface.  An edge with more than two triangles counts once for each pair.
    """
    if not len(triangles):
        return np.zeros((0, 2), np.intp), np.zeros((0, 2), np.intp), np.zeros(0, bool)
    ends = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    owner = np.tile(np.arange(len(triangles)), 3)
    low, high = ends.min(axis=1), ends.max(axis=1)
    order = np.lexsort((owner, high, low))
    low, high, owner, forward = low[order], high[order], owner[order], (ends[:, 0] < ends[:, 1])[order]
    same = (low[1:] == low[:-1]) & (high[1:] == high[:-1])
    # Of the triangles at an edge the first pairs with the second, a third one with a fourth.
    starts = np.flatnonzero(np.concatenate([[True], ~same]))
    rank = np.arange(len(low)) - np.repeat(starts, np.diff(np.append(starts, len(low))))
    first = np.flatnonzero(rank % 2 == 0)
    paired = (first + 1 < len(low)) & np.append(same, False)[first]
    after = np.minimum(first + 1, len(low) - 1)
    sides = np.column_stack([owner[first], np.where(paired, owner[after], -1)])
    alike = forward[first] != forward[after]
    return np.column_stack([low[first], high[first]]), sides, alike | ~paired


def welded(body: Trimesh) -> tuple[Array, NDArray[np.intp]]:
    """A body's points (p, 3) and triangles (t, 3), with coinciding points on borders merged."""
    points, triangles = np.asarray(body.vertices, dtype=float), np.asarray(body.faces, dtype=np.intp)
    edges, sides, _ = _neighbours(triangles)
    border = np.unique(edges[sides[:, 1] < 0])
    close = cKDTree(points[border]).query_pairs(WELD_M, output_type="ndarray")
    if not len(close):
        return points, triangles
    count = len(points)
    graph = coo_matrix((np.ones(len(close), np.int8), border[close].T), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    _, first, back = np.unique(label, return_index=True, return_inverse=True)
    triangles = back[triangles]
    whole = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    return points[first], triangles[whole]


@dataclass(frozen=True, slots=True)
class Shading:
    """A surface's smooth normals: ``corner`` (t, 3) indices into ``normals`` (n, 3), one per point and patch."""

    corner: NDArray[np.intp]
    normals: Array


def shading_of(surface: Surface) -> Shading:
    """Normals at the points of each patch, triangles weighted by their angle there (Thürmer and Wüthrich 1998)."""
    triangles = surface.triangles
    key = surface.patch[:, None] * np.intp(len(surface.points_m)) + triangles
    _, corner = np.unique(key, return_inverse=True)
    corner = corner.reshape(-1, 3)
    trimesh = mesh_library("a surface")
    angles = trimesh.triangles.angles(surface.points_m[triangles])
    count = int(corner.max(initial=-1)) + 1
    return Shading(corner, trimesh.geometry.weighted_vertex_normals(count, corner, surface.normals, angles))


def radius_m(places: Array, normals: Array, direction: Array) -> Array:
    """Radii (n,) of curvature along ``direction`` (n, 3); infinite where flat, negative where concave.

    ``places``, ``normals`` (n, 3, 3): the corners of triangles on it.  The derivative of the normal along the surface
    is linear in the direction (the shape operator); it follows from the three sides of a triangle (Rusinkiewicz 2004).
    """
    sides = np.roll(places, -1, axis=1) - places
    change = np.roll(normals, -1, axis=1) - normals
    mean = normals.mean(axis=1)
    u = direction / np.linalg.norm(direction, axis=1)[:, None]
    v = np.cross(mean / np.linalg.norm(mean, axis=1)[:, None], u)
    along, across = np.einsum("nki,ni->nk", sides, u), np.einsum("nki,ni->nk", sides, v)
    turned = np.einsum("nki,ni->nk", change, u)
    # Least squares of turned = a * along + b * across over the three sides: a is the curvature wanted.
    aa, bb, ab = (along**2).sum(axis=1), (across**2).sum(axis=1), (along * across).sum(axis=1)
    at, bt = (along * turned).sum(axis=1), (across * turned).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        curvature = (at * bb - bt * ab) / (aa * bb - ab**2)
        return np.where(np.abs(curvature) > 1e-6, 1.0 / curvature, np.inf)
