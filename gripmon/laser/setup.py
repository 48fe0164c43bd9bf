"""The set-up: a laser pointer on the end-effector, a plane that its spot falls on, and a fixed camera that sees the
spot; also the file of its calibration.

The spot is where the laser's line meets the plane, laser-pointer method, equations (7) to (9).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from gripmon.model.camera import LensSettings
from gripmon.model.geometry import from_record, invert, perturb, skew
from gripmon.model.provenance import Provenance
from gripmon.model.records import Array, Transform

PARAMETERS = (
    "cam_T_base.x_m", "cam_T_base.y_m", "cam_T_base.z_m", "cam_T_base.rx_rad", "cam_T_base.ry_rad", "cam_T_base.rz_rad",
    "plane.tilt_a_rad", "plane.tilt_b_rad", "plane.distance_m",
    "laser.turn_a_rad", "laser.turn_b_rad", "laser.shift_a_m", "laser.shift_b_m",
)  # fmt: skip
"""The parameters that :meth:`LaserSetup.moved` changes: pose perturbation as elsewhere, then plane and laser line."""


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
        """The set-up changed by small amounts (13,), in the order of :data:`PARAMETERS`.  The laser's point stays in
        its plane: of the three planes spanned by end-effector axes, the one that the beam crosses most steeply.
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
    """Two unit vectors (3,) orthogonal to a unit vector and to each other, right-handed with it; locally continuous."""
    helper = np.eye(3)[int(np.argmin(np.abs(direction)))]
    turn = skew(direction)  # because np.cross of single vectors is many times slower
    a = turn @ helper
    a /= np.linalg.norm(a)
    return a, turn @ a


def origin_axes(direction_ee: Array) -> tuple[int, int]:
    """The two axes of the end-effector that span the plane of the laser's point: of the three such planes, the one that
    the beam crosses most steeply.
    """
    pierced = int(np.argmax(np.abs(direction_ee)))
    return ((1, 2), (0, 2), (0, 1))[pierced]


def laser_lines(setup: LaserSetup, base_T_ee: Array) -> tuple[Array, Array]:
    """Points and unit directions (n, 3), camera frame, of the beam at end-effector poses (n, 4, 4)."""
    rotation, shift = setup.cam_T_base[:3, :3], setup.cam_T_base[:3, 3]
    points = (base_T_ee[:, :3, :3] @ setup.point_ee_m + base_T_ee[:, :3, 3]) @ rotation.T + shift
    return points, (base_T_ee[:, :3, :3] @ setup.direction_ee) @ rotation.T


def spots_on_plane(setup: LaserSetup, base_T_ee: Array) -> tuple[Array, Array]:
    """Intersections of laser line and plane, equations (7) to (9): spots (n, 3) in the camera frame, and their
    derivatives (n, 3, 13) by :data:`PARAMETERS`; NaN where the beam runs along the plane.
    """
    origin, u = laser_lines(setup, base_T_ee)
    n = setup.normal_cam
    steep = u @ n
    steep = np.where(np.abs(steep) > 1e-9, steep, np.nan)
    along = (setup.distance_m - origin @ n) / steep
    spots = origin + along[:, None] * u
    # A change of the line moves the spot within the plane: project the change onto it along the beam.
    project = np.eye(3) - u[:, :, None] * n / steep[:, None, None]
    slopes = np.zeros((len(spots), 3, len(PARAMETERS)))
    slopes[:, :, :3] = project
    # Rotating the base rotates the beam's origin and direction: the spot's lever arm starts at the origin of the base.
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
    sample's own pose: the effect of the arm's errors on the spot, camera frame.
    """
    origin, u = laser_lines(setup, base_T_ee)
    steep = u @ setup.normal_cam
    steep = np.where(np.abs(steep) > 1e-9, steep, np.nan)
    along = (setup.distance_m - origin @ setup.normal_cam) / steep
    project = np.eye(3) - u[:, :, None] * setup.normal_cam / steep[:, None, None]
    cam_R_base = setup.cam_T_base[:3, :3]
    # The spot's lever arm about the end-effector's origin, base axes: laser's point and beam together.
    lever = base_T_ee[:, :3, :3] @ setup.point_ee_m + along[:, None] * (base_T_ee[:, :3, :3] @ setup.direction_ee)
    slopes = np.empty((len(base_T_ee), 3, 6))
    slopes[:, :, :3] = project @ cam_R_base
    slopes[:, :, 3:] = -project @ cam_R_base @ skew(lever)
    return slopes


Vector = tuple[float, float, float]
_Length = Annotated[float, Meta(ge=0.0)]

NAMES = (
    "base_T_cam.x_m", "base_T_cam.y_m", "base_T_cam.z_m",
    "base_T_cam.rx_rad", "base_T_cam.ry_rad", "base_T_cam.rz_rad",
    *PARAMETERS[6:],
)  # fmt: skip
"""Rows of a file's covariance: the camera's pose (position, then rotation, base axes), plane, laser line."""


class Plane(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``normal . p = distance`` in the camera frame and in the base's; normals point away from the camera."""

    normal_cam: Vector
    distance_cam_m: float
    normal_base: Vector
    distance_base_m: float


class LaserLine(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A point of the beam and its unit direction, end-effector frame."""

    point_ee_m: Vector
    direction_ee: Vector


class LaserResiduals(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How well the spots fit."""

    rms_px: Annotated[_Length, Meta(description="root mean square of the used residuals, u and v each (px)")]
    sigma_px: Annotated[_Length, Meta(description="the spots' noise that they show, each axis (px)")]
    spots: Annotated[int, Meta(ge=1)]
    used: Annotated[int, Meta(ge=1)]
    orientations: Annotated[int, Meta(ge=1)]
    degrees_of_freedom: Annotated[int, Meta(ge=1)]
    outliers: Annotated[tuple[str, ...], Meta(description="samples that were left out")] = ()


class LaserCalibration(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="schema",
    tag="gripmon.laser_calibration/1",
):  # fmt: skip
    """A laser calibration: ``base_T_cam``, plane and laser line; ``covariance`` (n·n, row by row) of the n
    ``parameters``, ``sigmas`` the roots of its diagonal.  ``camera`` is the refined one if the lens was refined.
    """

    camera: LensSettings
    base_T_cam: Transform
    plane: Plane
    laser: LaserLine
    parameters: tuple[str, ...]
    sigmas: dict[str, float]
    covariance: tuple[float, ...]
    residuals: LaserResiduals
    warnings: tuple[str, ...] = ()
    provenance: Provenance


def setup_of(calibration: LaserCalibration) -> LaserSetup:
    """The set-up that a file describes."""
    return LaserSetup(
        invert(from_record(calibration.base_T_cam)),
        np.array(calibration.plane.normal_cam),
        calibration.plane.distance_cam_m,
        np.array(calibration.laser.point_ee_m),
        np.array(calibration.laser.direction_ee),
    )
