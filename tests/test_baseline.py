"""An inexact reference is no drift: its error is taken out of the first frames, within what its covariance allows."""

from __future__ import annotations

import numpy as np
import pytest

from gripmon.drift import Baseline

REFERENCE_SIGMA = np.array([2e-4] * 3 + [2e-3] * 3)


def test_the_error_is_the_mean_of_the_first_frames():
    baseline, rng = Baseline(REFERENCE_SIGMA, 4), np.random.default_rng(1)
    shifts = rng.normal(0.0, 1e-4, (6, 6))
    results = [baseline.subtract(shift) for shift in shifts]
    assert results[:3] == [None, None, None]
    for result, shift in zip(results[3:], shifts[3:], strict=True):
        assert result is not None
        np.testing.assert_allclose(result, shift - shifts[:4].mean(axis=0), atol=1e-15)
    assert baseline.error is not None
    np.testing.assert_allclose(baseline.error, shifts[:4].mean(axis=0), atol=1e-15)


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
