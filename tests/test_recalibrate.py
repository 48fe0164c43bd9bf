"""Recalibration against ``cv2.solvePnP``, by sampling, and where it has to refuse or to choose."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.box_models import random_rotation
from support.simulated import nominal_cam_T_grip

from gripmon.judge.recalibrate import Recalibration, RecalibrationRefused, recalibrate, rivals, solutions

FOCAL_PX = 962.0
PLANE_GRIP_M = np.array(
    [[-0.017, -0.008, 0.0], [0.017, -0.008, 0.0], [0.017, 0.008, 0.0], [-0.017, 0.008, 0.0], [0.027, -0.008, 0.0]]
)
GENERAL_GRIP_M = np.vstack([PLANE_GRIP_M[:4], [[-0.02, 0.0, -0.03], [0.02, 0.01, -0.02], [0.0, -0.012, -0.01]]])


def image(points_grip_m: np.ndarray, cam_T_grip: np.ndarray) -> np.ndarray:
    points = points_grip_m @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3]
    return points[:, :2] / points[:, 2:]


def sigma_xy(count: int, sigma_px: float = 0.1) -> np.ndarray:
    return np.tile(np.eye(2) * (sigma_px / FOCAL_PX) ** 2, (count, 1, 1))


def random_pose(rng: np.random.Generator) -> np.ndarray:
    """Near the nominal one, turned by some ten degrees."""
    pose = nominal_cam_T_grip(tcp_m=(0.0, 0.0, 0.115))
    pose[:3, :3] = Rotation.from_rotvec(rng.normal(scale=0.15, size=3)).as_matrix() @ pose[:3, :3]
    pose[:3, 3] += rng.normal(scale=0.006, size=3)
    return pose


def error_of(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """(rho, omega) from what was found to the truth, by SciPy."""
    turn = Rotation.from_matrix(true[:3, :3] @ found[:3, :3].T).as_rotvec()
    return np.concatenate([true[:3, 3] - found[:3, 3], turn])


def solve_pnp(points_grip_m: np.ndarray, xy: np.ndarray, start: np.ndarray) -> np.ndarray:
    """OpenCV's iterative solver from a start, run to its end."""
    turn, shift = cv2.Rodrigues(start[:3, :3])[0], start[:3, 3:].copy()
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 200, 1e-15)
    turn, shift = cv2.solvePnPRefineLM(points_grip_m, xy, np.eye(3), None, turn, shift, criteria)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
    return pose


SETS = [PLANE_GRIP_M[:4], PLANE_GRIP_M[[0, 1, 3, 4]], PLANE_GRIP_M, GENERAL_GRIP_M[:6], GENERAL_GRIP_M]
NAMES = ["4 coplanar", "4 of which 3 on a line", "5 coplanar", "6 general", "7 general"]


@pytest.mark.parametrize("points_grip_m", SETS, ids=NAMES)
def test_exact_corners_give_the_exact_pose_whatever_was_expected(points_grip_m: np.ndarray):
    rng = np.random.default_rng(1)
    for _ in range(15):
        true = random_pose(rng)
        xy = image(points_grip_m, true)
        found = recalibrate(points_grip_m, xy, sigma_xy(len(xy)), nominal_cam_T_grip())
        np.testing.assert_allclose(error_of(found.cam_T_grip, true), 0.0, atol=1e-9)
        assert found.weighted_rms < 1e-4
        _, turns, shifts, misses = cv2.solvePnPGeneric(points_grip_m, xy, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP)
        best = int(np.argmin(misses))
        turn, shift = turns[best], shifts[best]
        np.testing.assert_allclose(found.cam_T_grip[:3, 3], shift.ravel(), atol=1e-6)
        np.testing.assert_allclose(found.cam_T_grip[:3, :3], cv2.Rodrigues(turn)[0], atol=1e-5)


@pytest.mark.parametrize("points_grip_m", SETS, ids=NAMES)
def test_noisy_corners_give_opencvs_optimum(points_grip_m: np.ndarray):
    """With equal weights both minimise the same sum of squares."""
    rng = np.random.default_rng(2)
    for _ in range(15):
        true = random_pose(rng)
        xy = image(points_grip_m, true) + rng.normal(scale=0.1 / FOCAL_PX, size=(len(points_grip_m), 2))
        found = recalibrate(points_grip_m, xy, sigma_xy(len(xy)), true)
        theirs = solve_pnp(points_grip_m, xy, true)
        np.testing.assert_allclose(error_of(found.cam_T_grip, theirs), 0.0, atol=2e-7)
        assert np.abs(error_of(found.cam_T_grip, true)).max() > 1e-6, "the noise does move the pose"


