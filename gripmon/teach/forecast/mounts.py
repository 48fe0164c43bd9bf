"""Camera mounts by numbers that somebody with a drill can set: distance, tilt, side, roll."""

from __future__ import annotations

import math
from typing import NamedTuple

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from gripmon.model.camera import BrownConradyLens, Camera, FisheyeLens, LensSettings, PaperLens, make_camera
from gripmon.model.geometry import make_transform
from gripmon.model.records import Array

_UPRIGHT = 1e-6


class Mount(NamedTuple):
    """Where a camera is against the gripper.

    ``distance_m`` from the camera's centre to the TCP.  ``tilt_rad`` (0 to pi) between the camera's optical axis and
    the gripper's z axis: 0 looks along the fingers.  ``side_rad``: on which side of the gripper the camera sits,
    counted about the gripper's z axis: 0 at -y, +pi/2 at +x; without tilt it has no meaning and is 0.  ``roll_rad``
    about the optical axis: by how much the picture is turned clockwise.

    The rotation is ``cam_R_grip = Rz(roll) Rx(tilt) Rz(-side)``.
    """

    distance_m: float
    tilt_rad: float
    side_rad: float
    roll_rad: float

    @classmethod
    def of(cls, cam_T_grip: Array) -> Mount:
        """The mount that a pose (4, 4) is; what it leaves out is where in the image the TCP shows."""
        rotation = cam_T_grip[:3, :3]
        tilt = math.atan2(math.hypot(rotation[2, 0], rotation[2, 1]), rotation[2, 2])
        if math.sin(tilt) < _UPRIGHT:
            side, roll = 0.0, math.atan2(rotation[1, 0], rotation[0, 0])
        else:
            roll, tilt, turn = Rotation.from_matrix(rotation).as_euler("ZXZ")
            side = -turn
        return cls(float(np.linalg.norm(cam_T_grip[:3, 3])), float(tilt), float(side), float(roll))

    def cam_T_grip(self, towards: Array) -> Array:
        """The pose (4, 4) with the TCP in the direction ``towards`` (3,) of the camera frame."""
        rotation = Rotation.from_euler("ZXZ", [self.roll_rad, self.tilt_rad, -self.side_rad]).as_matrix()
        return make_transform(rotation, self.distance_m * towards / np.linalg.norm(towards))


def towards(camera: Camera, uv_px: tuple[float, float]) -> Array:
    """Direction (3,) in the camera frame of an image point.  ValueError where the lens maps nothing."""
    xy = camera.undistort(np.array([uv_px], dtype=float))[0]
    if not np.isfinite(xy).all():
        raise ValueError(f"({uv_px[0]:g}, {uv_px[1]:g}) px: the lens maps nothing there; a point of the image")
    direction = np.array([xy[0], xy[1], 1.0])
    return np.asarray(direction / np.linalg.norm(direction))


def with_focal(camera: Camera, focal_px: float) -> Camera:
    """The same sensor behind a lens of another focal length, without distortion: that of a lens nobody has calibrated
    isn't known.  (A fisheye stays one: its ideal form has all coefficients zero.)  At the focal length that the camera
    has it is the calibrated lens.  ValueError for a focal length that can't be meant.
    """
    settings = camera.settings
    if math.isclose(focal_px, settings.fx_px, rel_tol=1e-9):
        return camera
    changes: dict[str, object] = {"fx_px": focal_px, "fy_px": focal_px * settings.fy_px / settings.fx_px}
    match settings:
        case PaperLens():
            changes["kappa_per_px2"] = 0.0
        case BrownConradyLens() | FisheyeLens():
            changes["coefficients"] = (0.0, 0.0, 0.0, 0.0)
    other: LensSettings = msgspec.structs.replace(settings, **changes)
    return make_camera(other)


def field_of_view_rad(camera: Camera) -> float:
    """The angle that the image's middle row spans, with the lens's distortion; NaN where the lens ends before."""
    row = 0.5 * (camera.height_px - 1.0)
    ends = camera.undistort(np.array([[0.0, row], [camera.width_px - 1.0, row]]))
    left, right = np.column_stack([ends, np.ones(2)])
    return math.atan2(float(np.linalg.norm(np.cross(left, right))), float(left @ right))
