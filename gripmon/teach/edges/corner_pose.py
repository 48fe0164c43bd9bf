"""``cam_T_grip`` from the corners of one image, for who has no calibration of hand and eye yet.

It is the pose of on-line recalibration, with everything in its covariance that one image can't average out: the
corners, the jaw opening, the camera's calibration, and how exactly the gripper was made.  A plate under the fingertips
(``gripmon calibrate plane``) tells the distance far better than the fingertips' own small extent does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from gripmon.calibrate.bundle import LensModel, lens_vector, model_of, parameter_names
from gripmon.judge.recalibrate import RecalibrationRefused, recalibrate, refusal, rivals, solutions
from gripmon.model.camera import Camera
from gripmon.model.geometry import perturbation_between
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array
from gripmon.teach.edges.snapping import Snapped

BY_HAND_PX = 1.0
"""Standard deviation of a corner that a person set by hand where it wasn't measured, or against what was."""

MADE_TO_M = 2e-5
"""So exactly a fingertip's corners lie where the gripper file has them (each coordinate, standard deviation)."""

_STEP = 0.3  # central differences reach so many standard deviations


class PoseRefused(ValueError):
    """These corners give no pose; the text is ``what is wrong; what would be right``."""


@dataclass(frozen=True, slots=True)
class CameraError:
    """How uncertain a camera is: ``covariance`` (n, n) of its ``parameters``, named as in its calibration's file."""

    parameters: tuple[str, ...]
    covariance: Array


@dataclass(frozen=True, slots=True)
class CornerPose:
    """``cam_T_grip`` (4, 4), the covariance (6, 6) of its error, the ``corners`` it rests on, and the weighted root
    mean square of their residuals, 1 where their covariances hold.  ``rival``: another pose fits them as well.  Without
    ``corners`` it rests on the edges' joint fit: too few corners are seen for a pose of their own.
    """

    cam_T_grip: Array
    covariance: Array
    corners: tuple[str, ...]
    weighted_rms: float
    rival: bool


def pose_from_corners(
    camera: Camera,
    gripper: Gripper,
    snapped: Snapped,
    by_hand_px: Mapping[str, Array],
    camera_error: CameraError | None = None,
) -> CornerPose:
    """Pose of the gripper by the corners that were measured, or set by hand.  Raises :class:`PoseRefused`."""
    found = snapped.measurement
    if found is None:
        raise PoseRefused(f"no pose: {snapped.refused}")
    measured = [i for i, c in enumerate(snapped.corners) if c.uv_px is not None and c.name not in by_hand_px]
    hand = [i for i, c in enumerate(snapped.corners) if c.name in by_hand_px]
    for name in (snapped.corners[i].name for i in hand):
        if not np.isfinite(camera.undistort(np.reshape(by_hand_px[name], (1, 2)))).all():
            raise PoseRefused(f"{name} was put where the lens shows nothing; inside the lens's view, or not by hand")
    every = [*measured, *hand]
    taken = np.isin(np.arange(len(snapped.corners)), measured)
    uv_px = np.array([snapped.corners[i].uv_px for i in measured] + [by_hand_px[snapped.corners[i].name] for i in hand])
    joint: Array = found.corners.joint_covariance_xy(taken)
    of_edges: Array = np.zeros((6, 6))
    by_edges = refusal(gripper.points_grip_m(snapped.jaw_opening_m)[gripper.corner_points[every]]) is not None
    if by_edges:
        # All corners where the edges' joint fit has them: its covariance is the measurement's.
        every = [i for i, c in enumerate(snapped.corners) if np.isfinite(c.model_px).all()]
        uv_px = np.array([snapped.corners[i].model_px for i in every]).reshape(-1, 2)
        joint, of_edges = np.zeros((2 * len(every),) * 2), found.covariance[:6, :6]
    covariance_xy = _covariance(camera, uv_px, joint, found.cam_T_grip[2, 3])
    given = _Given(camera, snapped.jaw_opening_m)

    def solve(given: _Given) -> tuple[Array, Array, float]:
        points_m = gripper.points_grip_m(given.jaw_opening_m)[gripper.corner_points[every]]
        pose = recalibrate(points_m, given.camera.undistort(uv_px), covariance_xy, found.cam_T_grip)
        return pose.cam_T_grip, pose.covariance, pose.weighted_rms

    try:
        cam_T_grip, of_corners, weighted_rms = solve(given)
        slopes = [_slope(solve, way) for way in _ways(given, gripper, snapped.jaw_sigma_m, camera_error)]
    except (RecalibrationRefused, np.linalg.LinAlgError) as refused:
        raise PoseRefused(f"{refused}; more corners, or a calibration with a plate") from None
    # What contradicts itself is at least as wrong as it looks.
    covariance = of_corners * max(weighted_rms, 1.0) ** 2 + sum((np.outer(s, s) for s in slopes), of_edges)
    points_m = gripper.points_grip_m(given.jaw_opening_m)[gripper.corner_points[every]]
    alike = rivals(solutions(points_m, camera.undistort(uv_px), covariance_xy), len(every))
    names = () if by_edges else tuple(snapped.corners[i].name for i in every)
    return CornerPose(cam_T_grip, 0.5 * (covariance + covariance.T), names, weighted_rms, len(alike) > 1)


@dataclass(frozen=True, slots=True)
class _Given:
    camera: Camera
    jaw_opening_m: float | None


_Way = Callable[[float], _Given]


def _covariance(camera: Camera, uv_px: Array, measured: Array, depth_m: float) -> Array:
    """(2n, 2n) of ideal coordinates: measured corners together, those by hand alone, and how the gripper was made."""
    count = len(uv_px)
    out = np.zeros((2 * count, 2 * count))
    out[: len(measured), : len(measured)] = measured
    _, slopes = camera.undistort_with_jacobian(uv_px)
    for i in range(len(measured) // 2, count):
        block = slice(2 * i, 2 * i + 2)
        out[block, block] = BY_HAND_PX**2 * slopes[i] @ slopes[i].T
    return np.asarray(out + (MADE_TO_M / depth_m) ** 2 * np.eye(2 * count))


def _ways(given: _Given, gripper: Gripper, jaw_sigma_m: float | None, error: CameraError | None) -> list[_Way]:
    """What else may be wrong, by independent standard deviations."""
    ways: list[_Way] = []
    if jaw_sigma_m and given.jaw_opening_m is not None:
        opening_m, low_m, high_m = given.jaw_opening_m, gripper.jaw_min_m, gripper.jaw_max_m
        sigma_m = jaw_sigma_m
        ways.append(lambda s: _Given(given.camera, min(max(opening_m + s * sigma_m, low_m), high_m)))
    if error is not None and error.parameters:
        lens = given.camera.settings
        model = LensModel(model_of(lens), lens.width_px, lens.height_px)
        vector = lens_vector(lens)
        places = [parameter_names(model.name).index(name) for name in error.parameters]
        for root in np.linalg.cholesky(error.covariance).T:
            step = np.zeros(len(vector))
            step[places] = root
            if "fx_px" in error.parameters and "fy_px" not in error.parameters:
                step[1] = step[0] * vector[1] / vector[0]
            ways.append(lambda s, step=step: _Given(model.camera(vector + s * step), given.jaw_opening_m))  # type: ignore[misc]
    return ways


def _slope(solve: Callable[[_Given], tuple[Array, Array, float]], way: _Way) -> Array:
    """(6,) what the pose does for one standard deviation."""
    up, down = solve(way(_STEP))[0], solve(way(-_STEP))[0]
    return perturbation_between(down, up) / (2.0 * _STEP)
