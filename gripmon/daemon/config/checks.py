"""Checks that need more than one key: does this camera, calibrated like this, see this gripper?"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.daemon.config.settings import ReferenceSettings
from gripmon.daemon.config.typed import Fault
from gripmon.model.camera import Camera
from gripmon.model.geometry import invert, make_transform, rotation_from_xyzw
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array
from gripmon.monitor import MonitorSettings

NEAREST_M = 0.005
FARTHEST_M = 5.0
FEWEST_CORNERS_IN_VIEW = 3
_UNIT_TOLERANCE = 0.01

_IN_FRONT = (
    "z > 0 in front of the camera: cam_T_grip maps gripper coordinates to camera coordinates (the inverse was given?)"
)


@dataclass(frozen=True, slots=True)
class View:
    """What the calibration predicts at one jaw opening: arrays over the gripper's corners and edges.

    ``corners_px`` (c, 2) is NaN where the lens maps nothing; ``in_image``, ``visible`` (c,); ``edges_visible`` (e,).
    """

    corners_cam_m: Array
    corners_px: Array
    in_image: NDArray[np.bool_]
    visible: NDArray[np.bool_]
    edges_visible: NDArray[np.bool_]


def reference_transform(settings: ReferenceSettings) -> Array | Fault:
    """``cam_T_grip`` (4, 4) of a reference, or what is wrong with it by itself."""
    x, y, z, w = settings.cam_T_grip.rotation_xyzw
    length = math.sqrt(x * x + y * y + z * z + w * w)
    key = "reference.cam_T_grip.rotation_xyzw"
    if abs(length - 1.0) > _UNIT_TOLERANCE:
        return Fault(
            key, f"has length {length:.4g}", "a unit quaternion x, y, z, w (Euler angles or another order were given?)"
        )
    translation_m = np.array(settings.cam_T_grip.translation_m)
    key = "reference.cam_T_grip.translation_m"
    distance_m = float(np.linalg.norm(translation_m))
    if distance_m > FARTHEST_M:
        return Fault(
            key,
            f"puts the TCP {distance_m:g} m from the camera",
            f"metres, e.g. [0.0, 0.0, 0.12] ({_as_millimetres(distance_m)})",
        )
    if translation_m[2] <= 0.0:
        return Fault(key, f"puts the TCP behind the camera (z = {translation_m[2]:g} m)", _IN_FRONT)
    if translation_m[2] < NEAREST_M:
        return Fault(
            key, f"puts the TCP {1e3 * translation_m[2]:g} mm before the camera", "metres, e.g. [0.0, 0.0, 0.12]"
        )
    return make_transform(rotation_from_xyzw((x, y, z, w)), translation_m)


def covariance_of(settings: ReferenceSettings) -> tuple[float, ...] | Fault:
    """The reference's covariance, row by row, or what is wrong with it."""
    if settings.covariance is None:
        variances = [settings.position_sigma_m**2] * 3 + [settings.rotation_sigma_rad**2] * 3
        return tuple(np.diag(variances).ravel().tolist())
    matrix = np.array(settings.covariance).reshape(6, 6)
    scale = np.sqrt(np.abs(np.diag(matrix)))
    key, right = (
        "reference.covariance",
        "a symmetric 6x6 matrix with positive eigenvalues, position (m²) then rotation (rad²)",
    )
    if not (scale > 0.0).all():
        return Fault(key, "has a variance of zero", right)
    normalised = matrix / np.outer(scale, scale)
    if np.abs(normalised - normalised.T).max() > 1e-6:
        return Fault(key, "is not symmetric", right)
    if np.linalg.eigvalsh(normalised).min() <= 0.0:
        return Fault(key, "is not positive definite", right)
    return settings.covariance


def monitor_fault(settings: MonitorSettings) -> Fault | None:
    """A setting of the monitor that would have no effect."""
    if settings.measurement != "corners" and settings.update_corners != "all":
        return Fault(
            "monitor.update_corners",
            f"is {settings.update_corners}, but without effect while monitor.measurement is {settings.measurement}",
            "monitor.measurement: corners, or update_corners: all",
        )
    return None


def predict_view(camera: Camera, gripper: Gripper, cam_T_grip: Array, jaw_opening_m: float | None) -> View:
    """Where the calibration expects the gripper's corners in the image."""
    points_grip_m = gripper.points_grip_m(jaw_opening_m)
    points_cam_m = points_grip_m @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3]
    corners_cam_m = points_cam_m[gripper.corner_points]
    corners_px = camera.project(corners_cam_m)
    last_px = np.array([camera.width_px - 1.0, camera.height_px - 1.0])
    in_image: NDArray[np.bool_] = np.all((corners_px >= 0.0) & (corners_px <= last_px), axis=1)
    eye_grip_m = invert(cam_T_grip)[:3, 3]
    return View(
        corners_cam_m,
        corners_px,
        in_image,
        gripper.corners_visible(points_grip_m, eye_grip_m) & in_image,
        gripper.edge_view(points_grip_m, eye_grip_m).visible,
    )


def view_fault(view: View, gripper: Gripper, camera: Camera) -> Fault | None:
    """Why this calibration can't see this gripper, None if it can."""
    key = "reference.cam_T_grip"
    depths_m = view.corners_cam_m[:, 2]
    if (depths_m <= 0.0).all():
        return Fault(key, "puts all corners of the gripper behind the camera", _IN_FRONT)
    if (depths_m <= 0.0).any():
        name = gripper.corner_ids[int(depths_m.argmin())]
        return Fault(key, f"puts corner {name} behind the camera (z = {depths_m.min():.4g} m)", _IN_FRONT)
    if not view.in_image.any():
        u, v = np.nanmedian(view.corners_px, axis=0) if np.isfinite(view.corners_px).any() else (math.nan, math.nan)
        where = f"around ({u:.0f}, {v:.0f}) px" if math.isfinite(u) else "beyond what the lens maps"
        return Fault(
            key,
            f"puts all corners outside of the image, {where}",
            f"fingertips in {camera.width_px} x {camera.height_px} px (x right, y down, z forward; x, y, z, w)",
        )
    seen = int(view.visible.sum())
    if seen < FEWEST_CORNERS_IN_VIEW:
        names = ", ".join(c for c, v in zip(gripper.corner_ids, view.visible, strict=True) if v) or "none"
        return Fault(
            key,
            f"shows {seen} corners ({names})",
            f"a calibration that shows at least {FEWEST_CORNERS_IN_VIEW} corners that no face hides",
        )
    return None


def _as_millimetres(distance_m: float) -> str:
    return f"{distance_m:g} mm were meant?" if distance_m < 1000.0 * FARTHEST_M else "another unit was meant?"
