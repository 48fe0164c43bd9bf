"""The wrist camera as the controller's sensor: the pose of the object that is to be grasped, as a detector gives it."""

from __future__ import annotations

import cv2
import numpy as np

from gripmon.model.camera import Camera
from gripmon.model.geometry import make_transform
from gripmon.model.records import Array
from gripmon.simulate.scenario import GraspedObject

SIGMA_PX = 0.1
"""Standard deviation of each image coordinate of each point."""

_FEWEST = 6
_ROWS, _COLUMNS = 4, 3
_FOCAL_PX = 1000.0  # of the ideal camera in which the pose is solved; its units, in which steps are judged, are pixels


def object_points_m(grasped: GraspedObject) -> Array:
    """Marks (12, 3) on the side of the box that looks at the camera; the frame's origin is where the TCP shall be."""
    width_m, height_m, length_m = grasped.size_m
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, _COLUMNS) * width_m, np.linspace(-0.5, 0.5, _ROWS) * height_m)
    z = np.full(x.size, grasped.depth_m - length_m)
    return np.stack([x.ravel(), y.ravel() + grasped.side_m, z], axis=1)


class Eye:
    """Projects the marks through the true lens, adds noise to their pixels, and solves for the pose.

    Intrinsics are exact; neither fingers nor a hand hide marks here (the caller knows when a hand does).
    """

    def __init__(self, camera: Camera, points_m: Array) -> None:
        self._camera, self._points_m = camera, points_m

    def noise_px(self, rng: np.random.Generator) -> Array:
        """(n, 2) errors of the marks' pixels in one frame."""
        return rng.normal(0.0, SIGMA_PX, (len(self._points_m), 2))

    def cam_T_object(self, true_cam_T_object: Array, noise_px: Array) -> Array | None:
        """The measured pose; None with fewer than six marks in view."""
        points_cam = self._points_m @ true_cam_T_object[:3, :3].T + true_cam_T_object[:3, 3]
        uv = self._camera.project(points_cam) + noise_px
        last = np.array([self._camera.width_px - 1.0, self._camera.height_px - 1.0])
        with np.errstate(invalid="ignore"):
            seen = (points_cam[:, 2] > 0.0) & (uv >= 0.0).all(axis=1) & (uv <= last).all(axis=1)
        if int(seen.sum()) < _FEWEST:
            return None
        ideal = self._camera.undistort(uv[seen]) * _FOCAL_PX
        lens = np.diag([_FOCAL_PX, _FOCAL_PX, 1.0])
        marks = self._points_m[seen]
        found, turn, shift = cv2.solvePnP(marks, ideal, lens, None, flags=cv2.SOLVEPNP_IPPE)
        if not found:
            return None
        turn, shift = cv2.solvePnPRefineLM(marks, ideal, lens, None, turn, shift)
        return make_transform(cv2.Rodrigues(turn)[0], shift[:, 0])
