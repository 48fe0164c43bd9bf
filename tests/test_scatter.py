"""What window means scatter by: Haar's identity on simulated noise, and what of a claimed covariance is missing."""

from __future__ import annotations

import numpy as np
import pytest
from support.drift_noise import COVARIANCE, autocorrelated, claimed

from gripmon.judge.drift import kernel
from gripmon.judge.drift.statistics import LENGTHS, PRIOR_SHARE, PRIOR_WINDOWS, RARE, Scatter, Windows

FRAMES, STREAMS = 12_000, 24
NO_MORE = np.ones((len(LENGTHS), STREAMS))


def learnt(shifts: np.ndarray, every: int = 4) -> Scatter:
    """Scatter of the differences between windows over shifts (n, s, 6)."""
    streams = shifts.shape[1]
    windows, scatter = Windows(streams), Scatter(streams)
    scatter.begin(claimed(streams))
    for number, values in enumerate(shifts):
        _, difference = windows.add(values)
        if number % every == 0:
            _, usable = windows.full()
            scatter.learn(difference, np.zeros(usable.shape), usable, every)
    return scatter


def covariances(scatter: Scatter, reported: np.ndarray, inflation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(k, s, 6, 6) of means and of differences, ``reported`` (s, 6, 6) being what a frame claims for itself, and what
    the stream has shown counting by the variance's ``inflation`` (k, s) more.
    """
    lengths, streams = inflation.shape
    matrices = (6, 6)
    plain, whitening = (np.empty((2, some, streams, *matrices)) for some in (1, lengths))
    of_mean, learnt_whitening = (np.empty((lengths, streams, *matrices)) for _ in range(2))
    reference, to_reported, from_reported = (np.zeros((streams, *matrices)) for _ in range(3))
    times, known = np.stack([inflation] * 3), np.zeros((2, lengths, streams), dtype=bool)
    kernel.refresh(
        reported, scatter.of_differences, scatter.learnt, times, RARE, reference, known, plain, of_mean, whitening,
        learnt_whitening, to_reported, from_reported,
    )  # fmt: skip
    root = np.linalg.inv(whitening)
    both = root @ np.swapaxes(root, -1, -2)
    np.testing.assert_allclose(both[0], of_mean, rtol=1e-7, atol=1e-20)
    return of_mean, both[1]


def share(covariance: np.ndarray) -> float:
    """Mean over the directions of a covariance (..., 6, 6) in units of the claimed one."""
    white = np.linalg.solve(COVARIANCE, covariance.reshape(-1, 6, 6))
    return float(np.trace(white, axis1=1, axis2=2).mean() / 6.0)


def mean_variance(memory: float, frames: int) -> float:
    """Of the mean of so many values of an AR(1) with variance one, by the sum over all pairs."""
    lags = np.abs(np.subtract.outer(np.arange(frames), np.arange(frames)))
    return float(np.mean(memory**lags))


@pytest.mark.parametrize("memory", [0.0, 0.5, 0.9])
def test_means_of_windows_scatter_as_those_of_an_ar_process(memory: float):
    """Twice the claimed standard deviation, so that nothing of it is missing."""
    rng = np.random.default_rng(1)
    scatter = learnt(2.0 * autocorrelated(rng, FRAMES, STREAMS, memory))
    of_mean, _ = covariances(scatter, claimed(STREAMS), NO_MORE)
    for k, frames in enumerate(LENGTHS[:7]):  # longer ones still show the prior
        # Neighbours a and b of one length: var(a - b) = 2 var(a) + 2 var(b) - 4 var((a + b) / 2).
        expected = 4.0 * mean_variance(memory, frames)
        difference = 4.0 * expected - 16.0 * mean_variance(memory, 2 * frames)
        pairs = 0.5 * FRAMES / frames
        difference = (pairs * difference + PRIOR_WINDOWS * PRIOR_SHARE) / (pairs + PRIOR_WINDOWS)
        assert share(scatter.of_differences[k]) == pytest.approx(difference, rel=0.07)
        rest = 0.25 * PRIOR_SHARE * 8.0  # of the lengths that have not shown themselves yet
        assert share(of_mean[k]) == pytest.approx(expected, rel=0.15, abs=rest)


def test_before_anything_was_seen_means_are_worth_about_what_frames_claim():
    scatter = Scatter(1)
    scatter.begin(claimed(1))
    of_mean, _ = covariances(scatter, claimed(1), NO_MORE[:, :1])
    assert 1.0 <= share(of_mean[0]) < 2.5
    assert (np.array([share(each) for each in of_mean]) >= 1.0).all()
    assert (np.diff([share(each) for each in of_mean]) <= 0.0).all()


def test_one_wild_difference_hardly_counts():
    """Beyond four times what is expected a square counts as that much."""
    calm, wild = Scatter(1), Scatter(1)
    for scatter, size in ((calm, 1.0), (wild, 1e3)):
        scatter.begin(claimed(1))
        difference = np.tile(size * np.linalg.cholesky(COVARIANCE)[:, 0], (len(LENGTHS), 1, 1))
        normalised = np.full((len(LENGTHS), 1), 6.0 * size**2)
        scatter.learn(difference, normalised, np.full((len(LENGTHS), 1), True), 4)
    assert share(wild.of_differences) < share(calm.of_differences) + 4.0 / 13.0


def test_what_is_not_usable_is_not_learnt():
    scatter = Scatter(2)
    scatter.begin(claimed(2))
    before, windows = scatter.of_differences.copy(), scatter.windows.copy()
    usable = np.tile([True, False], (len(LENGTHS), 1))
    scatter.learn(np.ones((len(LENGTHS), 2, 6)), np.ones((len(LENGTHS), 2)), usable, 4)
    np.testing.assert_array_equal(scatter.of_differences[:, 1], before[:, 1])
    np.testing.assert_array_equal(scatter.windows[:, 1], windows[:, 1])
    assert (scatter.of_differences[:, 0] != before[:, 0]).all()


def what_is_missing(shown: np.ndarray) -> np.ndarray:
    """The part of the claimed covariance, direction by direction, that exceeds what was shown (..., 6, 6)."""
    root = np.linalg.cholesky(COVARIANCE)
    inverse = np.linalg.inv(root)
    shares, directions = np.linalg.eigh(inverse @ shown @ inverse.T)
    towards = root @ directions
    return np.asarray((towards * np.maximum(1.0 - shares, 0.0)[..., None, :]) @ np.swapaxes(towards, -1, -2))


@pytest.mark.parametrize("seen", [0.0, 0.3, 1.0, 3.0])
def test_what_is_missing_of_the_claim_comes_on_top_direction_by_direction(seen: float):
    """Less than claimed in some directions, more in others; against eigenvalues, at every length."""
    rng = np.random.default_rng(5)
    scatter = Scatter(2)
    scatter.begin(claimed(2))
    mix = np.eye(6) + 0.2 * rng.normal(size=(len(LENGTHS), 2, 6, 6))
    scatter.of_differences[:] = seen * mix @ COVARIANCE @ mix.swapaxes(-1, -2) + 1e-3 * COVARIANCE
    scatter.windows[:] = rng.uniform(12.0, 200.0, scatter.windows.shape)
    inflation = rng.uniform(1.0, 3.0, (len(LENGTHS), 2))
    parts = 0.25 * scatter.of_differences
    parts[-1] *= 2.0  # beyond the longest, windows count as independent
    total, shown = (
        np.flip(np.cumsum(np.flip(times[..., None, None] * parts, axis=0), axis=0), axis=0)
        for times in (inflation, scatter.learnt)
    )
    rarely = np.concatenate([shown, np.zeros_like(shown[:1])])[RARE]
    differences = inflation[..., None, None] * scatter.of_differences + 2.0 * what_is_missing(shown[:1] - rarely)
    for found, expected in zip(
        covariances(scatter, claimed(2), inflation), (total + what_is_missing(shown[:1]), differences), strict=True
    ):
        assert (np.abs(found - expected) <= 1e-7 * np.abs(expected).max(axis=(-2, -1), keepdims=True)).all()
