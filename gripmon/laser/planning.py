"""Planning: which poses a calibration needs next, and which motions of the camera the monitor can detect."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from gripmon.calibrate.sighting import CalibrationError
from gripmon.laser.beliefs import KINDS, LEAST_PULSES, SCALES, assumed
from gripmon.laser.judgement import UNIT, SpotWatchSettings, on_plane
from gripmon.laser.refinement import Refined
from gripmon.laser.setup import PARAMETERS, LaserSetup, spots_on_plane
from gripmon.laser.world import CAMERA, COUNT, Calibrated, Prediction, larger, predict, spread_px, visible
from gripmon.model.camera import make_camera
from gripmon.model.geometry import inverse_jacobian, invert, make_transform
from gripmon.model.records import Array

CANDIDATES = 4000
STEEPEST_TILT_RAD = np.radians(55.0)
"""Largest tilt of the beam against the plane's normal: beyond it the spot is smeared."""
NEAREST_M = 0.08
"""Minimum distance from the laser to the plane (m)."""
BORDER = 0.05
"""Margin of planned spots at each side of the image, as a fraction of its size: the plan has errors of its own."""
SEED = 0


LEAST_REACH_M = 0.15
"""Minimum distance from the base's origin (m): nearer, the arm's own body is in the way."""


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
    poses = candidates(setup, refined, reach_m, np.random.default_rng(seed))
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


def candidates(setup: LaserSetup, refined: Refined, reach_m: float, rng: np.random.Generator) -> Array:
    """Random poses (m, 4, 4) within reach, on the camera's side of the plane, whose spot the camera sees."""
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
    good = (depth > 0.0) & (reached <= reach_m) & (reached >= LEAST_REACH_M) & (above > 0.5 * NEAREST_M)
    good &= np.isfinite(hands).all(axis=1)
    if not good.any():
        raise CalibrationError(
            f"within {reach_m:g} m of its base the arm has no pose whose spot the camera would see; a longer reach"
        )
    turns = (base_R_cam * cam_R_ee).as_matrix()
    return np.stack([make_transform(turns[k], places[k]) for k in np.flatnonzero(good)])


def _weights(setup: LaserSetup) -> Array:
    """(13, 13) weights of a covariance of :data:`PARAMETERS`: mean square error (m²) of a point at plane distance."""
    out = np.zeros((len(PARAMETERS), len(PARAMETERS)))
    change = inverse_jacobian(setup.cam_T_base)
    size = np.diag([1.0] * 3 + [setup.distance_m**2] * 3)
    out[:6, :6] = change.T @ size @ change
    return out


def _sigmas(setup: LaserSetup, covariance: Array) -> tuple[float, float]:
    change = inverse_jacobian(setup.cam_T_base)
    pose = change @ covariance[:6, :6] @ change.T
    return float(np.sqrt(np.trace(pose[:3, :3]))), float(np.sqrt(np.trace(pose[3:, 3:])))


PULSES = (LEAST_PULSES, 10, 30, 100)
POSES, ASSUMED_TILT_RAD, ASSUMED_DISTANCE_M = 9, math.radians(30.0), 0.3
"""Assumption where no poses are given: number of spots, on a grid over the image; tilt of the beam against the plane's
normal, each time in another direction; distance of the laser from its spot.
"""
_BORDER = 0.2


@dataclass(frozen=True, slots=True)
class Forecast:
    """Expected detectability.  ``sigma_px`` and ``sigma_m`` (k,): standard deviation of each pose's predicted spot in
    its worst direction, in the image and on the plane.  ``sizes`` (n, 6): motions of ``base_T_cam`` along its
    position's and rotation's axes (base; m, rad) that are detected on average ``pulses`` (n,) after they happened.
    ``weakest`` (6,): the least detectable direction, with its size after the most pulses, m and rad.
    """

    sigma_px: Array
    sigma_m: Array
    pulses: tuple[int, ...]
    sizes: Array
    weakest: Array


def forecast(calibrated: Calibrated, settings: SpotWatchSettings, poses: Sequence[Array]) -> Forecast:
    """Forecast for pulses from these poses (4, 4) in turn, using only those from which a spot is seen.  Raises
    :class:`CalibrationError` if there is none.
    """
    arm = settings.arm_covariance
    seen = [predict(calibrated.world, calibrated.camera, pose) for pose in poses]
    seen = [found for found in seen if visible(calibrated, found, arm) is None and _inside(calibrated, found)]
    if not seen:
        raise CalibrationError("from none of the poses does the camera see the spot; poses of this set-up")
    noise = calibrated.sigma_px**2 * np.eye(2)
    spreads = [spread_px(calibrated, found, arm) + noise for found in seen]
    sigma_px = np.array([math.sqrt(float(np.linalg.eigvalsh(spread)[-1])) for spread in spreads])
    sigma_m = np.array([_metres(calibrated, found, spread) for found, spread in zip(seen, spreads, strict=True)])
    gains = [_Gain(calibrated, settings, seen, pulses) for pulses in PULSES]
    sizes = np.array([[gain.size(np.eye(6)[axis]) for axis in range(6)] for gain in gains])
    _, axes = np.linalg.eigh(gains[-1].information * np.outer(UNIT, UNIT))
    weakest = axes[:, 0] * UNIT
    return Forecast(sigma_px, sigma_m, PULSES, sizes, weakest * gains[-1].size(weakest))


