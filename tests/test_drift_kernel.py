"""The compiled sequential test against NumPy's, frame by frame on several kinds of noise."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from support.by_numpy import drift as by_numpy
from support.drift_noise import COVARIANCE, autocorrelated, claimed, vibrating, white

from gripmon.judge.drift import DriftSettings, SequentialTest, sequential, statistics
from gripmon.judge.drift.sequential import SWEEPS
from gripmon.judge.drift.statistics import Scatter

STREAMS, FRAMES, STILL = 3, 3000, 1800
STEP = np.linalg.cholesky(COVARIANCE) @ np.ones(6)


def pair(settings: DriftSettings, streams: int = STREAMS) -> tuple[SequentialTest, SequentialTest]:
    return SequentialTest(settings, streams), SequentialTest(settings, streams)


@contextmanager
def numpys() -> Iterator[None]:
    """Meanwhile tests reckon by NumPy."""
    with pytest.MonkeyPatch.context() as patched:
        for module in (sequential, statistics):
            patched.setattr(module, "kernel", by_numpy)
        yield


def assert_alike(found: SequentialTest, expected: SequentialTest) -> None:
    """What either has learnt."""
    np.testing.assert_allclose(found.scatter.of_differences, expected.scatter.of_differences, rtol=1e-9, atol=1e-22)
    np.testing.assert_allclose(found.scatter.windows, expected.scatter.windows, rtol=1e-12)
    (level, covariance), (known, of_known) = found.level(64), expected.level(64)
    np.testing.assert_allclose(level, known, rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(covariance, of_known, rtol=1e-9, atol=1e-22)
    np.testing.assert_allclose(found.usual_covariance(), expected.usual_covariance(), rtol=1e-9, atol=1e-22)


@pytest.mark.parametrize("noise", [white, autocorrelated, vibrating])
def test_each_frame_is_found_alike(noise: Callable[..., np.ndarray]):
    """With a drift that grows from within the tolerance on, doubtful frames, frames that claim more, restarts and a
    reference that is uncertain.
    """
    rng = np.random.default_rng(3)
    found, expected = pair(DriftSettings(false_alarms_per_day=1000.0, frames_per_s=10.0))
    shifts = noise(rng, FRAMES, STREAMS)
    shifts[STILL:] += np.linspace(0.0, 15.0, FRAMES - STILL)[:, None, None] * STEP
    moved = 0
    for number, shift in enumerate(shifts):
        covariance = rng.uniform(0.5, 3.0, (STREAMS, 1, 1)) * claimed(STREAMS)
        learn = rng.uniform(size=STREAMS) < 0.9
        at_least = 1 if number % 7 else 16
        one = found.add(shift, covariance, learn, at_least)
        with numpys():
            other = expected.add(shift, covariance, learn, at_least)
        np.testing.assert_array_equal(one.moved, other.moved)
        np.testing.assert_array_equal(one.length[one.moved], other.length[other.moved])
        np.testing.assert_array_equal(one.stepped, other.stepped)
        np.testing.assert_allclose(one.excess, other.excess, rtol=1e-9, atol=1e-12)
        moved += int(one.moved.sum())
        if number in (600, 2700):
            found.restart(np.array([True, False, True]), np.array([0, 0, 5]))
            with numpys():
                expected.restart(np.array([True, False, True]), np.array([0, 0, 5]))
            for test in (found, expected):
                test.set_reference_covariance(0.1 * COVARIANCE)
    assert 100 < moved < STREAMS * (FRAMES - STILL), "of both kinds"
    assert_alike(found, expected)


def test_it_is_one_whether_a_frame_teaches_at_once_or_with_the_next():
    """What is learnt after the transform has left is what the next frame would have learnt first."""
    at_once, later = (SequentialTest(DriftSettings()) for _ in range(2))
    for shift in autocorrelated(np.random.default_rng(6), 400, 1):
        one, other = at_once.add(shift, claimed(1)), later.add(shift, claimed(1))
        at_once.learn()
        at_once.learn()  # a second time teaches nothing
        assert one.moved == other.moved and one.excess == other.excess
    assert at_once.refreshes - later.refreshes in (0, 1) and later.refreshes > 20
    later.learn()
    np.testing.assert_array_equal(at_once.scatter.of_differences, later.scatter.of_differences)


@pytest.mark.slow("30 s; the same with limits that are assumed is in the default run")
def test_learnt_limits_are_alike():
    found, expected = pair(DriftSettings(), 1)
    for shift in autocorrelated(np.random.default_rng(4), 20_000, 1):
        one = found.add(shift, claimed(1))
        with numpys():
            other = expected.add(shift, claimed(1))
        assert one.moved == other.moved
        np.testing.assert_allclose(one.excess, other.excess, rtol=1e-9, atol=1e-12)
    assert_alike(found, expected)
    np.testing.assert_allclose(found.noticed(), expected.noticed(), rtol=1e-9)


@pytest.mark.parametrize("seen", [0.0, 0.3, 1.0, 3.0])
def test_covariances_are_those_of_numpy_however_much_of_the_claim_was_seen(seen: float):
    """Less of it in some directions, more in others: what is missing is the part of a matrix that is positive."""
    rng = np.random.default_rng(5)
    scatter = Scatter(2)
    scatter.begin(claimed(2))
    mix = np.eye(6) + 0.2 * rng.normal(size=(13, 2, 6, 6))
    scatter.of_differences[:] = seen * mix @ COVARIANCE @ mix.swapaxes(-1, -2) + 1e-3 * COVARIANCE
    scatter.windows[:] = rng.uniform(12.0, 200.0, scatter.windows.shape)
    found, expected = pair(DriftSettings(), 2)
    each = rng.uniform(1.0, 3.0, (3, 13, 2))
    known = rng.uniform(size=(2, 13, 2)) < 0.5
    for test in (found, expected):
        test.scatter, test._reported, test._known = scatter, claimed(2), known
    found._whiten(each)
    with numpys():
        expected._whiten(each)
    for name in ("_plain", "_whitening", "_learnt_whitening", "_mean_covariance", "_to_reported", "_from_reported"):
        one, other = getattr(found, name), getattr(expected, name)
        assert (np.abs(one - other) <= 1e-9 * np.abs(other).max(axis=(-2, -1), keepdims=True)).all(), name


def test_a_shift_beyond_what_is_tolerated_is_measured_alike():
    rng = np.random.default_rng(6)
    found = SequentialTest(DriftSettings(tolerated_m=2e-5, tolerated_rad=1e-3))
    white_of = by_numpy.whitening_of(COVARIANCE)
    for size in (0.1, 1.0, 5.0, 50.0):
        shift = size * STEP * rng.normal(size=6)
        tolerated = DriftSettings(tolerated_m=2e-5, tolerated_rad=1e-3).tolerated
        known = float(by_numpy.least_squares(white_of, shift, tolerated, SWEEPS))
        assert found.square_beyond(shift, COVARIANCE) == pytest.approx(known, rel=1e-9, abs=1e-12)


def test_what_has_no_root_is_an_error():
    with pytest.raises(np.linalg.LinAlgError, match="positive definite"):
        SequentialTest(DriftSettings()).square_beyond(np.ones(6), -np.eye(6))
    with pytest.raises(np.linalg.LinAlgError, match="positive definite"):
        SequentialTest(DriftSettings()).add(np.zeros((1, 6)), -np.eye(6)[None])
