"""A gripper's pose from all edges of it that an image shows, no plate considered; and how it stands off the plate then.

Edges that rise from the contact plane tell tilts several times better than corners in it: a plane that is tilted a
little looks nearly the same, a finger that leans doesn't.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gripmon.model.camera import Camera
from gripmon.model.geometry import perturb, skew
from gripmon.model.least_squares import fit
from gripmon.model.records import Array


@dataclass(frozen=True, slots=True)
class FreePose:
    """``cam_T_grip`` (4, 4) with the ``covariance`` (6, 6) of its error (position then rotation, camera axes), measured
    through ``camera``; ``points_m`` (n, 3) of the gripper, which stand for what was measured.
    """

    cam_T_grip: Array
    covariance: Array
    camera: Camera
    points_m: Array

    def through(self, camera: Camera) -> Array:
        """``cam_T_grip`` (4, 4) that the same image shows if ``camera`` took it: least squares over the points."""
        out = self.cam_T_grip
        if camera is self.camera:
            return out
        uv_px = self.camera.project(self.points_m @ out[:3, :3].T + out[:3, 3])
        xy = camera.undistort(uv_px)
        seen = np.isfinite(xy).all(axis=1)
        return pose_of_points(out, self.points_m[seen], xy[seen])

    def own_slopes(self, cam_T_plate: Array, contact_m: float) -> Array:
        """(3, 6): what the pose's own independent errors, in their standard deviations, do to :func:`off_plate`."""
        scale = np.sqrt(self.covariance.diagonal())
        variances, axes = np.linalg.eigh(self.covariance / np.outer(scale, scale))
        roots = (scale[:, None] * axes * np.sqrt(np.maximum(variances, 0.0))).T
        up, down = (
            np.array([off_plate(perturb(self.cam_T_grip, s * r), cam_T_plate, contact_m) for r in roots])
            for s in (0.5, -0.5)
        )
        out: Array = (up - down).T
        return out


def pose_of_points(start: Array, points_m: Array, xy: Array, whiten: Array | None = None) -> Array:
    """The pose (4, 4) near ``start`` that shows points (n, 3) at ideal coordinates ``xy`` (n, 2) with the least
    residuals, which ``whiten`` (n, 2, 2) makes comparable.
    """

    def linearised(pose: Array) -> tuple[Array, Array]:
        turned = points_m @ pose[:3, :3].T
        x, y, z = (turned + pose[:3, 3]).T
        by_point = np.zeros((len(z), 2, 3))
        by_point[:, 0, 0] = by_point[:, 1, 1] = 1.0 / z
        by_point[:, 0, 2], by_point[:, 1, 2] = -x / z**2, -y / z**2
        rows = np.concatenate([by_point, -by_point @ skew(turned)], axis=2)
        values = xy - np.stack([x / z, y / z], axis=1)
        return (rows, values) if whiten is None else (whiten @ rows, np.einsum("nij,nj->ni", whiten, values))

    return fit(start, linearised, perturb).state


def off_plate(cam_T_grip: Array, cam_T_plate: Array, contact_m: float) -> Array:
    """(3,): tilt about the gripper's x and y (rad) by which its contact plane, z = ``contact_m``, leaves the plate, and
    the gap (m) at its middle, the gripper nearer to the camera than the plate.
    """
    rotation, normal = cam_T_grip[:3, :3], cam_T_plate[:3, 2]
    across = rotation.T @ np.cross(normal, rotation[:, 2])
    contact = cam_T_grip[:3, 3] + contact_m * rotation[:, 2]
    return np.array([across[0], across[1], -normal @ (contact - cam_T_plate[:3, 3])])
