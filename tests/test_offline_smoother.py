"""The smoother against the dense Gaussian posterior of all unknowns, its likelihood against the joint density, the
chart of poses against matrix exponentials, and the statistic of changes against chi².
"""

from __future__ import annotations

import numpy as np
from scipy import stats

from gripmon.analyse.change_points import SIDE_FRAMES, squared_changes
from gripmon.analyse.smoothing import SLOW_S, UNKNOWN_RATE_VARIANCE, UNKNOWN_VARIANCE, smooth
from gripmon.analyse.vectors import covariances_to_poses, covariances_to_vectors, to_poses, to_vectors

RNG = np.random.default_rng(1)
STEPS = 30
TIME_S = np.cumsum(RNG.uniform(0.05, 0.6, STEPS))
SLOW, TURN = np.array([0.4, 0.9]), np.array([1e-3, 1e-2])
VARIANCE = RNG.uniform(0.05, 0.5, (STEPS, 2))
RESTARTS = np.isin(np.arange(STEPS), [11])
Y = np.cumsum(RNG.normal(size=(STEPS, 2)), axis=0) + RESTARTS.cumsum()[:, None] * 5.0


def dense(axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Prior covariance (n, n) of x at all times, and of all that is measured but white, by integrating the model."""
    count = len(TIME_S)
    x, errors = np.zeros((count, count)), np.zeros((count, count))
    t = TIME_S - TIME_S[0]
    after = np.cumsum(RESTARTS)
    for i in range(count):
        for j in range(count):
            low, high = min(t[i], t[j]), max(t[i], t[j])
            # A level, a rate that began with a variance, and a random walk's integral.
            x[i, j] = UNKNOWN_VARIANCE * (1.0 + min(after[i], after[j])) + UNKNOWN_RATE_VARIANCE * t[i] * t[j]
            x[i, j] += TURN[axis] * low**2 * (3.0 * high - low) / 6.0
            errors[i, j] = SLOW[axis] * np.exp(-(high - low) / SLOW_S)
    return x, errors


def test_smoothing_is_the_gaussian_posterior():
    smoothed = smooth(TIME_S, Y, VARIANCE, RESTARTS, SLOW, TURN)
    for axis in range(2):
        x, errors = dense(axis)
        measured = x + errors + np.diag(VARIANCE[:, axis])
        gain = np.linalg.solve(measured, x).T
        np.testing.assert_allclose(smoothed.x[:, axis], gain @ Y[:, axis], atol=2e-5)
        spread = np.diag(x - gain @ x)
        np.testing.assert_allclose(smoothed.covariance[:, axis, 0, 0], spread, rtol=1e-4, atol=1e-5)
        square = Y[:, axis] @ np.linalg.solve(measured, Y[:, axis])
        expected = -0.5 * (square + np.linalg.slogdet(2.0 * np.pi * measured)[1])
        np.testing.assert_allclose(smoothed.log_likelihood[axis], expected, rtol=1e-5)


def test_what_was_not_measured_tells_nothing():
    variance, y = VARIANCE.copy(), Y.copy()
    variance[5:9], y[7] = np.inf, np.nan
    kept = np.ones(STEPS, bool)
    kept[5:9] = False
    part = smooth(TIME_S, y, variance, RESTARTS, SLOW, TURN)
    alone = smooth(TIME_S[kept], Y[kept], VARIANCE[kept], RESTARTS[kept], SLOW, TURN)
    np.testing.assert_allclose(part.x[kept], alone.x, atol=1e-6)
    np.testing.assert_allclose(part.covariance[kept], alone.covariance, rtol=1e-4, atol=1e-6)


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
    squares = squared_changes(noise)[SIDE_FRAMES:-SIDE_FRAMES]
    for chance in (0.5, 0.1, 0.01):
        assert np.mean(squares > stats.chi2.isf(chance, 6)) < 1.35 * chance
    assert np.median(squares) > 0.75 * stats.chi2.median(6)
