"""An inexact reference is not a drift: its error is taken out of the first frames, as far as its covariance allows."""

from __future__ import annotations

import numpy as np
import pytest

from gripmon.judge.drift import Baseline

REFERENCE_SIGMA = np.array([2e-4] * 3 + [2e-3] * 3)


def test_the_error_is_known_after_so_many_frames_to_what_their_noise_allows():
    """Errors of the axes belong together here, and so they do in the mean: no axis is taken by itself."""
    rng, errors = np.random.default_rng(1), []
    factor = rng.normal(size=(6, 6)) @ np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 0.01])
    for _ in range(400):
        baseline = Baseline(np.full(6, 1e3), 20)
        for number, shift in enumerate(5.0 + rng.normal(size=(20, 6)) @ factor.T):
            assert baseline.error is None
            assert (baseline.subtract(shift) is None) == (number < 19)
        assert baseline.error is not None
        errors.append(np.linalg.solve(factor, baseline.error - 5.0))
    variance = np.square(errors).mean(axis=0)
    assert variance.max() < 3.0 / 20.0, "of 20 frames, a good half counts"


@pytest.mark.parametrize("wild", range(6))
def test_wild_frames_among_the_first_do_not_count(wild: int):
    rng, baseline = np.random.default_rng(2), Baseline(REFERENCE_SIGMA, 20)
    shifts = rng.normal(1e-4, 1e-6, (20, 6))
    shifts[3 * wild : 3 * wild + 3] = 0.1
    for shift in shifts:
        baseline.subtract(shift)
    assert baseline.error is not None
    np.testing.assert_allclose(baseline.error, np.full(6, 1e-4), atol=2e-6)


@pytest.mark.parametrize("at", [5, 10, 16])
def test_a_knock_among_the_first_frames_is_none_of_it(at: int):
    """Nor a part of it: a mean across the knock would call the first frames wrong, and halve the knock."""
    rng, baseline = np.random.default_rng(3), Baseline(10.0 * REFERENCE_SIGMA, 20)
    error, knock = np.array([3e-4, 0.0, -2e-4, 1e-3, 0.0, 0.0]), np.array([1.2e-3, 1.6e-3, 0.0, 0.0, 0.0, 0.0])
    noise = rng.normal(0.0, [2e-5] * 3 + [2e-4] * 3, (20, 6))
    for number in range(20):
        last = baseline.subtract(error + noise[number] + knock * (number >= at))
    assert last is not None and baseline.error is not None
    np.testing.assert_allclose(baseline.error, error, atol=4e-4)
    np.testing.assert_allclose(last[:3], knock[:3], atol=8e-5)


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_only_what_the_references_uncertainty_allows_is_its_error(axis: int, sign: float):
    """Four standard deviations on any axis; beyond, on one axis only, all of it is a shift."""
    for size, explained in ((3.9, True), (4.1, False)):
        baseline, shift = Baseline(REFERENCE_SIGMA, 3), 0.5 * REFERENCE_SIGMA
        shift[axis] = sign * size * REFERENCE_SIGMA[axis]
        last = [baseline.subtract(shift) for _ in range(3)][-1]
        assert last is not None
        np.testing.assert_allclose(last, np.zeros(6) if explained else shift, atol=1e-15)


def test_motion_after_the_start_is_none_of_it():
    baseline, first = Baseline(REFERENCE_SIGMA, 3), np.array([5e-4, 0.0, 0.0, 0.0, 0.0, 0.0])
    for _ in range(50):
        baseline.subtract(first)
    later = baseline.subtract(first + 2e-4)
    assert later is not None
    np.testing.assert_allclose(later, np.full(6, 2e-4))


def test_an_error_that_is_known_from_before_counts_from_the_first_frame():
    error = np.linspace(1e-4, 6e-4, 6)
    baseline = Baseline(REFERENCE_SIGMA, 20, error)
    first = baseline.subtract(error + 1e-3)
    assert first is not None
    np.testing.assert_allclose(first, np.full(6, 1e-3))


@pytest.mark.parametrize("at", [1, 2, 7])
def test_a_knock_that_is_known_ends_the_first_frames(at: int):
    """It was told only once there were as many frames as usual; those after it are no part of the error."""
    baseline, first = Baseline(REFERENCE_SIGMA, 20), np.full(6, 1e-4)
    baseline.knocked()
    for _ in range(at):
        assert baseline.subtract(first) is None
    baseline.knocked()
    later = baseline.subtract(first + 2e-3)
    assert later is not None
    np.testing.assert_allclose(later, np.full(6, 2e-3))
