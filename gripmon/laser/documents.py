"""The file of a laser calibration, and the set-up with its covariance that it describes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from gripmon.calibrate.sighting import CalibrationError
from gripmon.laser.setup import COUNT, PARAMETERS, LaserSetup, basis
from gripmon.model.camera import Camera, LensSettings, make_camera
from gripmon.model.geometry import from_record, skew, to_record, to_vector
from gripmon.model.provenance import Provenance
from gripmon.model.records import Array, Transform

Vector = tuple[float, float, float]
_Length = Annotated[float, Meta(ge=0.0)]

NAMES = (
    *PARAMETERS[:6], "plane.tilt_a_rad", "plane.tilt_b_rad", "plane.distance_m", *PARAMETERS[9:],
)  # fmt: skip
"""Rows of a file's covariance: the camera's pose (position, then rotation, base axes), the plane in the camera's frame
(tilts about the camera's centre), the laser line.
"""
LEAST_NOISE_PX = 0.02
"""Minimum noise of spots (px), however well a calibration's own fitted, and however much the arm's noise explains."""


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


def laser_document(
    setup: LaserSetup,
    covariance: Array,
    camera: LensSettings,
    residuals: LaserResiduals,
    warnings: tuple[str, ...],
    provenance: Provenance,
) -> LaserCalibration:
    """The contents of a file; ``covariance`` (13, 13) of :data:`~gripmon.laser.setup.PARAMETERS`."""
    to_file = np.linalg.inv(_to_base(setup.base_T_cam, setup.normal_cam))
    covariance = to_file @ covariance @ to_file.T
    sigmas = np.sqrt(covariance.diagonal())
    return LaserCalibration(
        camera=camera,
        base_T_cam=to_record(setup.base_T_cam),
        plane=Plane(
            normal_cam=to_vector(setup.normal_cam),
            distance_cam_m=setup.distance_cam_m,
            normal_base=to_vector(setup.normal_base),
            distance_base_m=setup.distance_base_m,
        ),
        laser=LaserLine(point_ee_m=to_vector(setup.point_ee_m), direction_ee=to_vector(setup.direction_ee)),
        parameters=NAMES,
        sigmas=dict(zip(NAMES, sigmas.tolist(), strict=True)),
        covariance=tuple(covariance.ravel().tolist()),
        residuals=residuals,
        warnings=warnings,
        provenance=provenance,
    )


@dataclass(frozen=True, slots=True)
class Calibrated:
    """The contents of a file: the ``setup``, ``covariance`` (13, 13) of its :data:`~gripmon.laser.setup.PARAMETERS`,
    and the standard deviation of a spot's coordinate according to the residuals.
    """

    setup: LaserSetup
    camera: Camera
    covariance: Array
    sigma_px: float


def calibrated(calibration: LaserCalibration) -> Calibrated:
    """From a file.  Raises :class:`CalibrationError` for numbers that make no set-up, ValueError for such a camera."""
    plane, laser = calibration.plane, calibration.laser
    for name, vector in (
        ("plane.normal_cam", plane.normal_cam), ("plane.normal_base", plane.normal_base),
        ("laser.direction_ee", laser.direction_ee),
    ):  # fmt: skip
        if not abs(float(np.linalg.norm(vector)) - 1.0) < 1e-3:
            raise CalibrationError(f"{name}: has length {np.linalg.norm(vector):.4g}; 1")
    setup = LaserSetup(
        from_record(calibration.base_T_cam),
        np.array(plane.normal_base),
        plane.distance_base_m,
        np.array(laser.point_ee_m),
        np.array(laser.direction_ee),
    )
    if calibration.parameters != NAMES or len(calibration.covariance) != COUNT**2:
        raise CalibrationError(f"covariance: not that of {', '.join(NAMES)}; a file of gripmon calibrate laser")
    change = _to_base(setup.base_T_cam, np.array(plane.normal_cam))
    covariance = change @ np.array(calibration.covariance).reshape(COUNT, COUNT) @ change.T
    scale = np.sqrt(np.maximum(covariance.diagonal(), 1e-300))
    if not (np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance / np.outer(scale, scale))[0] > -1e-6):
        raise CalibrationError("covariance: is none (not positive definite); a file of gripmon calibrate laser")
    sigma_px = max(calibration.residuals.sigma_px, LEAST_NOISE_PX)
    return Calibrated(setup, make_camera(calibration.camera), 0.5 * (covariance + covariance.T), sigma_px)


def _to_base(base_T_cam: Array, normal_cam: Array) -> Array:
    """(13, 13): derivatives of :data:`~gripmon.laser.setup.PARAMETERS` by a file's, whose plane is the camera's."""
    turn, centre = base_T_cam[:3, :3], base_T_cam[:3, 3]
    normal_base = turn @ normal_cam
    out = np.eye(COUNT)
    # The normal in the base turns with the camera, and tilts in the camera's frame.
    normal = np.zeros((3, COUNT))
    normal[:, 3:6] = -skew(normal_base)
    normal[:, 6:8] = turn @ np.stack(basis(normal_cam), axis=1)
    out[6:8] = np.stack(basis(normal_base)) @ normal
    out[8] = normal.T @ centre
    out[8, :3] += normal_base
    out[8, 8] += 1.0
    return out
