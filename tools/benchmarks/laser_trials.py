"""Trials of ``tools/bench laser``: one data set each, by every method, with the error's bound."""

from __future__ import annotations

import time
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import f as fisher_f

from benchmarks import laser_printed
from benchmarks.laser_scenes import PAPER_LENS, REAL_LENS, LaserData, paper_setup, real_setup, sampled
from gripmon.calibrate import robot_world
from gripmon.calibrate.sighting import CalibrationError
from gripmon.laser import closed_form
from gripmon.laser.refinement import SpotProblem, refine
from gripmon.laser.setup import LaserSetup
from gripmon.model.geometry import invert, make_transform, perturbation_between

Array = NDArray[np.float64]

SKEW = 0.05
"""The paper's skew: taken out of the pixels, which ties the noise of u to that of v."""
_SKEWED = np.array([[1.0, -SKEW], [0.0, 1.0]])
_SKEWED_NOISE = _SKEWED @ _SKEWED.T
OBJECT_M = 0.025 * np.concatenate([np.zeros((1, 3)), *(np.outer([1.0, 2.0, 3.0], e) for e in np.eye(3))])
"""Ten points, three along each axis and the origin, 2.5 cm apart."""
EE_T_OBJECT = make_transform(
    Rotation.from_euler("ZYX", [-10.0, -20.0, -45.0], degrees=True).as_matrix(), np.array([0.050, -0.020, 0.070])
)
REFERENCE_METHODS = ("Dornaika-Horaud closed", "Dornaika-Horaud refined", "Dornaika-Horaud weighed")
_LEAST_NOISE_PX = 1e-9


@dataclass(frozen=True)
class Trial:
    """Relative errors (translation, rotation) of ``base_T_cam`` by method, None where it failed; the refined laser's
    squared errors (m², rad²) with their bound's, whether the truth lies in its 95 % region; seconds of the processor
    for start and refinement, and by the clock for both; wrong spots that were used, good ones that were not.
    """

    errors: dict[str, tuple[float, float] | None]
    squared: tuple[float, float] | None = None
    bound: tuple[float, float] | None = None
    covered: bool | None = None
    seconds: tuple[float, float] | None = None
    wall_s: float | None = None
    wrong_used: int = 0
    good_left: int = 0


def paper_trial(rng: np.random.Generator, orientations: int, noise_px: float, *, refined_only: bool = False) -> Trial:
    """The paper's simulation: the laser's methods and the reference's, each on as many samples; or the refined one
    alone, on the same data.
    """
    setup = paper_setup(rng)
    data = sampled(setup, rng, lens=PAPER_LENS, orientations=orientations)
    uv_px = data.uv_px + rng.normal(0.0, noise_px, data.uv_px.shape) @ _SKEWED.T
    none_wrong = np.zeros(len(uv_px), dtype=bool)
    trial = _laser(data, uv_px, noise_px, _SKEWED_NOISE, none_wrong, printed=not refined_only)
    if not refined_only:
        trial.errors.update(_reference(setup, rng, orientations, noise_px))
    return trial


def real_trial(rng: np.random.Generator, noise_px: float, wrong_share: float) -> Trial:
    """Like the paper's real set-up: nine orientations, ninety spots, of which a share lie 5 to 40 px off."""
    data = sampled(
        real_setup(rng), rng, lens=REAL_LENS, orientations=9, reach_m=(0.2, 0.5), tilt_deg=40.0, shift_m=0.06
    )
    uv_px = data.uv_px + rng.normal(0.0, noise_px, data.uv_px.shape)
    wrong = rng.permutation(len(uv_px)) < round(wrong_share * len(uv_px))
    angle, far = rng.uniform(0.0, 2.0 * np.pi, len(uv_px)), rng.uniform(5.0, 40.0, len(uv_px))
    uv_px[wrong] += (np.stack([np.cos(angle), np.sin(angle)], axis=1) * far[:, None])[wrong]
    return _laser(data, uv_px, noise_px, np.eye(2), wrong, printed=False)


def relative_errors(cam_T_base: Array, truth: Array) -> tuple[float, float]:
    """Of ``base_T_cam``, as the paper reckons them."""
    found, right = invert(cam_T_base), invert(truth)
    return (
        float(np.linalg.norm(found[:3, 3] - right[:3, 3]) / np.linalg.norm(right[:3, 3])),
        float(np.linalg.norm(found[:3, :3] - right[:3, :3]) / np.linalg.norm(right[:3, :3])),
    )