def test_a_plane_may_lie_anywhere_in_the_gripper_frame():
    rng = np.random.default_rng(3)
    for _ in range(10):
        grip_T_own = random_rotation(rng)
        points_grip_m = PLANE_GRIP_M @ grip_T_own.T + rng.normal(scale=0.01, size=3)
        true = random_pose(rng)
        true[:3, :3] = true[:3, :3] @ grip_T_own.T
        found = recalibrate(points_grip_m, image(points_grip_m, true), sigma_xy(5), true)
        np.testing.assert_allclose(error_of(found.cam_T_grip, true), 0.0, atol=1e-9)


@pytest.mark.parametrize("points_grip_m", [PLANE_GRIP_M, GENERAL_GRIP_M], ids=["coplanar", "general"])
def test_covariance_is_the_spread_of_the_errors(points_grip_m: np.ndarray):
    rng = np.random.default_rng(4)
    count, samples, true = len(points_grip_m), 700, nominal_cam_T_grip()
    axes = rng.normal(size=(count, 2, 2)) * (0.03 / FOCAL_PX)
    covariance_xy = axes @ axes.transpose(0, 2, 1) + np.eye(2) * (0.01 / FOCAL_PX) ** 2
    factor = np.linalg.cholesky(covariance_xy)
    exact = image(points_grip_m, true)
    errors, nees, squares = np.empty((samples, 6)), np.empty(samples), np.empty(samples)
    for k in range(samples):
        noise = np.einsum("nij,nj->ni", factor, rng.normal(size=(count, 2)))
        found = recalibrate(points_grip_m, exact + noise, covariance_xy, true)
        errors[k] = error_of(found.cam_T_grip, true)
        nees[k] = errors[k] @ np.linalg.solve(found.covariance, errors[k])
        squares[k] = found.weighted_rms**2 * 2 * count
    claimed = np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(errors.std(axis=0) / claimed, 1.0, atol=4.5 / np.sqrt(2.0 * samples))
    assert nees.mean() == pytest.approx(6.0, abs=4.5 * np.sqrt(12.0 / samples))
    # What is left of the residuals is chi-square with 2 n - 6 degrees of freedom.
    freedom = 2 * count - 6
    assert squares.mean() == pytest.approx(freedom, abs=4.5 * np.sqrt(2.0 * freedom / samples))


def both_poses_of_a_plane(points_grip_m: np.ndarray, xy: np.ndarray) -> list[np.ndarray]:
    _, turns, shifts, _ = cv2.solvePnPGeneric(points_grip_m, xy, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    poses = []
    for turn, shift in zip(turns, shifts, strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
        poses.append(solve_pnp(points_grip_m, xy, pose))
    return poses


def test_where_residuals_cannot_tell_two_poses_apart_the_expected_one_is_taken():
    """A small plane far away: tilted one way or the other it looks the same within the noise."""
    rng = np.random.default_rng(5)
    true = nominal_cam_T_grip(tilt_deg=25.0, tcp_m=(0.0, 0.0, 1.5))
    square = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]]) * 0.01
    decided = 0
    for _ in range(20):
        xy = image(square, true) + rng.normal(scale=0.3 / FOCAL_PX, size=(4, 2))
        poses = both_poses_of_a_plane(square, xy)
        if np.degrees(np.linalg.norm(error_of(poses[0], poses[-1])[3:])) < 20.0:
            continue
        decided += 1
        for expected in poses:
            found = recalibrate(square, xy, sigma_xy(4, 0.3), expected)
            assert np.degrees(np.linalg.norm(error_of(found.cam_T_grip, expected)[3:])) < 1.0
    assert decided >= 10


def test_where_residuals_can_tell_the_expected_pose_does_not_matter():
    true = nominal_cam_T_grip()
    xy = image(PLANE_GRIP_M, true) + np.random.default_rng(6).normal(scale=0.05 / FOCAL_PX, size=(5, 2))
    wrong = max(both_poses_of_a_plane(PLANE_GRIP_M, xy), key=lambda p: float(np.linalg.norm(error_of(p, true)[3:])))
    assert np.degrees(np.linalg.norm(error_of(wrong, true)[3:])) > 20.0
    found = recalibrate(PLANE_GRIP_M, xy, sigma_xy(5, 0.05), wrong)
    assert np.degrees(np.linalg.norm(error_of(found.cam_T_grip, true)[3:])) < 1.0


