"""What is left of a shift less what is tolerated, against SciPy's bounded least squares."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from gripmon.judge.drift import kernel
from gripmon.judge.drift.sequential import SWEEPS

TOLERATED = np.array([5e-6] * 3 + [1e-4] * 3)
SIGMA = np.array([5e-6, 4e-6, 2e-5, 3e-4, 3e-4, 1e-4])


def square_beyond(white: np.ndarray, shift: np.ndarray, tolerated: np.ndarray) -> float:
    return kernel._square_beyond(white, shift, tolerated, SWEEPS)


def whitening(seed: int, coupling: float) -> np.ndarray:
    """(6, 6) of a covariance whose axes belong together the more the larger ``coupling`` is."""
    rng = np.random.default_rng(seed)
    factor = np.eye(6) + coupling * rng.normal(size=(6, 6))
    covariance = factor @ factor.T
    scale = SIGMA / np.sqrt(covariance.diagonal())
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance * np.outer(scale, scale))))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("coupling", "rel"), [(0.0, 1e-9), (0.3, 0.02), (1.0, 0.3)])
@pytest.mark.parametrize("size", [1.0, 5.0, 30.0])
def test_it_is_the_smallest_square_within_the_bounds(seed: int, coupling: float, rel: float, size: float):
    """Where axes are all but one, coordinate descent comes close only, from above: nothing beside limits near fifty."""
    shift, white = np.random.default_rng(100 + seed).normal(size=6) * size * SIGMA, whitening(seed, coupling)
    best = lsq_linear(white, white @ shift, (-TOLERATED, TOLERATED), tol=1e-14)
    found = square_beyond(white, shift, TOLERATED)
    assert 2.0 * best.cost * (1.0 - 1e-6) <= found <= 2.0 * best.cost * (1.0 + rel) + 0.5
    assert found <= np.square(white @ shift).sum() * (1.0 + 1e-12)


def test_within_the_tolerance_nothing_is_left_and_without_one_all_is():
    rng, white = np.random.default_rng(1), whitening(3, 1.0)
    for _ in range(50):
        assert square_beyond(white, rng.uniform(-1.0, 1.0, 6) * TOLERATED, TOLERATED) == pytest.approx(0.0, abs=1e-12)
        shift = rng.normal(size=6) * SIGMA
        assert square_beyond(white, shift, np.zeros(6)) == pytest.approx(np.square(white @ shift).sum())
