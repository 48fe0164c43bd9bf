"""``tools/bench laser``: trials are pure draws, bounds are those of the errors, what counts as reached."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "tools"))

from benchmarks import laser, laser_report
from benchmarks.laser_trials import LASER_METHODS, REFERENCE_METHODS, Trial, paper_trial, real_trial


def test_without_noise_every_method_is_exact():
    trial = paper_trial(np.random.default_rng(1), 5, 0.0)
    assert set(trial.errors) == {*LASER_METHODS, *REFERENCE_METHODS}
    for method, error in trial.errors.items():
        assert error is not None, method
        assert max(error) < 1e-8, method


def test_a_trial_depends_on_its_seed_only():
    first, again = (paper_trial(np.random.default_rng(4), 4, 0.5).errors for _ in range(2))
    assert first == again
    assert first != paper_trial(np.random.default_rng(5), 4, 0.5).errors


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


@pytest.fixture(scope="module")
def results():
    return laser.measure(
        laser.Plan(trials=2, real_trials=2, noises_px=(0.0, 0.5), orientations=(6,), wrong_shares=(0.0, 0.2))
    )


def test_the_report_has_every_point_and_verdict(results, tmp_path):
    pytest.importorskip("matplotlib")
    text = laser_report.as_text(results)
    assert "2 trials a point, seed 1" in text
    said = [line for line in text.splitlines() if line.startswith(("met ", "NOT MET"))]
    assert len(said) == len(laser_report.verdicts(results)) == 8
    laser_report.draw(results, tmp_path / "laser.png")
    assert (tmp_path / "laser.png").stat().st_size > 10_000


def test_a_figure_that_is_not_reached_is_said(results):
    import copy

    worse = copy.deepcopy(results)
    worse["noise"][1]["errors"]["refined"]["translation"]["mean"] = 0.02
    verdict = {what: met for what, _, met in laser_report.verdicts(worse)}
    assert not verdict["refined under 1 % below 1 px"]
    assert "NOT MET  refined under 1 % below 1 px: worst 2.00 %" in laser_report.as_text(worse)
