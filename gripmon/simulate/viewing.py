"""Ideal viewing rays of all pixels on a coarse grid; smooth maps computed there are enlarged to the image."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.records import Array

CELL_PX = 8
_FARTHEST_TEXEL = 15000.0


class RayGrid:
    """Rays through the centres of 8 x 8 px cells, with one cell of margin around the image."""

    def __init__(self, camera: Camera) -> None:
        self.width_px, self.height_px = camera.width_px, camera.height_px
        columns, rows = -(-self.width_px // CELL_PX) + 2, -(-self.height_px // CELL_PX) + 2
        u = (np.arange(columns) - 0.5) * CELL_PX - 0.5
        v = (np.arange(rows) - 0.5) * CELL_PX - 0.5
        grid = np.stack(np.meshgrid(u, v), axis=-1)
        xy = camera.undistort(grid.reshape(-1, 2))
        if not np.isfinite(xy).all():  # beyond the lens: repeat the image's border
            inside = np.clip(grid, 0.0, (self.width_px - 1.0, self.height_px - 1.0))
            xy = np.where(np.isfinite(xy), xy, camera.undistort(inside.reshape(-1, 2)))
        self.seen = np.isfinite(xy).all(axis=1).reshape(rows, columns)
        self._xy1 = np.concatenate([np.nan_to_num(xy), np.ones((len(xy), 1))], axis=1).reshape(rows, columns, 3)
        centre = camera.undistort(np.array([[0.5 * self.width_px, 0.5 * self.height_px]]))[0]
        self.view_centre = np.array([centre[0], centre[1], 1.0]) / np.sqrt(centre @ centre + 1.0)

    def plane_coordinates(
        self, cam_T_plane: Array, px_per_m: float, window: tuple[slice, slice] | None = None
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Where the rays of a window of cells meet the plane z = 0 of a frame: its x and y times ``px_per_m``."""
        rays = self._xy1 if window is None else self._xy1[window]
        matrix = np.linalg.inv(np.column_stack([cam_T_plane[:3, :2], cam_T_plane[:3, 3]]))
        matrix[:2] *= px_per_m
        x, y, w = np.moveaxis(rays @ matrix.T, -1, 0)
        w = np.maximum(w, 1e-9)  # rays that leave over the plane's horizon meet nothing: send them far away
        limit = _FARTHEST_TEXEL
        return (
            np.clip(x / w, -limit, limit).astype(np.float32),
            np.clip(y / w, -limit, limit).astype(np.float32),
        )

    def enlarge(self, coarse: NDArray[np.float32]) -> NDArray[np.float32]:
        """A map on all cells -> on all pixels."""
        large = enlarge_cells(coarse)
        return large[CELL_PX : CELL_PX + self.height_px, CELL_PX : CELL_PX + self.width_px]

    def window(self, left: int, top: int, width: int, height: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
        """Cells that cover a pixel window with margin, and where the window lies in the enlarged cells."""
        first_u, first_v = left // CELL_PX, top // CELL_PX
        last_u, last_v = (left + width - 1) // CELL_PX + 3, (top + height - 1) // CELL_PX + 3
        u, v = left - (first_u - 1) * CELL_PX, top - (first_v - 1) * CELL_PX
        return (slice(first_v, last_v), slice(first_u, last_u)), (slice(v, v + height), slice(u, u + width))


def enlarge_cells(coarse: NDArray[np.float32]) -> NDArray[np.float32]:
    """Values at cell centres -> at the pixels of these cells, linear between; constant beyond the outermost centres."""
    rows, columns = coarse.shape
    large = cv2.resize(coarse, (columns * CELL_PX, rows * CELL_PX), interpolation=cv2.INTER_LINEAR)
    return np.asarray(large, dtype=np.float32)
