"""Where a camera sees discs, by OpenCV's moments of their outlines: nothing of the product's own."""

from __future__ import annotations

import cv2
import numpy as np

from gripmon.model.camera import Camera
from gripmon.model.records import Array

_RIM = 720


def blob_centres_px(camera: Camera, cam_T_plate: Array, plate_m: Array, radius_m: float) -> Array:
    """(n, 2): the centroid of each disc's image, NaN where the lens doesn't map its rim."""
    angles = np.linspace(0.0, 2.0 * np.pi, _RIM, endpoint=False)
    rim = radius_m * np.stack([np.cos(angles), np.sin(angles), np.zeros(_RIM)], axis=1)
    out = np.full((len(plate_m), 2), np.nan)
    for k, centre in enumerate(plate_m):
        at = camera.project((centre + rim) @ cam_T_plate[:3, :3].T + cam_T_plate[:3, 3])
        if np.isfinite(at).all():
            near = at.mean(axis=0)  # moments take single precision
            moments = cv2.moments((at - near).astype(np.float32)[:, None])
            out[k] = near + np.array([moments["m10"], moments["m01"]]) / moments["m00"]
    return out
