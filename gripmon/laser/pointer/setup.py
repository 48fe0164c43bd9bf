"""A laser pointer on the end-effector, a plane that its spot falls on, and a fixed camera that sees the spot.

Three ways lead to the same spot (laser-pointer method, equations (7) to (14)): laser line and plane, camera ray and
plane, laser line and camera ray.  Where they disagree, something has moved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gripmon.model.geometry import perturb, skew
from gripmon.model.records import Array

PARAMETERS = (
    "cam_T_base.x_m", "cam_T_base.y_m", "cam_T_base.z_m", "cam_T_base.rx_rad", "cam_T_base.ry_rad", "cam_T_base.rz_rad",
    "plane.tilt_a_rad", "plane.tilt_b_rad", "plane.distance_m",
    "laser.turn_a_rad", "laser.turn_b_rad", "laser.shift_a_m", "laser.shift_b_m",
)  # fmt: skip
"""What :meth:`LaserSetup.moved` changes: a perturbation of the pose as everywhere else, then plane and laser line."""


@dataclass(frozen=True, slots=True)
class LaserSetup:
    """``cam_T_base`` (4, 4); the plane ``normal_cam . p = distance_m`` with a unit normal (3,) away from the camera;
    the laser line through ``point_ee_m`` (3,) along the unit vector ``direction_ee`` (3,), end-effector frame.
    """

    cam_T_base: Array
    normal_cam: Array
    distance_m: float
    point_ee_m: Array
    direction_ee: Array

    def moved(self, change: Array) -> LaserSetup:
        """Changed by small amounts (13,), in the order of :data:`PARAMETERS`; the laser's point stays in its plane,
        which is the one of the end-effector's axes that the beam pierces the most steeply.
        """
        a, b = basis(self.normal_cam)
        normal = self.normal_cam + change[6] * a + change[7] * b
        c, e = basis(self.direction_ee)
        direction = self.direction_ee + change[9] * c + change[10] * e
        point = self.point_ee_m.copy()
        point[list(origin_axes(self.direction_ee))] += change[11:13]
        return LaserSetup(
            perturb(self.cam_T_base, change[:6]),
            normal / np.linalg.norm(normal),
            self.distance_m + float(change[8]),
            point,
            direction / np.linalg.norm(direction),
        )


def basis(direction: Array) -> tuple[Array, Array]:
    """Two unit vectors (3,) that stand on a unit vector and on each other, right-handed with it; steady around it."""
    helper = np.eye(3)[int(np.argmin(np.abs(direction)))]
    turn = skew(direction)  # by this, as np.cross of single vectors costs many times more
    a = turn @ helper
    a /= np.linalg.norm(a)
    return a, turn @ a


def origin_axes(direction_ee: Array) -> tuple[int, int]:
    """The two axes of the end-effector that span the plane in which the laser's point is sought: the one that the beam
    is farthest from lying in.
    """
    pierced = int(np.argmax(np.abs(direction_ee)))
    return ((1, 2), (0, 2), (0, 1))[pierced]


def laser_lines(setup: LaserSetup, base_T_ee: Array) -> tuple[Array, Array]:
    """Points and unit directions (n, 3), camera frame, of the beam at end-effector poses (n, 4, 4)."""
    rotation, shift = setup.cam_T_base[:3, :3], setup.cam_T_base[:3, 3]
    points = (base_T_ee[:, :3, :3] @ setup.point_ee_m + base_T_ee[:, :3, 3]) @ rotation.T + shift
    return points, (base_T_ee[:, :3, :3] @ setup.direction_ee) @ rotation.T


def spots_on_plane(setup: LaserSetup, base_T_ee: Array) -> tuple[Array, Array]:
    """Laser line and plane, equations (7) to (9): spots (n, 3) in the camera frame, and their derivatives (n, 3, 13) by
    :data:`PARAMETERS`; NaN where the beam runs along the plane.
    """
    origin, u = laser_lines(setup, base_T_ee)
    n = setup.normal_cam
    steep = u @ n
    steep = np.where(np.abs(steep) > 1e-9, steep, np.nan)
    along = (setup.distance_m - origin @ n) / steep
    spots = origin + along[:, None] * u
    # A change of the line moves the spot along the plane: what leaves the plane comes back along the beam.
    project = np.eye(3) - u[:, :, None] * n / steep[:, None, None]
    slopes = np.zeros((len(spots), 3, len(PARAMETERS)))
    slopes[:, :, :3] = project
    # Turning the base turns origin and direction: the spot's lever counts from the camera's end of cam_T_base.
    slopes[:, :, 3:6] = -project @ skew(spots - setup.cam_T_base[:3, 3])
    a, b = basis(n)
    for column, tilt in ((6, a), (7, b)):
        slopes[:, :, column] = -u * ((spots @ tilt) / steep)[:, None]
    slopes[:, :, 8] = u / steep[:, None]
    cam_R_ee = setup.cam_T_base[:3, :3] @ base_T_ee[:, :3, :3]
    c, e = basis(setup.direction_ee)
    for column, turn in ((9, c), (10, e)):
        slopes[:, :, column] = np.einsum("nij,nj->ni", project, (cam_R_ee @ turn) * along[:, None])
    for column, axis in zip((11, 12), origin_axes(setup.direction_ee), strict=True):
        slopes[:, :, column] = np.einsum("nij,nj->ni", project, cam_R_ee[:, :, axis])
    return spots, slopes


def pose_slopes(setup: LaserSetup, base_T_ee: Array) -> Array:
    """Derivatives (n, 3, 6) of :func:`spots_on_plane` by a perturbation (position, then rotation; base axes) of each
    sample's own pose: what an arm's inaccuracy does to the spot, camera frame.
    """
    origin, u = laser_lines(setup, base_T_ee)
    steep = u @ setup.normal_cam
    steep = np.where(np.abs(steep) > 1e-9, steep, np.nan)
    along = (setup.distance_m - origin @ setup.normal_cam) / steep
    project = np.eye(3) - u[:, :, None] * setup.normal_cam / steep[:, None, None]
    cam_R_base = setup.cam_T_base[:3, :3]
    # The spot's lever about the end-effector's origin, base axes: laser's point and beam together.
    lever = base_T_ee[:, :3, :3] @ setup.point_ee_m + along[:, None] * (base_T_ee[:, :3, :3] @ setup.direction_ee)
    slopes = np.empty((len(base_T_ee), 3, 6))
    slopes[:, :, :3] = project @ cam_R_base
    slopes[:, :, 3:] = -project @ cam_R_base @ skew(lever)
    return slopes


def spots_on_rays(setup: LaserSetup, xy: Array) -> tuple[Array, Array]:
    """Camera ray and plane, equations (10) to (12): spots (n, 3) in the camera frame of ideal image points (n, 2), and
    their derivatives (n, 3, 2) by these; NaN where a ray doesn't meet the plane before the camera.
    """
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    n = setup.normal_cam
    steep = rays @ n
    depth = setup.distance_m / np.where(np.abs(steep) > 1e-9, steep, np.nan)
    depth = np.where(depth > 0.0, depth, np.nan)
    spots = depth[:, None] * rays
    slopes = depth[:, None, None] * (np.eye(3)[None, :, :2] - rays[:, :, None] * n[:2] / steep[:, None, None])
    return spots, slopes


def spots_between(setup: LaserSetup, base_T_ee: Array, xy: Array) -> tuple[Array, Array, Array]:
    """Laser line and camera ray, equations (13) and (14): the points of the rays (n, 3) that the lines come nearest to,
    the distances (n,) that are left between them (m), and the depths' derivatives (n, 2) by the image points; NaN where
    both are parallel.  No plane is needed: it may have moved.
    """
    origin, u = laser_lines(setup, base_T_ee)
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    # The depth z at which z ray is nearest to the line: (I - u uᵀ)(z ray - origin) has its least length.
    across = rays - u * np.einsum("ni,ni->n", rays, u)[:, None]
    size = np.einsum("ni,ni->n", across, across)
    size = np.where(size > 1e-12, size, np.nan)
    depth = np.einsum("ni,ni->n", across, origin) / size
    left = depth[:, None] * rays - origin
    left = left - u * np.einsum("ni,ni->n", left, u)[:, None]
    # d(depth) of d(xy): the quotient's derivative, the projection being its own square.
    flat = origin - u * np.einsum("ni,ni->n", origin, u)[:, None]
    slopes = (flat[:, :2] - 2.0 * depth[:, None] * across[:, :2]) / size[:, None]
    return depth[:, None] * rays, np.linalg.norm(left, axis=1), slopes
