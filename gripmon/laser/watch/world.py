"""Camera, plane and laser line, each in the frame in which it stands still by itself: what moves alone changes its own
parameters only.

A file's covariance has the plane in the camera's frame.  Here the plane is the base's, so that a camera that moves
leaves it where it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gripmon.calibrate.sighting import CalibrationError
from gripmon.laser.pointer.document import NAMES, LaserCalibration
from gripmon.laser.pointer.setup import LaserSetup, basis, origin_axes, pose_slopes, spots_on_plane
from gripmon.model.camera import Camera, make_camera
from gripmon.model.geometry import from_record, perturb, skew
from gripmon.model.records import Array

PARAMETERS = (
    "base_T_cam.x_m", "base_T_cam.y_m", "base_T_cam.z_m",
    "base_T_cam.rx_rad", "base_T_cam.ry_rad", "base_T_cam.rz_rad",
    "plane_base.tilt_a_rad", "plane_base.tilt_b_rad", "plane_base.distance_m",
    "laser.turn_a_rad", "laser.turn_b_rad", "laser.shift_a_m", "laser.shift_b_m",
)  # fmt: skip
"""What :meth:`World.moved` changes."""

COUNT = len(PARAMETERS)
CAMERA, PLANE, LASER = slice(0, 6), slice(6, 9), slice(9, 13)
LEAST_NOISE_PX = 0.02
"""Of spots, however well a calibration's own fitted."""


@dataclass(frozen=True, slots=True)
class World:
    """``base_T_cam`` (4, 4); ``lit`` the plane and the laser line as a set-up whose camera frame is the base."""

    base_T_cam: Array
    lit: LaserSetup

    def moved(self, change: Array) -> World:
        """Changed by (13,), in the order of :data:`PARAMETERS`, large ones too."""
        rest = np.concatenate([np.zeros(6), change[6:]])
        return World(perturb(self.base_T_cam, change[CAMERA]), self.lit.moved(rest))


@dataclass(frozen=True, slots=True)
class Foreseen:
    """A pulse's spot: ``spot_base_m`` (3,), ``uv_px`` (2,), derivatives ``rows`` (2, 13) of the latter by
    :data:`PARAMETERS` and ``arm_rows`` (2, 6) by a perturbation of ``base_T_ee``, base axes.
    """

    spot_base_m: Array
    uv_px: Array
    rows: Array
    arm_rows: Array

    @property
    def finite(self) -> bool:
        """False where the beam runs along the plane, or the spot is behind the camera or outside of its lens."""
        return bool(np.isfinite(self.uv_px).all() and np.isfinite(self.rows).all() and np.isfinite(self.arm_rows).all())


@dataclass(frozen=True, slots=True)
class Calibrated:
    """What a file says: the ``world``, ``covariance`` (13, 13) of :data:`PARAMETERS`, and the standard deviation of a
    spot's coordinate that its residuals show.
    """

    world: World
    camera: Camera
    covariance: Array
    sigma_px: float


def calibrated(calibration: LaserCalibration) -> Calibrated:
    """Raises :class:`CalibrationError` for numbers that make no set-up."""
    base_T_cam = from_record(calibration.base_T_cam)
    plane, laser = calibration.plane, calibration.laser
    normal, direction = np.array(plane.normal_base), np.array(laser.direction_ee)
    for name, vector in (("plane.normal_base", normal), ("laser.direction_ee", direction)):
        if not abs(float(np.linalg.norm(vector)) - 1.0) < 1e-3:
            raise CalibrationError(f"{name}: has length {np.linalg.norm(vector):.4g}; 1")
    world = World(
        base_T_cam, LaserSetup(np.eye(4), normal, plane.distance_base_m, np.array(laser.point_ee_m), direction)
    )
    if calibration.parameters != NAMES or len(calibration.covariance) != COUNT**2:
        raise CalibrationError(f"covariance: not that of {', '.join(NAMES)}; a file of gripmon calibrate laser")
    change = _to_base(base_T_cam, np.array(plane.normal_cam), normal)
    covariance = change @ np.array(calibration.covariance).reshape(COUNT, COUNT) @ change.T
    scale = np.sqrt(np.maximum(covariance.diagonal(), 1e-300))
    smallest = float(np.linalg.eigvalsh(covariance / np.outer(scale, scale))[0])
    if not (np.isfinite(covariance).all() and smallest > -1e-6):
        raise CalibrationError("covariance: is none (not positive definite); a file of gripmon calibrate laser")
    sigma_px = max(calibration.residuals.sigma_px, LEAST_NOISE_PX)
    return Calibrated(world, make_camera(calibration.camera), 0.5 * (covariance + covariance.T), sigma_px)


