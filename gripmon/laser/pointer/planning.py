"""Which poses to take next: those that shrink a laser calibration's covariance most while the spot stays in view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from gripmon.calibrate.sighting import CalibrationError
from gripmon.laser.pointer.document import pose_jacobian
from gripmon.laser.pointer.refinement import Refined
from gripmon.laser.pointer.setup import PARAMETERS, LaserSetup, spots_on_plane
from gripmon.model.camera import make_camera
from gripmon.model.geometry import invert, make_transform
from gripmon.model.records import Array

CANDIDATES = 4000
STEEPEST_TILT_RAD = np.radians(55.0)
"""Of the beam against the plane's normal: flatter ones smear the spot."""
NEAREST_M = 0.08
"""Of the laser to the plane."""
BORDER = 0.05
"""Part of the image, at each side, that planned spots keep clear of: the plan's own errors move them."""
SEED = 0


@dataclass(frozen=True, slots=True)
class Arm:
    """How far the end-effector reaches from the base's origin (m)."""

    reach_m: float
    least_m: float = 0.15


@dataclass(frozen=True, slots=True)
class Plan:
    """``base_T_ee`` (k, 4, 4) in the order in which they help; ``uv_px`` (k, 2) where their spots are expected;
    ``sigmas`` (k + 1, 2): standard deviation of the camera's position (m) and rotation (rad), root of the sum over the
    axes, now and after each of them.
    """

    base_T_ee: Array
    uv_px: Array
    sigmas: Array


def plan(refined: Refined, arm: Arm, count: int, *, seed: int = SEED) -> Plan:
    """Greedy: each time the pose after which a point on the plane, seen by the camera, is known best in the base.

    Raises :class:`CalibrationError` where the arm reaches no pose whose spot the camera sees.
    """
    setup, camera = refined.setup, make_camera(refined.camera)
    poses = candidates(setup, refined, arm, np.random.default_rng(seed))
    spots, slopes = spots_on_plane(setup, poses)
    uv_px, by_point = camera.project_with_jacobian(spots)
    rows = by_point @ slopes
    covariance = refined.covariance.copy()
    weights = _weights(setup)
    chosen: list[int] = []
    sigmas = [_sigmas(setup, covariance)]
    for _ in range(count):
        spread = rows @ covariance  # (m, 2, 13)
        noise = np.linalg.inv(spread @ rows.transpose(0, 2, 1) + refined.scale**2 * np.eye(2))
        gain = np.einsum("mij,mik,mkl,jl->m", spread, noise, spread, weights)
        gain[chosen] = -np.inf
        best = int(gain.argmax())
        chosen.append(best)
        covariance = covariance - spread[best].T @ noise[best] @ spread[best]
        sigmas.append(_sigmas(setup, covariance))
    return Plan(poses[chosen], uv_px[chosen], np.array(sigmas))


def candidates(setup: LaserSetup, refined: Refined, arm: Arm, rng: np.random.Generator) -> Array:
    """Poses (m, 4, 4) within reach, on the camera's side of the plane, whose spot the camera sees."""
    camera = make_camera(refined.camera)
    size = np.array([camera.width_px, camera.height_px])
    xy = camera.undistort(rng.uniform(BORDER, 1.0 - BORDER, (CANDIDATES, 2)) * size)
    rays = np.concatenate([xy, np.ones((CANDIDATES, 1))], axis=1)
    depth = setup.distance_m / (rays @ setup.normal_cam)
    spots = rays * depth[:, None]
    tilt = STEEPEST_TILT_RAD * np.sqrt(rng.uniform(size=CANDIDATES))
    around = rng.uniform(0.0, 2.0 * np.pi, CANDIDATES)
    lean = Rotation.from_rotvec(
        tilt[:, None] * np.stack([np.cos(around), np.sin(around), np.zeros(CANDIDATES)], axis=1)
    )
    upright = Rotation.align_vectors([setup.normal_cam], [[0.0, 0.0, 1.0]])[0]
    beams = (upright * lean).apply([0.0, 0.0, 1.0])
    to_axis = Rotation.align_vectors([[0.0, 0.0, 1.0]], [setup.direction_ee])[0]
    roll = Rotation.from_rotvec(np.outer(rng.uniform(-np.pi, np.pi, CANDIDATES), [0.0, 0.0, 1.0]))
    cam_R_ee = upright * lean * roll * to_axis
    far = rng.uniform(NEAREST_M, max(2.0 * NEAREST_M, 0.8 * setup.distance_m), CANDIDATES)
    lasers = spots - far[:, None] * beams
    hands = lasers - cam_R_ee.apply(setup.point_ee_m)
    base_T_cam = invert(setup.cam_T_base)
    base_R_cam = Rotation.from_matrix(base_T_cam[:3, :3])
    places = base_R_cam.apply(hands) + base_T_cam[:3, 3]
    reached = np.linalg.norm(places, axis=1)
    above = setup.distance_m - hands @ setup.normal_cam
    good = (depth > 0.0) & (reached <= arm.reach_m) & (reached >= arm.least_m) & (above > 0.5 * NEAREST_M)
    good &= np.isfinite(hands).all(axis=1)
    if not good.any():
        raise CalibrationError(
            f"within {arm.reach_m:g} m of its base the arm has no pose whose spot the camera would see; a longer reach"
        )
    turns = (base_R_cam * cam_R_ee).as_matrix()
    return np.stack([make_transform(turns[k], places[k]) for k in np.flatnonzero(good)])


def _weights(setup: LaserSetup) -> Array:
    """(13, 13): mean square error (m²) of a point at the plane's distance, from a covariance of :data:`PARAMETERS`."""
    out = np.zeros((len(PARAMETERS), len(PARAMETERS)))
    change = pose_jacobian(setup.cam_T_base)
    size = np.diag([1.0] * 3 + [setup.distance_m**2] * 3)
    out[:6, :6] = change.T @ size @ change
    return out


def _sigmas(setup: LaserSetup, covariance: Array) -> tuple[float, float]:
    change = pose_jacobian(setup.cam_T_base)
    pose = change @ covariance[:6, :6] @ change.T
    return float(np.sqrt(np.trace(pose[:3, :3]))), float(np.sqrt(np.trace(pose[3:, 3:])))
