"""Lines and areas at stated places of a body, as factors on its faces' textures: marks on fingers, lines on objects.

Sharp borders are spread over a texel, and blurred as the lens would: a texel is about a pixel.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array
from gripmon.simulate.scenario import FingerMark, ObjectLook
from gripmon.simulate.solids import Solid
from gripmon.simulate.textures import Factor, Rng

_LENS_BLUR_PX = 0.6
_ALONG = np.array([0.0, 0.0, 1.0])
_FLAT_M = 1e-6
_LONG_FACE = 0.5  # a face is long if its normal's part along the finger is smaller


def grid_m(rows: int, columns: int, px_per_m: float, body_T_plane: Array) -> Array:
    """Points (rows, columns, 3) of a texture's texels in the body's frame."""
    x, y = np.meshgrid(np.arange(columns) / px_per_m, np.arange(rows) / px_per_m)
    plane = np.stack([x, y, np.zeros_like(x)], axis=-1)
    return plane @ body_T_plane[:3, :3].T + body_T_plane[:3, 3]


def marks(wanted: list[FingerMark], solid: Solid, face: int, grid: Array, px_per_m: float) -> Factor:
    """Factor of marks on one face of a finger whose tip is where z is largest; 1 on faces that aren't long."""
    out = np.ones(grid.shape[:2])
    normal = solid.normals[face]
    if abs(normal @ _ALONG) > _LONG_FACE:
        return out.astype(np.float32)
    across = np.cross(normal, _ALONG)
    across /= np.linalg.norm(across)
    corners = solid.vertices_m[solid.loops[face]] @ across
    middle, half = 0.5 * (corners.min() + corners.max()), 0.5 * float(np.ptp(corners))
    back_m = solid.vertices_m[:, 2].max() - grid[..., 2]
    side_m = grid @ across - middle
    for mark in wanted:
        (near_m, far_m), (left, right) = mark.from_tip_m, mark.across
        if mark.shape == "disc":
            centre_m = 0.5 * (near_m + far_m), 0.5 * (left + right) * half
            inside = 0.5 * (far_m - near_m) - np.hypot(back_m - centre_m[0], side_m - centre_m[1])
        else:
            inside = np.minimum(
                np.minimum(back_m - near_m, far_m - back_m), np.minimum(side_m - left * half, right * half - side_m)
            )
        out *= 1.0 + (mark.gain - 1.0) * _filled(inside, px_per_m)
    return _blurred(out)


def lines(rng: Rng, look: ObjectLook, solid: Solid, grid: Array, px_per_m: float) -> Factor:
    """Factor of a pattern of lines on one face of an object; the same lines on all faces for the same random state."""
    out = np.ones(grid.shape[:2])
    if look.pattern == "plain":
        return out.astype(np.float32)
    # Where a face has no extent along the fingers, a line parallel to the tips is at a place along y.
    beyond = 2 if np.ptp(grid[..., 2]) > _FLAT_M else 1
    if look.pattern == "fold":
        inside = solid.vertices_m[:, beyond].max() - look.pitch_m - grid[..., beyond]
        return _blurred(out - look.contrast * _filled(inside, px_per_m))
    # Lines along the fingers are at places across them: on each face the axis that varies.
    axis = beyond if look.pattern == "lines_along_tips" else int(np.ptp(grid[..., :2], axis=(0, 1)).argmax())
    place_m = grid[..., axis]
    start_m, end_m = float(place_m.min()), float(place_m.max())
    while start_m < end_m:
        width_m = look.pitch_m * float(rng.uniform(0.2, 0.8))
        inside = np.minimum(place_m - start_m, start_m + width_m - place_m)
        out -= look.contrast * float(rng.uniform(0.4, 1.0)) * _filled(inside, px_per_m)
        start_m += width_m + look.pitch_m * float(rng.uniform(0.2, 0.8))
    return _blurred(out)


def _filled(inside_m: Array, px_per_m: float) -> NDArray[np.float64]:
    """Share of each texel that an area fills, from the distance to its border, positive inside."""
    return np.clip(inside_m * px_per_m + 0.5, 0.0, 1.0)


def _blurred(factor: Array) -> Factor:
    return np.asarray(cv2.GaussianBlur(factor.astype(np.float32), (0, 0), _LENS_BLUR_PX), dtype=np.float32)
