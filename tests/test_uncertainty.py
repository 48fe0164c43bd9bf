"""The claimed covariance of the joint fit against the spread of its errors, by sampling."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from test_robust_fit import EDGES, NO_FLOORS, PREDICTION, PRIOR, REPORTED, SAMPLES, XI, candidates, votes_for

from gripmon.track.edges.robust_fit import assess, fit_irls

EDGE, STRETCH = PREDICTION.layout.edge, PREDICTION.layout.stretch
NO_JAW = XI * [1, 1, 1, 1, 1, 1, 0]
Noise = Callable[[np.random.Generator], np.ndarray]


def nees(noise: Noise, assumed_px: float, edge_spread_px: float = 0.0, trials: int = 300) -> np.ndarray:
    """Squared normalised errors of six parameters and a jaw that is where it is reported."""
    rng, out = np.random.default_rng(2), []
    for _ in range(trials):
        found = candidates(np.arange(SAMPLES), PREDICTION.jacobian @ NO_JAW + noise(rng), assumed_px)
        edgels = votes_for(found, NO_FLOORS, edge_spread_px=np.full(EDGES, edge_spread_px))
        consensus = fit_irls(edgels, REPORTED, np.zeros(7), NO_FLOORS)
        covariance = assess(edgels, consensus, PRIOR).covariance[:6, :6]
        error = (consensus.xi - NO_JAW)[:6]
        out.append(error @ np.linalg.solve(covariance, error))
    return np.array(out)


def independent(rng: np.random.Generator, sigma_px: float = 0.1) -> np.ndarray:
    return rng.normal(scale=sigma_px, size=SAMPLES)


def outliers(rng: np.random.Generator) -> np.ndarray:
    noise = independent(rng)
    gross = rng.random(SAMPLES) < 0.01
    noise[gross] += rng.choice([-1.0, 1.0], np.count_nonzero(gross)) * rng.uniform(0.5, 4.0, np.count_nonzero(gross))
    return noise


def neighbours_together(rng: np.random.Generator) -> np.ndarray:
    return independent(rng) + rng.normal(scale=0.15, size=STRETCH.max() + 1)[STRETCH]


def edges_together(rng: np.random.Generator) -> np.ndarray:
    return independent(rng) + rng.normal(scale=0.08, size=EDGES)[EDGE]


@pytest.mark.parametrize(
    ("noise", "assumed_px", "edge_spread_px"),
    [
        pytest.param(independent, 0.1, 0.0, id="as assumed"),
        pytest.param(independent, 0.05, 0.0, id="twice as large as assumed"),
        pytest.param(independent, 0.15, 0.0, id="smaller than assumed"),
        pytest.param(outliers, 0.1, 0.0, id="one per cent gross outliers"),
        pytest.param(neighbours_together, 0.1, 0.0, id="neighbours err together"),
        pytest.param(edges_together, 0.1, 0.08, id="whole edges err together"),
    ],
)
def test_errors_have_the_spread_of_the_claimed_covariance(noise: Noise, assumed_px: float, edge_spread_px: float):
    """The jaw's opening is estimated with a prior that holds here exactly, so that six are at most what is expected."""
    found = nees(noise, assumed_px, edge_spread_px)
    assert 4.0 < np.mean(found) < 7.5
    assert np.mean(found < 22.46) >= 0.98, "of which 99.9 % should lie inside"