def _laser(
    data: LaserData, uv_px: Array, noise_px: float, noise_shape: Array, wrong: NDArray[np.bool_], *, printed: bool
) -> Trial:
    truth = data.truth.cam_T_base
    xy = data.camera.undistort(uv_px)
    errors: dict[str, tuple[float, float] | None] = {}
    if printed:
        errors["printed"] = _tried(lambda: laser_printed.solve(xy, data.base_T_ee).cam_T_base, truth)
        errors["common plane"] = _tried(lambda: closed_form.solve(xy, data.base_T_ee, robust=False).cam_T_base, truth)
    clock, begun = time.perf_counter(), time.process_time()
    problem = SpotProblem(data.camera, data.base_T_ee, uv_px, np.tile(noise_shape, (len(uv_px), 1, 1)))
    try:
        start = closed_form.solve(data.camera.undistort(uv_px), data.base_T_ee)
        half = time.process_time()
        found = refine(problem, start)
    except CalibrationError:
        return Trial({**errors, "refined": None})
    ended, wall_s = time.process_time(), time.perf_counter() - clock
    errors["refined"] = relative_errors(found.setup.cam_T_base, truth)
    xi = perturbation_between(found.setup.base_T_cam, invert(truth))
    size = float(xi @ np.linalg.solve(found.covariance[:6, :6], xi)) if noise_px else 0.0
    bound = _bound(problem, data.truth, noise_px, ~wrong)
    return Trial(
        errors,
        squared=(float(xi[:3] @ xi[:3]), float(xi[3:] @ xi[3:])),
        bound=(float(np.trace(bound[:3, :3])), float(np.trace(bound[3:, 3:]))),
        covered=size <= 6.0 * float(fisher_f.ppf(0.95, 6, found.degrees_of_freedom)) if noise_px else None,
        seconds=(half - begun, ended - half),
        wall_s=wall_s,
        wrong_used=int((found.used & wrong).sum()),
        good_left=int((~found.used & ~wrong).sum()),
    )


def _bound(problem: SpotProblem, truth: LaserSetup, noise_px: float, good: NDArray[np.bool_]) -> Array:
    """Cramér-Rao's bound (6, 6) of ``base_T_cam``'s error, from the good spots at the truth."""
    rows = problem.linearised(problem.start(truth))[0][good].reshape(-1, 13)
    size = np.linalg.norm(rows, axis=0)
    covariance = np.linalg.inv((rows / size).T @ (rows / size)) / np.outer(size, size)
    out: Array = max(noise_px, _LEAST_NOISE_PX) ** 2 * covariance[:6, :6]
    return out


def _reference(
    setup: LaserSetup, rng: np.random.Generator, poses: int, noise_px: float
) -> dict[str, tuple[float, float] | None]:
    """Dornaika and Horaud's method on this many poses of the ten points, in the camera's view."""
    truth = setup.cam_T_base
    matrix = np.array([[543.0, 0.0, 320.0], [0.0, 543.0, 240.0], [0.0, 0.0, 1.0]])
    first = Rotation.random(rng=rng).as_matrix()
    arm, seen, covariances = [], [], []
    while len(arm) < poses:
        depth = rng.uniform(0.3, 0.5)
        place = np.array([*(rng.uniform(-0.4, 0.4, 2) * depth), depth])
        axis = rng.normal(size=3)
        turn = Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.radians(rng.uniform(-15.0, 15.0))).as_matrix()
        cam_T_object = make_transform(turn @ first, place)
        points = OBJECT_M @ cam_T_object[:3, :3].T + place
        uv = points[:, :2] / points[:, 2:] * 543.0 + [320.0, 240.0]
        if (uv < 5.0).any() or (uv > [634.0, 474.0]).any():
            continue
        noisy = uv + rng.normal(0.0, noise_px, uv.shape) @ _SKEWED.T
        pose, covariance = _pose_of(noisy, matrix)
        arm.append(invert(truth) @ cam_T_object @ invert(EE_T_OBJECT))
        seen.append(pose)
        covariances.append(covariance)
    cam_T_target, base_T_ee = np.stack(seen), np.stack(arm)
    try:
        start = robot_world.solve(cam_T_target, base_T_ee)
    except CalibrationError:
        return dict.fromkeys(REFERENCE_METHODS)
    return {
        REFERENCE_METHODS[0]: relative_errors(start[0], truth),
        REFERENCE_METHODS[1]: _tried(lambda: robot_world.refine(cam_T_target, base_T_ee, start).cam_T_base, truth),
        REFERENCE_METHODS[2]: _tried(
            lambda: robot_world.refine(cam_T_target, base_T_ee, start, np.stack(covariances)).cam_T_base, truth
        ),
    }


def _pose_of(uv_px: Array, matrix: Array) -> tuple[Array, Array]:
    """``cam_T_object`` with the least distance in the image, and its covariance for noise of one pixel."""
    _, turn, shift = cv2.solvePnP(OBJECT_M, uv_px, matrix, None, flags=cv2.SOLVEPNP_SQPNP)
    turn, shift = cv2.solvePnPRefineLM(OBJECT_M, uv_px, matrix, None, turn, shift)
    pose = make_transform(cv2.Rodrigues(turn)[0], shift.ravel())
    turned = OBJECT_M @ pose[:3, :3].T
    x, y, z = (turned + pose[:3, 3]).T
    by_point = np.zeros((len(x), 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = 543.0 / z
    by_point[:, 0, 2], by_point[:, 1, 2] = -543.0 * x / z**2, -543.0 * y / z**2
    skews = np.cross(np.eye(3)[None], turned[:, None, :])
    rows = np.concatenate([by_point, np.einsum("nij,nkj->nik", by_point, skews)], axis=2)
    rows = np.linalg.inv(np.linalg.cholesky(_SKEWED_NOISE)) @ rows
    flat = rows.reshape(-1, 6)
    return pose, np.linalg.inv(flat.T @ flat)


def _tried(solve, truth: Array) -> tuple[float, float] | None:  # type: ignore[no-untyped-def]
    try:
        return relative_errors(solve(), truth)
    except CalibrationError:
        return None
