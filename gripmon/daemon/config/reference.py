"""What the section ``reference`` means: its pose, its covariance, and what is wrong with them.  Keys in faults are the
section's own, since a file may be the section.
"""

from __future__ import annotations

import hashlib
import math

import numpy as np

from gripmon.calibrate.hand_eye_formats import BODY_AXES, FARTHEST_M, lies_along_x, meant
from gripmon.daemon.config.settings import ReferenceSettings, TransformSettings
from gripmon.daemon.config.typed import Fault, SettingsError
from gripmon.model.geometry import UNIT_TOLERANCE, make_transform, rotation_from_xyzw, to_record
from gripmon.model.records import Array, ReferenceRecord, Transform, to_json

NEAREST_M = 0.005
"""Least depth of the TCP in front of the camera: below it, another unit was meant."""

IN_FRONT = (
    "z > 0 in front of the camera: cam_T_grip maps gripper coordinates to camera coordinates (the inverse was given?)"
)

ALONG_X = f"along the camera's x: {BODY_AXES}"
OPTICAL = "the pose in the camera's optical frame, e.g. camera_color_optical_frame"


def pose_in(settings: TransformSettings, key: str = "cam_T_grip") -> Array:
    """A transform (4, 4).  Raises :class:`SettingsError` for a rotation that is none."""
    x, y, z, w = settings.rotation_xyzw
    length = math.sqrt(x * x + y * y + z * z + w * w)
    if abs(length - 1.0) > UNIT_TOLERANCE:
        right = "a unit quaternion x, y, z, w (Euler angles or another order were given?)"
        raise SettingsError(Fault(f"{key}.rotation_xyzw", f"has length {length:.4g}", right))
    return make_transform(rotation_from_xyzw((x, y, z, w)), np.array(settings.translation_m))


def reference_transform(settings: ReferenceSettings) -> Array:
    """``cam_T_grip`` (4, 4), of a gripper in front of the camera.  Raises :class:`SettingsError` if it is invalid."""
    cam_T_grip = pose_in(settings.cam_T_grip)
    translation_m = cam_T_grip[:3, 3]
    distance_m, depth_m = float(np.linalg.norm(translation_m)), float(translation_m[2])
    wrong, right = "", "metres, e.g. [0.0, 0.0, 0.12]"
    if distance_m > FARTHEST_M:
        wrong, right = f"puts the TCP {distance_m:g} m from the camera", f"{right} ({meant(distance_m)})"
    elif depth_m < NEAREST_M and lies_along_x(translation_m):
        wrong, right = f"puts the TCP {ALONG_X}", OPTICAL
    elif depth_m <= 0.0:
        wrong, right = f"puts the TCP behind the camera (z = {depth_m:g} m)", IN_FRONT
    elif depth_m < NEAREST_M:
        wrong = f"puts the TCP {1e3 * depth_m:g} mm in front of the camera"
    if wrong:
        raise SettingsError(Fault("cam_T_grip.translation_m", wrong, right))
    return cam_T_grip


ASSUMED_SIGMA_M, ASSUMED_SIGMA_RAD = 0.001, 0.01
"""Standard deviations of a reference that states none, per axis: hand/eye calibrations of laboratories are good to 1 to
3 mm.
"""


def covariance_of(settings: ReferenceSettings) -> tuple[float, ...]:
    """The reference's covariance, row by row.  Raises :class:`SettingsError` if it is invalid."""
    if settings.covariance is None:
        sigma_m, sigma_rad = settings.position_sigma_m, settings.rotation_sigma_rad
        sigma_m, sigma_rad = ASSUMED_SIGMA_M if sigma_m is None else sigma_m, sigma_rad or ASSUMED_SIGMA_RAD
        variances = [sigma_m**2] * 3 + [sigma_rad**2] * 3
        return tuple(np.diag(variances).ravel().tolist())
    matrix = np.array(settings.covariance).reshape(6, 6)
    scale, wrong = np.sqrt(np.abs(np.diag(matrix))), ""
    if not (scale > 0.0).all():
        wrong = "has a variance of zero"
    else:
        normalised = matrix / np.outer(scale, scale)
        if np.abs(normalised - normalised.T).max() > 1e-6:
            wrong = "is not symmetric"
        elif np.linalg.eigvalsh(normalised).min() <= 0.0:
            wrong = "is not positive definite"
    if wrong:
        right = "a symmetric 6x6 matrix with positive eigenvalues, position (m²) then rotation (rad²)"
        raise SettingsError(Fault("covariance", wrong, right))
    return settings.covariance


def configured(
    cam_T_grip: Transform, covariance: tuple[float, ...], name: str | None = None, *, with_gripper: bool = False
) -> ReferenceRecord:
    """A configuration's reference; without a name it is named by its transform."""
    name = name or f"config-{hashlib.sha256(to_json(cam_T_grip)).hexdigest()[:8]}"
    return ReferenceRecord(name, 0, 0, "configuration", cam_T_grip, covariance, with_gripper=with_gripper)


def reference_of(settings: ReferenceSettings) -> ReferenceRecord:
    """The reference of a configuration's section.  Raises :class:`SettingsError` if it is invalid."""
    cam_T_grip, covariance = to_record(reference_transform(settings)), covariance_of(settings)
    return configured(cam_T_grip, covariance, settings.id, with_gripper=settings.with_gripper)
