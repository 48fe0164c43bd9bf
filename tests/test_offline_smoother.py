"""The smoother against dense least squares over all unknowns, its likelihood against the joint density, the"""

from __future__ import annotations

import numpy as np
from scipy import stats
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from gripmon.analyse.quick_motion import SIDE_FRAMES, squared_changes
from gripmon.analyse.smoothing import MID_S, SLOW_S, UNKNOWN_VARIANCE, Dynamics, log_likelihood, smooth
from gripmon.analyse.vectors import covariances_to_poses, covariances_to_vectors, to_poses, to_vectors

RNG = np.random.default_rng(1)
STEPS = 30
TIME_S = np.cumsum(RNG.uniform(0.05, 0.6, STEPS))
DYNAMICS = Dynamics(*(np.array(v) for v in ([0.4, 0.9], [0.2, 0.05], [1e-2, 1e-4], [1e-3, 1e-2], [1.0, 4.0])))
VARIANCE = RNG.uniform(0.05, 0.5, (STEPS, 2))
RESTARTS = np.isin(np.arange(STEPS), [11])
KINKS = np.zeros(STEPS, bool)
Y = np.cumsum(RNG.normal(size=(STEPS, 2)), axis=0) + RESTARTS.cumsum()[:, None] * 5.0


def dense(axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Prior covariance (n, n) of x at all times, and of all that is measured but white, by integrating the model."""
    count = len(TIME_S)
    x, errors = np.zeros((count, count)), np.zeros((count, count))
    t = TIME_S - TIME_S[0]
    wander, turn, rate = DYNAMICS.wander[axis], DYNAMICS.turn[axis], DYNAMICS.rate[axis]
    after = np.cumsum(RESTARTS)
    for i in range(count):
        for j in range(count):
            low, high = min(t[i], t[j]), max(t[i], t[j])
            # A random walk, a rate that began with a variance, and a random walk's integral.
            x[i, j] = UNKNOWN_VARIANCE + wander * low + rate * t[i] * t[j] + turn * low**2 * (3.0 * high - low) / 6.0
            x[i, j] += UNKNOWN_VARIANCE * min(after[i], after[j])
            gone = high - low
            errors[i, j] = DYNAMICS.slow[axis] * np.exp(-gone / SLOW_S) + DYNAMICS.mid[axis] * np.exp(-gone / MID_S)
    return x, errors


def test_smoothing_is_the_conditional_mean_of_the_joint_normal_distribution():
    smoothed = smooth(TIME_S, Y, VARIANCE, RESTARTS, KINKS, DYNAMICS)
    for axis in range(2):
        x, errors = dense(axis)
        measured = x + errors + np.diag(VARIANCE[:, axis])
        gain = np.linalg.solve(measured, x).T
        np.testing.assert_allclose(smoothed.x[:, axis], gain @ Y[:, axis], atol=2e-5)
        spread = np.diag(x - gain @ x)
        np.testing.assert_allclose(smoothed.covariance[:, axis, 0, 0], spread, rtol=1e-4, atol=1e-5)


def test_what_was_not_measured_tells_nothing():
    variance, y = VARIANCE.copy(), Y.copy()
    variance[5:9], y[7] = np.inf, np.nan
    kept = np.ones(STEPS, bool)
    kept[5:9] = False
    part = smooth(TIME_S, y, variance, RESTARTS, KINKS, DYNAMICS)
    alone = smooth(TIME_S[kept], Y[kept], VARIANCE[kept], RESTARTS[kept], KINKS[kept], DYNAMICS)
    np.testing.assert_allclose(part.x[kept], alone.x, atol=1e-6)
    np.testing.assert_allclose(part.covariance[kept], alone.covariance, rtol=1e-4, atol=1e-6)


def test_the_likelihood_is_the_joint_density():
    found = log_likelihood(TIME_S, Y, VARIANCE, RESTARTS, KINKS, DYNAMICS)
    for axis in range(2):
        x, errors = dense(axis)
        covariance = x + errors + np.diag(VARIANCE[:, axis])
        expected = stats.multivariate_normal(np.zeros(STEPS), covariance).logpdf(Y[:, axis])
        np.testing.assert_allclose(found[axis], expected, rtol=1e-5)


def test_a_kink_lets_the_rate_go():
    time_s = np.arange(100) * 0.5
    y = np.maximum(time_s - 25.0, 0.0)[:, None]
    still = Dynamics(*(np.array([v]) for v in (0.1, 0.1, 1e-9, 1e-9, 1e-9)))
    variance, none = np.full((100, 1), 0.01), np.zeros(100, bool)
    kinks = np.isin(np.arange(100), [50])
    stiff, kinked = (smooth(time_s, y, variance, none, k, still).x[:, 0] for k in (none, kinks))
    assert np.abs(kinked - y[:, 0]).max() < 0.1 < np.abs(stiff - y[:, 0]).max()


def test_vectors_and_poses_are_each_others_way_back():
    vectors = RNG.normal(size=(20, 6)) * 0.5
    origin = np.eye(4)
    origin[:3, :3] = Rotation.random(rng=3).as_matrix()
    poses = to_poses(origin, vectors)
    expected = np.array([expm(np.cross(np.eye(3), v[3:])) @ origin[:3, :3] for v in vectors])
    np.testing.assert_allclose(poses[:, :3, :3], expected, atol=1e-12)
    np.testing.assert_allclose(to_vectors(origin, poses), vectors, atol=1e-12)


def test_covariances_follow_the_chart():
    """Against the spread of many perturbed poses far from the origin."""
    vector = np.array([[0.0, 0.0, 0.0, 0.5, -0.3, 0.2]])
    root = np.linalg.cholesky(np.diag([1e-6, 4e-6, 1e-6, 1e-6, 9e-6, 4e-6]) + 5e-7)
    errors = np.random.default_rng(4).normal(size=(200_000, 6)) @ root.T
    pose = to_poses(np.eye(4), vector)[0]
    off = to_poses(pose, errors)
    spread = np.cov(to_vectors(np.eye(4), off).T)
    stated = covariances_to_vectors((root @ root.T)[None], vector)[0]
    np.testing.assert_allclose(stated, spread, atol=0.02 * spread.max())
    np.testing.assert_allclose(covariances_to_poses(stated[None], vector)[0], root @ root.T, atol=1e-12)


def test_squared_changes_of_normal_noise_have_the_distribution_that_they_are_judged_by():
    noise = np.random.default_rng(5).normal(size=(40_000, 6)) @ np.random.default_rng(6).normal(size=(6, 6))
    for length in SIDE_FRAMES:
        squares = squared_changes(noise, length)[length:-length]
        for chance in (0.5, 0.1, 0.01):
            assert np.mean(squares > stats.chi2.isf(chance, 6)) < 1.35 * chance
        assert np.median(squares) > 0.75 * stats.chi2.median(6)
