"""The set-up: a laser pointer on the end-effector, a plane that its spot falls on, and a fixed camera that sees the
spot.  Each part is given in the frame in which it is fixed, so that what moves changes its own parameters only.

The spot is where the laser's line meets the plane: laser-pointer method, equations (7) to (9).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gripmon.model.geometry import invert, perturb, skew
from gripmon.model.records import Array

PARAMETERS = (
    "base_T_cam.x_m", "base_T_cam.y_m", "base_T_cam.z_m",
    "base_T_cam.rx_rad", "base_T_cam.ry_rad", "base_T_cam.rz_rad",
    "plane_base.tilt_a_rad", "plane_base.tilt_b_rad", "plane_base.distance_m",
    "laser.turn_a_rad", "laser.turn_b_rad", "laser.shift_a_m", "laser.shift_b_m",
)  # fmt: skip
"""The parameters that :meth:`LaserSetup.moved` changes: camera (base axes), plane, laser line."""
COUNT = len(PARAMETERS)
CAMERA, PLANE, LASER = slice(0, 6), slice(6, 9), slice(9, 13)
_PARALLEL = 1e-9


@dataclass(frozen=True, slots=True)
class LaserSetup:
    """``base_T_cam`` (4, 4); the plane ``normal_base . p = distance_base_m`` with a unit normal (3,) away from the
    camera; the laser line through ``point_ee_m`` (3,) along the unit vector ``direction_ee`` (3,), end-effector frame.
    """

    base_T_cam: Array
    normal_base: Array
    distance_base_m: float
    point_ee_m: Array
    direction_ee: Array

    @classmethod
    def seen(
        cls, cam_T_base: Array, normal_cam: Array, distance_m: float, point_ee_m: Array, direction_ee: Array
    ) -> LaserSetup:
        """From the base's pose and the plane ``normal_cam . p = distance_m`` as the camera has them."""
        base_T_cam = invert(cam_T_base)
        normal_base = base_T_cam[:3, :3] @ normal_cam
        distance_base_m = float(distance_m + normal_base @ base_T_cam[:3, 3])
        return cls(base_T_cam, normal_base, distance_base_m, point_ee_m, direction_ee)

    @property
    def cam_T_base(self) -> Array:
        """(4, 4)."""
        return invert(self.base_T_cam)

    @property
    def normal_cam(self) -> Array:
        """The plane's normal (3,), camera axes."""
        out: Array = self.base_T_cam[:3, :3].T @ self.normal_base
        return out

    @property
    def distance_cam_m(self) -> float:
        """The plane's distance from the camera."""
        return self.distance_base_m - float(self.normal_base @ self.base_T_cam[:3, 3])

    def moved(self, change: Array) -> LaserSetup:
        """The set-up changed by (13,), in the order of :data:`PARAMETERS`, also by large amounts.  The laser's point
        stays in its plane, equation (6): see :func:`origin_axes`.
        """
        point = self.point_ee_m.copy()
        point[list(origin_axes(self.direction_ee))] += change[11:13]
        return LaserSetup(
            perturb(self.base_T_cam, change[CAMERA]),
            _tilted(self.normal_base, change[6:8]),
            self.distance_base_m + float(change[8]),
            point,
            _tilted(self.direction_ee, change[9:11]),
        )


def basis(direction: Array) -> tuple[Array, Array]:
    """Two unit vectors (3,) orthogonal to a unit vector and to each other, right-handed with it; locally continuous."""
    turn = skew(direction)  # because np.cross of single vectors is many times slower
    a = turn[:, int(np.argmin(np.abs(direction)))]
    a = a / np.linalg.norm(a)
    return a, turn @ a


def _tilted(direction: Array, change: Array) -> Array:
    a, b = basis(direction)
    out: Array = direction + change[0] * a + change[1] * b
    return out / np.linalg.norm(out)


def origin_axes(direction_ee: Array) -> tuple[int, int]:
    """The two axes of the end-effector that span the plane of the laser's point: of the three planes of equation (6),
    the one that the beam crosses most steeply.
    """
    pierced = int(np.argmax(np.abs(direction_ee)))
    return ((1, 2), (0, 2), (0, 1))[pierced]


def beams(setup: LaserSetup, base_T_ee: Array) -> tuple[Array, Array]:
    """Points and unit directions (n, 3), base frame, of the beam at end-effector poses (n, 4, 4)."""
    turn = base_T_ee[:, :3, :3]
    return turn @ setup.point_ee_m + base_T_ee[:, :3, 3], turn @ setup.direction_ee