def assumed_poses(calibrated: Calibrated) -> tuple[Array, ...]:
    """Poses ``base_T_ee``, up to :data:`POSES`, whose spots lie on a grid over the image."""
    camera, world = calibrated.camera, calibrated.world
    grid = np.linspace(_BORDER, 1.0 - _BORDER, 3)
    towards = world.lit.normal_cam if world.lit.normal_cam @ world.base_T_cam[:3, 2] > 0.0 else -world.lit.normal_cam
    upright = Rotation.align_vectors([towards], [[0.0, 0.0, 1.0]])[0]
    to_axis = Rotation.align_vectors([[0.0, 0.0, 1.0]], [world.lit.direction_ee])[0]
    out = []
    for k, (row, column) in enumerate((row, column) for row in grid for column in grid):
        spot = on_plane(world, calibrated, np.array([column * camera.width_px, row * camera.height_px]))
        if not np.isfinite(spot).all():
            continue
        around = 2.0 * math.pi * k / 9.0
        lean = Rotation.from_rotvec(ASSUMED_TILT_RAD * np.array([math.cos(around), math.sin(around), 0.0]))
        turn = (upright * lean * to_axis).as_matrix()
        laser = spot - ASSUMED_DISTANCE_M * (turn @ world.lit.direction_ee)
        out.append(make_transform(turn, laser - turn @ world.lit.point_ee_m))
    return tuple(out)


def _inside(calibrated: Calibrated, found: Prediction) -> bool:
    size = np.array([calibrated.camera.width_px, calibrated.camera.height_px])
    return bool((found.uv_px >= -0.5).all() and (found.uv_px <= size - 0.5).all())


def _metres(calibrated: Calibrated, found: Prediction, spread: Array) -> float:
    values, axes = np.linalg.eigh(spread)
    largest = 0.0
    for value, axis in zip(values, axes.T, strict=True):
        step = on_plane(calibrated.world, calibrated, found.uv_px + axis) - found.spot_base_m
        largest = max(largest, math.sqrt(value) * float(np.linalg.norm(step)))
    return largest


class _Gain:
    """The average growth of a motion's log likelihood ratio over a number of pulses.

    The innovations r of all pulses are normal with covariance V (noise, calibration, offsets of each pose) if nothing
    moved, and with V + M after a motion of the assumed size: the log likelihood ratio is (rᵀ (V⁻¹ - (V+M)⁻¹) r -
    ln|V+M| + ln|V|) / 2.
    """

    def __init__(self, calibrated: Calibrated, settings: SpotWatchSettings, seen: Sequence[Prediction], pulses: int):
        index = np.arange(pulses) % len(seen)
        rows = np.stack([found.rows for found in seen])[index].reshape(-1, COUNT)
        common = rows @ calibrated.covariance @ rows.T
        noise = calibrated.sigma_px**2 * np.eye(2)
        for place in np.unique(index):
            by_arm = seen[place].arm_rows @ settings.arm_covariance @ seen[place].arm_rows.T
            same = np.repeat(index == place, 2)
            common += np.kron(np.ones((pulses, pulses)), larger(by_arm, noise)) * np.outer(same, same)
        common += np.kron(np.eye(pulses), noise)
        moved = rows[:, CAMERA]
        still = np.linalg.inv(common)
        limit = math.log(1000.0 / settings.false_alarms_per_1000_pulses)
        self._terms = []
        for scale in range(len(SCALES)):
            total = common + moved @ assumed(0, scale)[CAMERA, CAMERA] @ moved.T
            difference = still - np.linalg.inv(total)
            grown = float(np.linalg.slogdet(total)[1] - np.linalg.slogdet(common)[1])
            needed = 2.0 * (limit - math.log(KINDS[0][2] / len(SCALES))) + grown - float((difference * common).sum())
            self._terms.append((max(needed, 0.0), moved.T @ difference @ moved))
        self.information = moved.T @ still @ moved

    def size(self, direction: Array) -> float:
        """The factor by which a direction (6,) must be scaled for the motion to be detected."""
        return min(math.sqrt(needed / max(float(direction @ w @ direction), 1e-300)) for needed, w in self._terms)
