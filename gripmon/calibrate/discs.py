"""Where the visible blob of a disc has its centre: not where the disc's centre projects to.

Under perspective the image of a circle is an ellipse whose centre is another point than the image of the circle's
centre, and a lens bends it further; some tenths of a pixel for near, tilted plates.
"""

from __future__ import annotations

import numpy as np

from gripmon.model.camera import Camera
from gripmon.model.records import Array

RIM_POINTS = 24


def centre_offsets_px(camera: Camera, cam_T_plate: Array, plate_m: Array, radius_m: float) -> Array:
    """(n, 2): centre of area of each disc's image less the image of its centre; 0 where a rim leaves the lens."""
    angles = 2.0 * np.pi / RIM_POINTS * np.arange(RIM_POINTS)
    # The polygon through the rim is a little smaller than the disc; its centre is the same to a thousandth of that.
    rim = radius_m * np.stack([np.cos(angles), np.sin(angles), np.zeros(RIM_POINTS)], axis=1)
    points = (plate_m[:, None] + rim).reshape(-1, 3) @ cam_T_plate[:3, :3].T + cam_T_plate[:3, 3]
    rims = camera.project(points).reshape(len(plate_m), RIM_POINTS, 2)
    centres = camera.project(plate_m @ cam_T_plate[:3, :3].T + cam_T_plate[:3, 3])
    offsets = _centroids(rims) - centres
    return np.where(np.isfinite(offsets), offsets, 0.0)


def _centroids(polygons: Array) -> Array:
    """(n, k, 2) -> (n, 2), centres of area (shoelace formula), reckoned about the first corner for exactness."""
    origin = polygons[:, :1]
    x, y = np.moveaxis(polygons - origin, 2, 0)
    x1, y1 = np.roll(x, -1, axis=1), np.roll(y, -1, axis=1)
    cross = x * y1 - x1 * y
    area = cross.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        out: Array = np.stack([((x + x1) * cross).sum(axis=1), ((y + y1) * cross).sum(axis=1)], axis=1) / (
            3.0 * area[:, None]
        )
    return out + origin[:, 0]
