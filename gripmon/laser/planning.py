"""Which poses a calibration needs next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from gripmon.calibrate.sighting import CalibrationError
from gripmon.laser.refinement import Refined
from gripmon.laser.setup import CAMERA, COUNT, LaserSetup, spots_in_camera, spots_on_rays
from gripmon.model.camera import Camera, make_camera
from gripmon.model.records import Array

CANDIDATES = 4000
STEEPEST_TILT_RAD = np.radians(55.0)
"""Largest tilt of the beam against the plane's normal: beyond it the spot is smeared."""
NEAREST_M = 0.08
"""Minimum distance from the laser to the plane (m)."""
BORDER = 0.05
"""Margin of planned spots at each side of the image, as a fraction of its size: the plan has errors of its own."""
LEAST_REACH_M = 0.15
"""Minimum distance from the base's origin (m): nearer, the arm's own body is in the way."""
SEED = 0


@dataclass(frozen=True, slots=True)
class Plan:
    """Planned poses: ``base_T_ee`` (k, 4, 4), the most useful first; ``uv_px`` (k, 2): expected spots; ``sigmas`` (k +
    1, 2): standard deviation of the camera's position (m) and rotation (rad), root of the sum over the axes, now and
    after each pose.
    """

    base_T_ee: Array
    uv_px: Array
    sigmas: Array


def plan(refined: Refined, reach_m: float, count: int, *, seed: int = SEED) -> Plan:
    """Greedy plan for an arm that reaches ``reach_m`` from the base's origin: each step adds the pose that reduces the
    most the error, in the base, of a point at the plane's distance that the camera sees.

    Raises :class:`CalibrationError` if the arm reaches no pose whose spot the camera sees.
    """
    setup, camera = refined.setup, make_camera(refined.camera)
    poses = candidates(setup, camera, reach_m, np.random.default_rng(seed))
    spots, slopes = spots_in_camera(setup, poses)
    uv_px, by_point = camera.project_with_jacobian(spots)
    rows = by_point @ slopes[:, :, :COUNT]
    covariance = refined.covariance.copy()
    weights = np.zeros((COUNT, COUNT))
    weights[CAMERA, CAMERA] = np.diag([1.0] * 3 + [setup.distance_cam_m**2] * 3)
    chosen: list[int] = []
    sigmas = [_sigmas(covariance)]
    for _ in range(count):
        spread = rows @ covariance  # (m, 2, 13)
        noise = np.linalg.inv(spread @ rows.transpose(0, 2, 1) + refined.scale**2 * np.eye(2))
        gain = np.einsum("mij,mik,mkl,jl->m", spread, noise, spread, weights)
        gain[chosen] = -np.inf
        best = int(gain.argmax())
        chosen.append(best)
        covariance = covariance - spread[best].T @ noise[best] @ spread[best]
        sigmas.append(_sigmas(covariance))
    return Plan(poses[chosen], uv_px[chosen], np.array(sigmas))


def _sigmas(covariance: Array) -> tuple[float, float]:
    return float(np.sqrt(np.trace(covariance[:3, :3]))), float(np.sqrt(np.trace(covariance[3:6, 3:6])))


def candidates(setup: LaserSetup, camera: Camera, reach_m: float, rng: np.random.Generator) -> Array:
    """Random poses (m, 4, 4) within reach, on the camera's side of the plane, whose spot the camera sees."""
    uv_px = rng.uniform(BORDER, 1.0 - BORDER, (CANDIDATES, 2)) * [camera.width_px, camera.height_px]
    tilt = STEEPEST_TILT_RAD * np.sqrt(rng.uniform(size=CANDIDATES))
    around, roll = rng.uniform(-np.pi, np.pi, (2, CANDIDATES))
    far = rng.uniform(NEAREST_M, max(2.0 * NEAREST_M, 0.8 * setup.distance_cam_m), CANDIDATES)
    upright = Rotation.align_vectors([setup.normal_base], [[0.0, 0.0, 1.0]])[0]
    lean = Rotation.from_rotvec(tilt[:, None] * np.stack([np.cos(around), np.sin(around), 0.0 * around], axis=1))
    to_axis = Rotation.align_vectors([[0.0, 0.0, 1.0]], [setup.direction_ee])[0]
    base_R_ee = upright * lean * Rotation.from_rotvec(np.outer(roll, [0.0, 0.0, 1.0])) * to_axis
    spots = spots_on_rays(setup, camera.undistort(uv_px))
    places = spots - far[:, None] * base_R_ee.apply(setup.direction_ee) - base_R_ee.apply(setup.point_ee_m)
    poses = np.tile(np.eye(4), (CANDIDATES, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = base_R_ee.as_matrix(), places
    reached = np.linalg.norm(places, axis=1)
    above = setup.distance_base_m - places @ setup.normal_base
    good = (reached <= reach_m) & (reached >= LEAST_REACH_M) & (above > 0.5 * NEAREST_M)
    if not good.any():
        raise CalibrationError(
            f"within {reach_m:g} m of its base the arm has no pose whose spot the camera would see; a longer reach"
        )
    return poses[good]