def spots_on_plane(setup: LaserSetup, base_T_ee: Array) -> Array:
    """Beam and plane, equations (7) to (9): spots (n, 3), base frame; NaN where the beam runs along the plane."""
    points, u = beams(setup, base_T_ee)
    out: Array = points + _ways(setup, points, u)[:, None] * u
    return out


def in_camera(setup: LaserSetup, points_base: Array) -> Array:
    """Points (n, 3) of the base frame in the camera's."""
    out: Array = (points_base - setup.base_T_cam[:3, 3]) @ setup.base_T_cam[:3, :3]
    return out


def _ways(setup: LaserSetup, points: Array, directions: Array) -> Array:
    """Equation (8): how far along lines (n,) the plane is; NaN where they run along it."""
    steep = directions @ setup.normal_base
    steep = np.where(np.abs(steep) > _PARALLEL * np.linalg.norm(directions, axis=-1), steep, np.nan)
    out: Array = (setup.distance_base_m - points @ setup.normal_base) / steep
    return out


def spots_in_camera(setup: LaserSetup, base_T_ee: Array) -> tuple[Array, Array]:
    """:func:`spots_on_plane` in the camera frame (n, 3), with derivatives (n, 3, 13 + 6) by :data:`PARAMETERS`, then by
    a perturbation of each sample's own pose (position, rotation; base axes), which is the effect of the arm's errors.
    """
    n, centre, base_R_ee = setup.normal_base, setup.base_T_cam[:3, 3], base_T_ee[:, :3, :3]
    points, u = beams(setup, base_T_ee)
    along = _ways(setup, points, u)[:, None]
    spots = points + along * u
    by_distance = u / (u @ n)[:, None]
    # A change of the line moves the spot within the plane: the change's projection along the beam, G of equation (20).
    project = np.eye(3) - by_distance[:, :, None] * n
    slopes = np.empty((len(spots), 3, COUNT + 6))
    slopes[:, :, :3] = -np.eye(3)
    slopes[:, :, 3:6] = skew(spots - centre)
    for column, tilt in zip((6, 7), basis(n), strict=True):
        slopes[:, :, column] = -by_distance * (spots @ tilt)[:, None]
    slopes[:, :, 8] = by_distance
    for column, turn in zip((9, 10), basis(setup.direction_ee), strict=True):
        slopes[:, :, column] = _each(project, along * (base_R_ee @ turn))
    for column, axis in zip((11, 12), origin_axes(setup.direction_ee), strict=True):
        slopes[:, :, column] = _each(project, base_R_ee[:, :, axis])
    slopes[:, :, COUNT : COUNT + 3] = project
    slopes[:, :, COUNT + 3 :] = -project @ skew(spots - base_T_ee[:, :3, 3])
    return in_camera(setup, spots), setup.base_T_cam[:3, :3].T @ slopes


def _each(matrices: Array, vectors: Array) -> Array:
    out: Array = np.einsum("nij,nj->ni", matrices, vectors)
    return out


def spots_on_rays(setup: LaserSetup, xy: Array) -> Array:
    """Camera ray and plane, equations (10) to (12): spots (n, 3), base frame, of ideal image points (n, 2); NaN where a
    ray doesn't meet the plane before the camera.
    """
    centre = setup.base_T_cam[:3, 3]
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1) @ setup.base_T_cam[:3, :3].T
    depth = _ways(setup, centre, rays)
    out: Array = centre + np.where(depth > 0.0, depth, np.nan)[:, None] * rays
    return out


def nearest_points(setup: LaserSetup, base_T_ee: Array, xy: Array) -> tuple[Array, Array]:
    """Beam and camera ray, equations (13) and (14): the rays' points nearest to the beams, and the beams' nearest to
    the rays, (n, 3) each, base frame; NaN where both are parallel.  No plane is needed: it may have moved.
    """
    centre = setup.base_T_cam[:3, 3]
    points, u = beams(setup, base_T_ee)
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1) @ setup.base_T_cam[:3, :3].T
    # The gap between them is orthogonal to both.
    across = rays - u * np.einsum("ni,ni->n", rays, u)[:, None]
    square = np.einsum("ni,ni->n", across, across)
    square = np.where(square > _PARALLEL * np.einsum("ni,ni->n", rays, rays), square, np.nan)
    depth = np.einsum("ni,ni->n", across, points - centre) / square
    on_rays = centre + depth[:, None] * rays
    on_beams = points + u * np.einsum("ni,ni->n", on_rays - points, u)[:, None]
    return on_rays, on_beams