def _to_base(base_T_cam: Array, normal_cam: Array, normal_base: Array) -> Array:
    """(13, 13): derivatives of :data:`PARAMETERS` by a file's."""
    out = np.eye(COUNT)
    a, b = basis(normal_cam)
    # Of the normal in the base: turned with the camera, tilted in it.
    normal = np.zeros((3, COUNT))
    normal[:, 3:6] = -skew(normal_base)
    normal[:, 6], normal[:, 7] = base_T_cam[:3, :3] @ a, base_T_cam[:3, :3] @ b
    out[6:8] = np.stack(basis(normal_base)) @ normal
    out[8] = normal.T @ base_T_cam[:3, 3]
    out[8, :3] += normal_base
    out[8, 8] += 1.0
    return out


def foresee(world: World, camera: Camera, base_T_ee: Array) -> Foreseen:
    """The spot at a pose (4, 4) by beam and plane, equations (7) to (9); NaN where there is none."""
    pose = base_T_ee[None]
    spots, slopes = spots_on_plane(world.lit, pose)
    cam_R_base = world.base_T_cam[:3, :3].T
    lever = spots[0] - world.base_T_cam[:3, 3]
    uv_px, by_cam = camera.project_with_jacobian((cam_R_base @ lever)[None])
    by_base = by_cam[0] @ cam_R_base
    rows = by_base @ slopes[0]
    rows[:, :3] = -by_base
    rows[:, 3:6] = by_base @ skew(lever)
    return Foreseen(spots[0], uv_px[0], rows, by_base @ pose_slopes(world.lit, pose)[0])


def foresee_moved(calibrated: Calibrated, change: Array, base_T_ee: Array) -> Foreseen:
    """As :func:`foresee` of the world moved by ``change`` (13,), ``rows`` the derivatives by ``change`` where it is."""
    world = calibrated.world.moved(change)
    found = foresee(world, calibrated.camera, base_T_ee)
    return Foreseen(
        found.spot_base_m, found.uv_px, found.rows @ _chart(calibrated.world, world, change), found.arm_rows
    )


def _chart(origin: World, there: World, change: Array) -> Array:
    """(13, 13): what a small change more of ``change`` is as one of :data:`PARAMETERS` at the moved world."""
    out = np.eye(COUNT)
    out[3:6, 3:6] = _left_jacobian(change[3:6])
    for first, before, after in (
        (6, origin.lit.normal_cam, there.lit.normal_cam), (9, origin.lit.direction_ee, there.lit.direction_ee),
    ):  # fmt: skip
        old, new = np.stack(basis(before)), np.stack(basis(after))
        out[first : first + 2, first : first + 2] = new @ old.T / np.hypot(1.0, np.hypot(*change[first : first + 2]))
    return _with_axes(out, origin.lit.direction_ee, there.lit.direction_ee)


def _with_axes(chart: Array, before: Array, after: Array) -> Array:
    """The laser's point moves in the plane of two axes; after a large turn they may be others."""
    old, new = origin_axes(before), origin_axes(after)
    if old == new:
        return chart
    pierced = ({0, 1, 2} - set(new)).pop()
    for column, axis in zip((11, 12), old, strict=True):
        # A point may slide along the beam: what leaves the new plane comes back to it.
        shift = np.eye(3)[axis] - after / after[pierced] * (axis == pierced)
        chart[11:13, column] = shift[list(new)]
    return chart


def _left_jacobian(omega: Array) -> Array:
    """(3, 3): exp(omega + d) = exp(J d) exp(omega) for small d."""
    angle = float(np.linalg.norm(omega))
    turn = skew(omega)
    if angle < 1e-4:
        return np.eye(3) + 0.5 * turn
    first, second = (1.0 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    out: Array = np.eye(3) + first * turn + second * (turn @ turn)
    return out


def larger(a: Array, b: Array) -> Array:
    """The least covariance (k, k) that is nowhere below either of two; ``b`` positive definite."""
    root = np.linalg.cholesky(b)
    inverse = np.linalg.inv(root)
    values, axes = np.linalg.eigh(inverse @ a @ inverse.T)
    out: Array = root @ (axes * np.maximum(values, 1.0)) @ axes.T @ root.T
    return out
