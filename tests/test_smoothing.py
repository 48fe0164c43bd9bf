"""The pose average against plain averages, the Riccati equation and a textbook Kalman filter; jumps and outliers."""

from __future__ import annotations

import numpy as np
import pytest
from box_models import random_rotation
from scipy.linalg import solve_discrete_are
from scipy.spatial.transform import Rotation

from gripmon.smoothing import PoseAverage, SmoothingSettings

STILL = SmoothingSettings(creep_m_per_sqrt_s=0.0, creep_rad_per_sqrt_s=0.0)
RNG = np.random.default_rng(1)
TRUE = np.eye(4)
TRUE[:3, :3] = random_rotation(RNG)
TRUE[:3, 3] = [0.001, -0.002, 0.115]


def spread(scale: float = 1.0, seed: int = 2) -> np.ndarray:
    """A covariance (6, 6) with correlations: some micrometres, some hundredths of a degree."""
    units = np.array([3e-6, 2e-6, 2e-5, 4e-4, 3e-4, 1e-4]) * scale
    mixing = np.random.default_rng(seed).normal(size=(6, 9))
    correlation = mixing @ mixing.T / 9.0
    return units[:, None] * correlation * units


def moved(pose: np.ndarray, xi: np.ndarray) -> np.ndarray:
    out = pose.copy()
    out[:3, :3] = Rotation.from_rotvec(xi[3:]).as_matrix() @ pose[:3, :3]
    out[:3, 3] += xi[:3]
    return out


def difference(from_T: np.ndarray, to_T: np.ndarray) -> np.ndarray:
    turn = Rotation.from_matrix(to_T[:3, :3] @ from_T[:3, :3].T).as_rotvec()
    return np.concatenate([to_T[:3, 3] - from_T[:3, 3], turn])


def noise(rng: np.random.Generator, covariance: np.ndarray, count: int) -> np.ndarray:
    return rng.normal(size=(count, 6)) @ np.linalg.cholesky(covariance).T


def test_a_pose_that_stands_still_is_averaged_and_its_covariance_falls_with_the_count():
    average, covariance = PoseAverage(STILL), spread()
    errors = noise(np.random.default_rng(3), covariance, 50)
    for count, xi in enumerate(errors, 1):
        average.wander(1.0 / 60.0)
        average.add(moved(TRUE, xi), covariance)
        np.testing.assert_allclose(average.covariance, covariance / count, rtol=1e-8)
    # Rotation vectors don't add up exactly: what is left is the square of the noise.
    assert average.cam_T_grip is not None
    np.testing.assert_allclose(difference(TRUE, average.cam_T_grip)[:3], errors.mean(axis=0)[:3], atol=1e-12)
    np.testing.assert_allclose(difference(TRUE, average.cam_T_grip)[3:], errors.mean(axis=0)[3:], atol=1e-6)


def test_measurements_of_unequal_worth_are_weighted_by_their_information():
    average = PoseAverage(STILL)
    rng = np.random.default_rng(4)
    information, weighted = np.zeros((6, 6)), np.zeros(6)
    for k in range(12):
        covariance = spread(scale=rng.uniform(0.3, 3.0), seed=k)
        xi = noise(rng, covariance, 1)[0]
        average.add(moved(TRUE, xi), covariance)
        information += np.linalg.inv(covariance)
        weighted += np.linalg.solve(covariance, xi)
    assert average.cam_T_grip is not None
    np.testing.assert_allclose(average.covariance, np.linalg.inv(information), rtol=1e-6, atol=1e-20)
    expected = np.linalg.solve(information, weighted)
    np.testing.assert_allclose(difference(TRUE, average.cam_T_grip)[:3], expected[:3], atol=2e-8)
    np.testing.assert_allclose(difference(TRUE, average.cam_T_grip)[3:], expected[3:], atol=1e-6)


def test_with_creep_the_covariance_settles_at_the_riccati_equations_solution():
    settings = SmoothingSettings(creep_m_per_sqrt_s=2e-5, creep_rad_per_sqrt_s=3e-4)
    average, covariance, period_s = PoseAverage(settings), spread(), 1.0 / 60.0
    for _ in range(3000):
        average.wander(period_s)
        average.add(TRUE, covariance)
    creep = np.diag(np.square([2e-5] * 3 + [3e-4] * 3)) * period_s
    scale = np.sqrt(np.diag(covariance))  # The solver wants comparable units.
    units = np.outer(scale, scale)
    before = solve_discrete_are(np.eye(6), np.eye(6), creep / units, covariance / units) * units
    after = before - before @ np.linalg.solve(before + covariance, before)
    np.testing.assert_allclose(average.covariance, after, rtol=1e-6, atol=1e-9 * after.max())
    # The scalar form of the same for one axis of uncorrelated noise.
    average = PoseAverage(settings)
    for _ in range(3000):
        average.wander(period_s)
        average.add(TRUE, np.diag(np.diag(covariance)))
    q, r = creep[2, 2], covariance[2, 2]
    assert average.covariance[2, 2] == pytest.approx(0.5 * (np.sqrt(q * q + 4.0 * q * r) - q), rel=1e-6)


