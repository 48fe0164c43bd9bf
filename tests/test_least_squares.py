"""The one least-squares minimiser: recovery of simulated truth, honest covariances, outliers, manifolds, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from gripmon.model.least_squares import (
    TUKEY,
    chi_square_limit,
    covariance_of,
    fit,
    minimise,
    normal_equations,
    robust_scale,
    tukey_cost,
    tukey_weights,
    whitening,
)

TIMES = np.linspace(0.0, 3.0, 60)
TRUE = np.array([2.0, 1.3, 0.5])


def decay(unknown: np.ndarray) -> np.ndarray:
    return unknown[0] * np.exp(-unknown[1] * TIMES) + unknown[2]


def decay_rows(unknown: np.ndarray) -> np.ndarray:
    falling = np.exp(-unknown[1] * TIMES)
    return np.stack([falling, -unknown[0] * TIMES * falling, np.ones_like(TIMES)], axis=1)


def linearised(seen: np.ndarray, sigma: float):
    return lambda unknown: (decay_rows(unknown) / sigma, (seen - decay(unknown)) / sigma)


def test_gross_outliers_hardly_move_a_robust_fit():
    rng, sigma = np.random.default_rng(3), 0.02
    seen = decay(TRUE) + rng.normal(0.0, sigma, len(TIMES))
    wrong = rng.choice(len(TIMES), 8, replace=False)
    dirty = seen.copy()
    dirty[wrong] += rng.choice([-1.0, 1.0], 8) * rng.uniform(0.5, 2.0, 8)
    width = TUKEY * sigma

    def sizes(unknown: np.ndarray) -> np.ndarray:
        return np.abs(dirty - decay(unknown))

    def equations(unknown: np.ndarray, wide: float = width):
        values = (dirty - decay(unknown))[:, None]
        return normal_equations(decay_rows(unknown)[:, None, :], values, tukey_weights(sizes(unknown), wide))

    start = fit(np.array([1.0, 0.5, 0.0]), linearised(dirty, sigma), np.add).state
    assert np.abs(start - TRUE).max() > 0.05, "without robustness the outliers are felt"
    for scale in (4.0, 2.0, 1.0):
        wide = width * scale
        start = minimise(
            start,
            lambda x, w=wide: tukey_cost(sizes(x), w),
            lambda x, w=wide: equations(x, w),
            np.add,
        ).state
    normal, _ = equations(start)
    assert (start - TRUE) @ normal @ (start - TRUE) / sigma**2 < chi2.ppf(0.999, 3)


@pytest.mark.parametrize("size", [0.0, 0.3, 1.0, 2.9])
def test_the_weight_is_the_losss_slope(size: float):
    step, width = 1e-5, 3.0
    slope = (tukey_cost(np.array([size + step]), width) - tukey_cost(np.array([size - step]), width)) / (2.0 * step)
    assert slope == pytest.approx(2.0 * size * tukey_weights(np.array([size]), width)[0], abs=1e-8)


def test_far_and_infinite_residuals_have_no_weight_and_a_finite_cost():
    sizes = np.array([3.0, 50.0, np.inf])
    assert tukey_weights(sizes, 3.0).tolist() == [0.0, 0.0, 0.0]
    assert tukey_cost(sizes, 3.0) == pytest.approx(3 * 3.0)


@pytest.mark.parametrize("dimensions", [1, 2, 3, 6])
def test_the_robust_scale_is_one_coordinates_deviation_though_a_quarter_is_wrong(dimensions: int):
    rng = np.random.default_rng(4)
    sizes = np.linalg.norm(rng.normal(0.0, 0.7, (20_000, dimensions)), axis=1)
    assert robust_scale(sizes, dimensions) == pytest.approx(0.7, rel=0.02)
    sizes[: len(sizes) // 4] = 1e6
    assert 0.7 < robust_scale(sizes, dimensions) < 1.1


def test_states_that_are_not_allowed_are_not_entered():
    """The minimum lies behind a wall: it ends before it, wherever the steps would lead."""
    entered = []

    def cost(x: np.ndarray) -> float:
        entered.append(float(x[0]))
        return (x[0] - 3.0) ** 2 if x[0] < 1.0 else np.inf

    found = minimise(np.zeros(1), cost, lambda x: (np.eye(1), np.array([3.0 - x[0]])), np.add, tolerance=1e-6)
    assert 0.99 < found.state[0] < 1.0 and max(entered) >= 1.0


def test_directions_without_information_stay_where_they_are():
    rows = np.array([[1.0, 0.0], [2.0, 0.0]])
    found = fit(np.array([0.0, 7.0]), lambda x: (rows, np.array([1.0, 2.0]) - rows @ x), np.add)
    np.testing.assert_allclose(found.state, [1.0, 7.0], atol=1e-9)
    with pytest.raises(np.linalg.LinAlgError, match="undetermined"):
        covariance_of(normal_equations(rows, np.zeros(2))[0])


def test_columns_of_very_different_units_don_t_matter():
    units = np.array([1e-6, 1.0, 1e5])
    seen = decay(TRUE)
    found = fit(
        np.array([1.0, 0.5, 0.0]) / units,
        lambda x: (decay_rows(x * units) * units, seen - decay(x * units)),
        np.add,
    )
    np.testing.assert_allclose(found.state * units, TRUE, rtol=1e-9)


def test_whitened_errors_are_independent_with_unit_variance():
    covariance = np.array([[4.0, 1.0], [1.0, 2.0]])
    root = whitening(covariance)
    np.testing.assert_allclose(root @ covariance @ root.T, np.eye(2), atol=1e-14)


@pytest.mark.parametrize(("chance", "dimensions"), [(1e-6, 6), (0.05, 6), (1e-3, 2)])
def test_a_chi_square_limit_is_what_normal_errors_exceed_by_chance(chance: float, dimensions: int):
    from scipy.stats import chi2

    assert chi2.sf(chi_square_limit(chance, dimensions), dimensions) == pytest.approx(chance, rel=1e-9)
