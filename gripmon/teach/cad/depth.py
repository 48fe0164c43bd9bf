"""Occlusion: the depth of everything that a camera sees, on a grid finer than its pixels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.compiled import compiled
from gripmon.model.geometry import invert
from gripmon.model.records import Array
from gripmon.teach.cad.surface import Surface

CELLS = 2
"""Cells per pixel."""

HIDDEN_M = 1e-4
"""A point farther than this behind a surface is hidden by it."""

_NEAREST_M = 1e-3
_OUTSIDE = 0.25  # margin kept on each side, over the image's size


class Pinhole(NamedTuple):
    """A view without its lens's distortion: ``cam_T_grip`` (4, 4), focal length and window, px."""

    cam_T_grip: Array
    focal_px: float
    low_px: Array
    high_px: Array

    @classmethod
    def of(cls, camera: Camera, cam_T_grip: Array) -> Pinhole:
        """The view; its window is the image with a margin of a quarter of its size."""
        share = np.linspace(0.0, 1.0, 17)
        across, down = np.meshgrid(share, share)
        grid = np.column_stack([across.ravel() * (camera.width_px - 1.0), down.ravel() * (camera.height_px - 1.0)])
        xy = camera.undistort(grid)
        xy = xy[np.isfinite(xy).all(axis=1)] * camera.fx_px
        low, high = xy.min(axis=0), xy.max(axis=0)
        # A fisheye's ideal image is unbounded: three times the image's own width is enough for a gripper.
        most = 1.5 * np.array([camera.width_px, camera.height_px])
        low, high = np.maximum(low, -most), np.minimum(high, most)
        return cls(cam_T_grip, camera.fx_px, low - _OUTSIDE * (high - low), high + _OUTSIDE * (high - low))

    @property
    def eye_grip_m(self) -> Array:
        return invert(self.cam_T_grip)[:3, 3]

    def project(self, points_grip_m: Array) -> tuple[Array, Array]:
        """Positions (n, 2), px, and depths (n,), m; NaN behind the camera."""
        cam = points_grip_m @ self.cam_T_grip[:3, :3].T + self.cam_T_grip[:3, 3]
        depth = np.where(cam[:, 2] > _NEAREST_M, cam[:, 2], np.nan)
        return self.focal_px * cam[:, :2] / depth[:, None], depth


class DepthMap:
    """Nearest depths of some surfaces from a view."""

    def __init__(self, view: Pinhole, surfaces: Sequence[Surface]) -> None:
        self._view = view
        columns, rows = np.ceil(CELLS * (view.high_px - view.low_px)).astype(int) + 3
        # Inverse depth is linear in the image, and 0 where there is nothing.
        self._inverse = np.zeros((rows, columns))
        for surface in surfaces:
            px, depth = view.project(surface.points_m)
            places = np.column_stack([self._cells(px), 1.0 / depth])
            draw(places, surface.triangles, self._inverse)
        padded = np.pad(self._inverse, 1)
        shifts = [padded[i : i + rows, j : j + columns] for i in range(3) for j in range(3)]
        self._farthest = np.min(shifts, axis=0)

    def visible(self, points_grip_m: Array) -> NDArray[np.bool_]:
        """Mask (n,) of the points (n, 3) that are visible: those without a surface in front in some of the nine cells
        around.  False outside of the view.
        """
        px, depth = self._view.project(points_grip_m)
        cells = np.rint(np.nan_to_num(self._cells(px), nan=-1e6)).astype(int)
        rows, columns = self._inverse.shape
        inside = (cells >= 0).all(axis=1) & (cells[:, 0] < columns) & (cells[:, 1] < rows) & np.isfinite(depth)
        out = np.zeros(len(depth), dtype=bool)
        u, v = cells[inside].T
        out[inside] = self._farthest[v, u] <= 1.0 / (depth[inside] - HIDDEN_M)
        return out

    def _cells(self, px: Array) -> Array:
        return CELLS * (px - self._view.low_px) + 1.0


@compiled
def draw(places: Any, triangles: Any, inverse: Any) -> None:
    """Draw triangles (t, 3) over ``places`` (p, 3) (column, row, inverse depth), keeping the largest inverse depths."""
    rows, columns = inverse.shape
    for t in range(len(triangles)):
        ax, ay, aw = places[triangles[t, 0]]
        bx, by, bw = places[triangles[t, 1]]
        cx, cy, cw = places[triangles[t, 2]]
        twice = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if not (abs(twice) > 1e-12):  # seen edge-on, or behind the camera (NaN)
            continue
        left, right = max(int(np.ceil(min(ax, bx, cx))), 0), min(int(np.floor(max(ax, bx, cx))), columns - 1)
        top, bottom = max(int(np.ceil(min(ay, by, cy))), 0), min(int(np.floor(max(ay, by, cy))), rows - 1)
        for y in range(top, bottom + 1):
            for x in range(left, right + 1):
                b = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / twice
                c = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / twice
                if b >= 0.0 and c >= 0.0 and b + c <= 1.0:
                    w = aw + b * (bw - aw) + c * (cw - aw)
                    if w > inverse[y, x]:
                        inverse[y, x] = w
