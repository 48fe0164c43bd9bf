"""The file of a laser calibration: camera, plane and laser line with what is known of their errors."""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from gripmon.laser.pointer.refinement import Refined
from gripmon.laser.pointer.setup import PARAMETERS, LaserSetup
from gripmon.model.camera import LensSettings
from gripmon.model.geometry import from_record, invert, skew, to_record
from gripmon.model.provenance import Provenance
from gripmon.model.records import Array, Transform

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
    """``base_T_cam``, plane and laser line; ``covariance`` (n·n, row by row) of the n ``parameters``, ``sigmas`` the
    roots of its diagonal.  ``camera`` is the refined one where the lens was refined.
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


def pose_jacobian(cam_T_base: Array) -> Array:
    """How a perturbation of ``cam_T_base`` (camera axes) perturbs ``base_T_cam`` (base axes), (6, 6)."""
    turn = cam_T_base[:3, :3].T
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = -turn
    out[:3, 3:] = -turn @ skew(cam_T_base[:3, 3])
    return out


def base_covariance(refined: Refined) -> Array:
    """(13, 13) of :data:`NAMES`."""
    change = np.eye(len(NAMES))
    change[:6, :6] = pose_jacobian(refined.setup.cam_T_base)
    out: Array = change @ refined.covariance @ change.T
    return out


def document(
    refined: Refined, names: tuple[str, ...], orientations: int, warnings: tuple[str, ...], provenance: Provenance
) -> LaserCalibration:
    """What is written of a result."""
    setup, covariance = refined.setup, base_covariance(refined)
    base_T_cam = invert(setup.cam_T_base)
    normal_base = base_T_cam[:3, :3] @ setup.normal_cam
    sigmas = np.sqrt(covariance.diagonal())
    return LaserCalibration(
        camera=refined.camera,
        base_T_cam=to_record(base_T_cam),
        plane=Plane(
            normal_cam=_vector(setup.normal_cam),
            distance_cam_m=setup.distance_m,
            normal_base=_vector(normal_base),
            distance_base_m=setup.distance_m + float(normal_base @ base_T_cam[:3, 3]),
        ),
        laser=LaserLine(point_ee_m=_vector(setup.point_ee_m), direction_ee=_vector(setup.direction_ee)),
        parameters=NAMES,
        sigmas=dict(zip(NAMES, sigmas.tolist(), strict=True)),
        covariance=tuple(covariance.ravel().tolist()),
        residuals=LaserResiduals(
            rms_px=refined.rms_px,
            sigma_px=refined.scale_px,
            spots=len(names),
            used=int(refined.used.sum()),
            orientations=orientations,
            degrees_of_freedom=refined.degrees_of_freedom,
            outliers=tuple(name for name, used in zip(names, refined.used, strict=True) if not used),
        ),
        warnings=warnings,
        provenance=provenance,
    )


def setup_of(calibration: LaserCalibration) -> LaserSetup:
    """The set-up that a file describes."""
    return LaserSetup(
        invert(from_record(calibration.base_T_cam)),
        np.array(calibration.plane.normal_cam),
        calibration.plane.distance_cam_m,
        np.array(calibration.laser.point_ee_m),
        np.array(calibration.laser.direction_ee),
    )


def _vector(values: Array) -> Vector:
    x, y, z = values.tolist()
    return x, y, z