def test_normalised_errors_against_a_creeping_truth_have_the_spread_that_the_covariance_claims():
    settings = SmoothingSettings(creep_m_per_sqrt_s=3e-5, creep_rad_per_sqrt_s=1e-3)
    rng, covariance, period_s = np.random.default_rng(5), spread(), 0.05
    walk = noise(rng, np.diag(np.square([3e-5] * 3 + [1e-3] * 3) * period_s), 2500)
    errors = noise(rng, covariance, 2500)
    average, true, nees = PoseAverage(settings), TRUE, []
    for step, error in zip(walk, errors, strict=True):
        true = moved(true, step)
        average.wander(period_s)
        average.add(moved(true, error), covariance)
        assert average.cam_T_grip is not None
        miss = difference(average.cam_T_grip, true)
        nees.append(miss @ np.linalg.solve(average.covariance, miss))
    # Neighbours are correlated over some ten frames at most.
    assert np.mean(nees[20:]) == pytest.approx(6.0, abs=4.5 * np.sqrt(12.0 / 250.0))


def test_a_single_outlier_leaves_the_average_untouched():
    average, covariance = PoseAverage(STILL), spread()
    for _ in range(5):
        average.add(TRUE, covariance)
    before_T, before = average.cam_T_grip, average.covariance.copy()
    average.add(moved(TRUE, np.array([0.001, 0, 0, 0, 0, 0])), covariance)
    np.testing.assert_array_equal(average.cam_T_grip, before_T)
    np.testing.assert_array_equal(average.covariance, before)
    average.add(TRUE, covariance)
    np.testing.assert_allclose(average.covariance, covariance / 6, rtol=1e-8)
    # One good measurement between two outliers: neither is believed.
    average.add(moved(TRUE, np.array([0.001, 0, 0, 0, 0, 0])), covariance)
    np.testing.assert_allclose(average.cam_T_grip, TRUE, atol=1e-12)


@pytest.mark.parametrize("axis", range(6))
def test_a_jump_starts_the_average_anew_with_its_second_frame(axis: int):
    average, covariance = PoseAverage(STILL), spread()
    for _ in range(20):
        average.add(TRUE, covariance)
    jump = np.zeros(6)
    jump[axis] = 40.0 * np.sqrt(covariance[axis, axis])
    there = moved(TRUE, jump)
    average.add(there, covariance)
    np.testing.assert_allclose(average.cam_T_grip, TRUE, atol=1e-12)
    average.add(there, covariance)
    np.testing.assert_array_equal(average.cam_T_grip, there)
    np.testing.assert_array_equal(average.covariance, covariance)
    average.add(there, covariance)
    np.testing.assert_allclose(average.covariance, covariance / 2, rtol=1e-8)


def test_the_gate_lets_all_but_one_in_a_million_of_honest_measurements_pass():
    from scipy.stats import chi2

    from gripmon.smoothing import GATE

    assert chi2.sf(GATE, 6) == pytest.approx(1.3e-6, rel=0.1)


def test_waiting_grows_the_variance_with_time_however_it_is_cut_up():
    settings = SmoothingSettings(creep_m_per_sqrt_s=1e-5, creep_rad_per_sqrt_s=1e-4)
    once, often, covariance = PoseAverage(settings), PoseAverage(settings), spread()
    given = covariance.copy()
    once.add(TRUE, covariance)
    often.add(TRUE, covariance)
    once.wander(4.0)
    for _ in range(100):
        often.wander(0.04)
    np.testing.assert_allclose(once.covariance, often.covariance, rtol=1e-12)
    np.testing.assert_allclose(once.covariance - given, np.diag([4e-10] * 3 + [4e-8] * 3), rtol=1e-9, atol=1e-24)
    np.testing.assert_array_equal(covariance, given), "what was handed over is not changed"


def test_after_forgetting_the_next_measurement_stands_alone():
    average, covariance = PoseAverage(STILL), spread()
    assert average.cam_T_grip is None
    for _ in range(3):
        average.add(TRUE, covariance)
    average.forget()
    assert average.cam_T_grip is None
    there = moved(TRUE, np.array([0.01, 0.0, 0.0, 0.0, 0.3, 0.0]))
    average.add(there, covariance)
    np.testing.assert_array_equal(average.cam_T_grip, there)
    np.testing.assert_array_equal(average.covariance, covariance)