@pytest.mark.parametrize(
    ("points_grip_m", "said"),
    [
        (np.zeros((0, 3)), "0 corners; at least 4 coplanar ones or 6"),
        (PLANE_GRIP_M[:1], "1 corners; at least 4 coplanar ones or 6"),
        (PLANE_GRIP_M[:3], "3 corners; at least 4"),
        (GENERAL_GRIP_M[:5], "5 corners; at least 6"),
        (np.linspace(-0.02, 0.02, 5)[:, None] * [1.0, 0.5, 0.2], "on a line"),
        (PLANE_GRIP_M[[0, 1, 0, 1, 0, 1]], "on a line"),
    ],
    ids=["none", "one", "three", "five general", "a line", "two points thrice"],
)
def test_too_few_corners_or_corners_on_a_line_are_refused(points_grip_m: np.ndarray, said: str):
    xy = image(points_grip_m, nominal_cam_T_grip()) if len(points_grip_m) else np.zeros((0, 2))
    with pytest.raises(RecalibrationRefused, match=said):
        recalibrate(points_grip_m, xy, sigma_xy(len(xy)), nominal_cam_T_grip())


@pytest.mark.parametrize("points_grip_m", SETS, ids=NAMES)
def test_corners_all_at_one_place_are_refused_or_fit_badly(points_grip_m: np.ndarray):
    """Gross nonsense must never come out as a good pose."""
    xy = np.full((len(points_grip_m), 2), 0.05)
    try:
        found = recalibrate(points_grip_m, xy, sigma_xy(len(xy)), nominal_cam_T_grip())
    except RecalibrationRefused:
        return
    assert found.weighted_rms > 5.0 or found.cam_T_grip[2, 3] > 10.0


def test_all_poses_of_a_plane_are_found_best_first():
    """Against both minima that OpenCV's refinement reaches from the closed form."""
    rng = np.random.default_rng(7)
    twins = 0
    for _ in range(20):
        true = random_pose(rng)
        xy = image(PLANE_GRIP_M, true) + rng.normal(scale=0.05 / FOCAL_PX, size=(5, 2))
        found = solutions(PLANE_GRIP_M, xy, sigma_xy(5, 0.05))
        assert [pose.weighted_rms for pose in found] == sorted(pose.weighted_rms for pose in found)
        assert np.abs(error_of(found[0].cam_T_grip, true)).max() < 0.05
        for pose in found:
            assert (PLANE_GRIP_M @ pose.cam_T_grip[2, :3] + pose.cam_T_grip[2, 3] > 0.0).all()
        theirs = [p for p in both_poses_of_a_plane(PLANE_GRIP_M, xy) if p[2, 3] > 0.0]
        for pose in found:
            nearest = min(theirs, key=lambda p: float(np.abs(error_of(pose.cam_T_grip, p)).max()))
            np.testing.assert_allclose(error_of(pose.cam_T_grip, nearest), 0.0, atol=1e-2)
            rms = np.sqrt(np.mean((image(PLANE_GRIP_M, nearest) - xy) ** 2)) * FOCAL_PX / 0.05
            assert pose.weighted_rms == pytest.approx(rms, rel=1e-5)
        two = np.abs(error_of(theirs[0], theirs[-1])).max() > 0.1
        assert len(found) == (2 if two else 1)
        twins += two
        assert rivals(found, 5) == found[:1], "five corners seen to a twentieth of a pixel tell them apart"
    assert 5 <= twins <= 15


def test_corners_behind_the_camera_give_no_pose_behind_it():
    """The image of points behind the camera is that of the same points turned round before it, or of none."""
    rng = np.random.default_rng(8)
    for points_grip_m in (PLANE_GRIP_M, GENERAL_GRIP_M):
        for _ in range(10):
            behind = random_pose(rng)
            behind[2, 3] *= -1.0
            xy = image(points_grip_m, behind)
            try:
                found = solutions(points_grip_m, xy, sigma_xy(len(xy)))
            except RecalibrationRefused:
                continue
            for pose in found:
                assert (points_grip_m @ pose.cam_T_grip[2, :3] + pose.cam_T_grip[2, 3] > 0.0).all()
            if points_grip_m is GENERAL_GRIP_M:
                assert found[0].weighted_rms > 5.0, "and no solid looks like its own mirror image"


@pytest.mark.parametrize(("best_rms", "freedom_scale"), [(0.5, 1.0), (2.0, 8.0)], ids=["a good fit", "a bad one"])
def test_a_pose_is_a_rival_up_to_sixteen_more_squares(best_rms: float, freedom_scale: float):
    """Twelve residuals of six corners, six degrees of freedom; where they are too large, so may the difference be."""
    squares = 12 * best_rms**2
    poses = [
        Recalibration(np.eye(4), np.eye(6), float(np.sqrt((squares + more * freedom_scale) / 12)))
        for more in (0.0, 15.5, 16.5)
    ]
    assert rivals(poses, 6) == poses[:2]
