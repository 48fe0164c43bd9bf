"""Outlines of convex fingers as one opening's images show them, without images: hulls of their projected corners."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.spatial import ConvexHull

from gripmon.model.camera import Camera
from gripmon.model.records import Array
from gripmon.model.staying import Edges
from gripmon.teach.fingers import outwards_from
from gripmon.teach.image_outline import FingerSeen, OpeningSeen
from gripmon.teach.matte import Matte
from gripmon.teach.silhouette import FROM_BORDER_PX
from gripmon.teach.straight_pieces import Chain


def wedge(side: float, gap_m: float, tip_m: tuple[float, float], root_m: tuple[float, float], length_m: float) -> Array:
    """Corners (8, 3) of a finger in the gripper frame, its inner face's end at z = 0: its sizes across the jaws and
    along y at tip and root; the inner face is straight.
    """
    return np.array([
        [side * (0.5 * gap_m + x * width), (y - 0.5) * thick, z]
        for z, (width, thick) in ((0.0, tip_m), (-length_m, root_m))
        for x in (0.0, 1.0)
        for y in (0.0, 1.0)
    ])  # fmt: skip


def turned(corners: Array, pivot_m: Array, angle_rad: float) -> Array:
    """Corners (n, 3) turned about the gripper's y axis at a pivot (3,)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.asarray((corners - pivot_m) @ np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]]) + pivot_m)


def seen_opening(
    camera: Camera, cam_T_grip: Array, fingers: Sequence[Array], noise_px: float, rng: np.random.Generator
) -> OpeningSeen:
    """``fingers`` (n, 3) each, gripper frame; every line of an outline is off by ``noise_px`` at both ends."""
    shape = camera.height_px, camera.width_px
    found = tuple(_finger(camera, shape, f @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3], noise_px, rng) for f in fingers)
    nothing = np.zeros(shape, np.float32)
    edges = Edges(nothing, nothing, nothing > 0, nothing > 0, 0.1)
    matte = Matte(nothing > 0, edges, 1.0, nothing[None], np.zeros((1, 2)), (0,), {})
    return OpeningSeen(matte, found, {}, 1.0, nothing > 0)


def _finger(
    camera: Camera, shape: tuple[int, int], cam_m: Array, noise_px: float, rng: np.random.Generator
) -> FingerSeen:
    uv = camera.project(cam_m)
    corners = uv[ConvexHull(uv).vertices]
    if _area(corners) > 0.0:
        corners = corners[::-1]  # going along it the gripper is on the left in the image, whose y points down
    lines = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        way = (b - a) / np.linalg.norm(b - a)
        normal = np.array([-way[1], way[0]])
        lines.append((a + normal * rng.normal(0.0, noise_px), b + normal * rng.normal(0.0, noise_px)))
    noisy = np.array([_meet(lines[k - 1], lines[k]) for k in range(len(lines))])
    inside = np.array([FROM_BORDER_PX, FROM_BORDER_PX]), np.array([shape[1], shape[0]]) - 1.0 - FROM_BORDER_PX
    pieces = [_clipped(a, b, *inside) for a, b in zip(noisy, np.roll(noisy, -1, axis=0), strict=True)]
    kept = [k for k, piece in enumerate(pieces) if piece is not None]
    # Begin after the stretch that the border hides.
    count = len(pieces)
    after = [k for k in kept if pieces[k - 1] is None or np.linalg.norm(pieces[k][0] - pieces[k - 1][1]) > 1e-6]
    assert after, "a finger that the image's border doesn't cut"
    first = after[0]
    order = [(first + i) % count for i in range(count) if (first + i) % count in kept]
    vertices = np.array([pieces[order[0]][0], *(pieces[k][1] for k in order)])
    corner = np.array([False, *[True] * (len(vertices) - 2), False])
    chain = Chain(vertices, np.repeat(vertices[None], 10, axis=0), False, corner, np.full(len(order), 0.05))
    mask = np.zeros(shape, np.uint8)
    cv2.fillPoly(mask, [np.rint(corners).astype(np.int32)], 1)
    full = mask > 0
    rows, columns = np.nonzero(full)
    border = (rows == 0) | (columns == 0) | (rows == shape[0] - 1) | (columns == shape[1] - 1)
    root = np.column_stack([columns, rows])[border].mean(axis=0)
    return FingerSeen(full, (chain,), (), outwards_from(full, root))


def _area(corners: Array) -> float:
    x, y = corners.T
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def _meet(first: tuple[Array, Array], second: tuple[Array, Array]) -> Array:
    (a, b), (c, d) = first, second
    along = np.linalg.solve(np.column_stack([b - a, c - d]), c - a)
    return np.asarray(a + along[0] * (b - a))


def _clipped(a: Array, b: Array, low: Array, high: Array) -> tuple[Array, Array] | None:
    """The part of a line that lies in a rectangle (Liang and Barsky 1984)."""
    way, start, end = b - a, 0.0, 1.0
    for p, q in [*zip(-way, a - low, strict=True), *zip(way, high - a, strict=True)]:
        if p == 0.0:
            if q < 0.0:
                return None
        elif p < 0.0:
            start = max(start, q / p)
        else:
            end = min(end, q / p)
    return None if start >= end else (a + start * way, a + end * way)
