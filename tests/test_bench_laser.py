"""``tools/bench laser``: trials are pure draws, bounds are those of the errors, what counts as reached."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "tools"))

from benchmarks import laser
from benchmarks.laser_trials import LASER_METHODS, REFERENCE_METHODS, Trial, paper_trial, real_trial


def test_without_noise_every_method_is_exact():
    trial = paper_trial(np.random.default_rng(1), 5, 0.0)
    assert set(trial.errors) == {*LASER_METHODS, *REFERENCE_METHODS}
    for method, error in trial.errors.items():
        assert error is not None, method
        assert max(error) < 1e-8, method


def test_wrong_spots_do_not_change_set_up_and_bound_grows_with_what_is_lost():
    clean, spoilt = (real_trial(np.random.default_rng(2), 0.5, share) for share in (0.0, 0.3))
    assert spoilt.bound[0] > clean.bound[0]
    assert spoilt.wrong_used <= 1


def test_the_summary_is_honest_about_failures_and_bounds():
    rng = np.random.default_rng(3)
    trials = [paper_trial(rng, 8, 0.3) for _ in range(8)]
    found = laser.summary(trials)
    assert found["failed"]["refined"] == 0
    assert 0.4 < found["over_bound"]["translation"] < 2.0
    with_failure = laser.summary([*trials, Trial({**trials[0].errors, "refined": None})])
    assert with_failure["failed"]["refined"] == 1
    assert with_failure["errors"]["refined"] == found["errors"]["refined"]


def test_intervals_of_the_figures_shrink_with_trials_and_hold_them():
    rng = np.random.default_rng(6)
    # Errors of exactly the bound: squared over bound is chi square of three degrees over three.
    trials = [
        Trial(
            {"refined": (0.01, 0.01)}, squared=tuple(rng.chisquare(3, 2) / 3.0), bound=(1.0, 1.0),
            covered=bool(rng.uniform() < 0.95), seconds=(0.03, 0.02), wall_s=0.06,
        )
        for _ in range(800)
    ]  # fmt: skip
    few, many = laser.summary(trials[:50]), laser.summary(trials)
    for found in (few, many):
        assert abs(found["over_bound"]["rotation"] - 1.0) < 3.0 * found["over_bound_sigma"]["rotation"]
        low, high = found["coverage_interval"]
        assert low < 0.95 < high
    # The root's delta method: sd of chi square of three over three is sqrt(2 / 3), half of that through the root.
    assert many["over_bound_sigma"]["rotation"] == pytest.approx(0.5 * np.sqrt(2.0 / 3.0 / 800), rel=0.15)
    assert few["over_bound_sigma"]["rotation"] > 2.5 * many["over_bound_sigma"]["rotation"]
    assert many["seconds"]["wall_99"] == pytest.approx(0.06)
