"""Where pixels of fingers lie in the image, and how a motion of the gripper moves them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.gripper import Gripper
from gripmon.model.poses import perturb, perturbation_between
from gripmon.model.records import Array

LINEAR_PX = 0.5
"""Motion up to which pixels are taken to move linearly, px: over 500 px the rest is (0.5 / 500)² 500 = 0.0005 px."""


class Placed:
    """Pixels (p, n) of fingers, projected where the gripper is; again only when it has moved."""

    def __init__(self, camera: Camera, gripper: Gripper, points_grip_m: Array, finger: NDArray[np.intp]):
        """``points_grip_m`` (p, n, 3) at the jaw's nominal opening."""
        self._camera, self._gripper = camera, gripper
        self._points_grip_m, self._finger = points_grip_m, finger
        self._first = [int(np.argmax(gripper.point_finger == f)) for f in range(len(gripper.finger_ids))]
        self._at: tuple[Array, float | None] | None = None
        self.base_px: Array = np.zeros((0, 0, 2))
        self.flow: Array = np.zeros((0, 0, 2, 7))

    def offsets_m(self, jaw_opening_m: float | None) -> Array:
        """(f, 3) of each finger from where it is at the nominal opening."""
        now, then = (self._gripper.points_grip_m(o) for o in (jaw_opening_m, self._gripper.jaw_nominal_m))
        return np.asarray(now[self._first] - then[self._first])

    def motion_to(self, cam_T_grip: Array, jaw_opening_m: float | None) -> Array:
        """(7,) motion, gripper axes, from where the pixels are projected; they are projected there if it is far."""
        if self._at is not None:
            motion = motion_between(self._at[0], cam_T_grip, self._at[1], jaw_opening_m)
            if self.moved_px(motion) <= LINEAR_PX:
                return motion
        self._project(cam_T_grip, jaw_opening_m)
        return np.zeros(7)

    def moved_px(self, motion: Array) -> float:
        """How far a motion (7,) takes the first pixel of any patch; infinite before there is a projection."""
        return float(np.abs(self.flow[:, 0] @ motion).max(initial=0.0)) if self._at is not None else np.inf

    def _project(self, cam_T_grip: Array, jaw_opening_m: float | None) -> None:
        self._at = cam_T_grip.copy(), jaw_opening_m
        shape = self._points_grip_m.shape[:2]
        points = (self._points_grip_m + self.offsets_m(jaw_opening_m)[self._finger][:, None]).reshape(-1, 3)
        rotation = cam_T_grip[:3, :3]
        uv_px, d_uv = self._camera.project_with_jacobian(points @ rotation.T + cam_T_grip[:3, 3])
        d_grip = d_uv @ rotation
        flow = np.empty((len(points), 2, 7))
        flow[..., :3] = d_grip
        for row in range(2):
            flow[:, row, 3:6] = np.cross(points, d_grip[:, row])
        per_m = self._per_opening(jaw_opening_m)[self._finger].repeat(shape[1], axis=0)
        flow[..., 6] = np.einsum("nij,nj->ni", d_grip, per_m)
        self.base_px, self.flow = uv_px.reshape(*shape, 2), flow.reshape(*shape, 2, 7)

    def _per_opening(self, jaw_opening_m: float | None) -> Array:
        """(f, 3) way of each finger for each metre that the jaw opens."""
        if jaw_opening_m is None or not self._gripper.has_jaw:
            return np.zeros((len(self._first), 3))
        low = max(jaw_opening_m - 1e-5, self._gripper.jaw_min_m)
        high = min(jaw_opening_m + 1e-5, self._gripper.jaw_max_m)
        return (self.offsets_m(high) - self.offsets_m(low)) / (high - low)


def motion_between(from_T: Array, to_T: Array, from_m: float | None, to_m: float | None) -> Array:
    """(7,): shift and turn in gripper axes, m and rad, and by how much the jaw opens, m."""
    xi = perturbation_between(from_T, to_T)
    opened_m = 0.0 if from_m is None or to_m is None else to_m - from_m
    return np.concatenate([xi[:3] @ from_T[:3, :3], xi[3:] @ from_T[:3, :3], [opened_m]])


def moved(cam_T_grip: Array, motion: Array) -> Array:
    """A pose (4, 4) after a motion (7,) in gripper axes."""
    rotation = cam_T_grip[:3, :3]
    return perturb(cam_T_grip, np.concatenate([rotation @ motion[:3], rotation @ motion[3:6]]))
