"""``tools/bench recalibration`` in small: its knocks are what they say, its trials are judged by the truth, its report
counts.
"""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytestmark = pytest.mark.usefixtures("tools_importable")


@pytest.mark.slow("5 s: a benchmark in small; new references are tested with the monitor")
def test_knocks_are_what_was_drawn_and_always_the_same():
    from benchmarks import knocks

    drawn = [knocks.draw_knock(3, number) for number in range(40)]
    assert {k.also for k in drawn} == set(knocks.ALSO) and len({k.gripper for k in drawn}) == 4
    assert len({k.background for k in drawn}) > 6 and {k.jaw for k in drawn} == set(knocks.JAWS)
    sizes = np.array([[np.linalg.norm(k.xi[:3]), np.linalg.norm(k.xi[3:])] for k in drawn])
    assert (sizes <= [knocks.LARGEST_M, knocks.LARGEST_RAD]).all()
    assert (sizes.max(axis=0) > [0.8 * knocks.LARGEST_M, 0.8 * knocks.LARGEST_RAD]).all()
    for knock in drawn[:8]:
        before, after = (knock.simulator.truth(k).cam_T_grip for k in (knocks.BEFORE - 1, knocks.BEFORE))
        turn = Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).as_rotvec()
        np.testing.assert_allclose(np.concatenate([after[:3, 3] - before[:3, 3], turn]), knock.xi, atol=1e-9)
        later = knock.simulator.truth(knocks.BEFORE + 60).cam_T_grip
        np.testing.assert_allclose(later, after, atol=1e-12)
    again = knocks.draw_knock(3, 7)
    assert again.words == drawn[7].words
    np.testing.assert_array_equal(again.simulator.render(4), drawn[7].simulator.render(4))


@pytest.mark.slow("5 s: a benchmark in small; new references are tested with the monitor")
def test_a_trial_ends_with_an_answer_that_is_held_against_the_truth():
    from benchmarks import recalibration

    outcome = recalibration.trial(1, 9)
    assert outcome.answer in recalibration.ANSWERS and 1 <= outcome.frames <= recalibration.AFTER
    assert (outcome.error_m is not None) == (outcome.answer in ("accepted", "person"))
    if outcome.error_m is not None and outcome.sigma_m is not None:
        assert 0.0 < outcome.error_m < 6.0 * outcome.sigma_m


def test_the_report_counts_by_hand():
    from benchmarks.recalibration import Outcome, as_text

    outcomes = [
        Outcome(0, "a", "nothing", "accepted", "", 21, 1e-5, 1e-5),
        Outcome(1, "b", "nothing", "accepted", "", 23, 4.9e-5, 1e-5),
        Outcome(2, "c", "defocus", "accepted", "", 25, 5.1e-5, 1.7e-5),
        Outcome(3, "d", "defocus", "person", "the TCP is uncertain by 0.034 mm, more than 0.017 mm", 20, 3e-5, 3e-5),
        Outcome(4, "e", "nothing", "refused", "few_corners", 20),
        Outcome(5, "f", "nothing", "lost", "", 15),
    ]
    machine = {"commit": "c", "date": "d", "cpu": "p", "cpus": 2, "system": "s"}
    text = as_text(machine, 7, outcomes)
    rows = {
        line[:20].strip(): line[20:].split() for line in text.splitlines() if re.match(r"^(nothing|defocus|all) ", line)
    }
    assert rows["nothing"] == ["4", "2", "0", "0", "1", "0", "0", "1", "0"]
    assert rows["defocus"] == ["2", "0", "1", "1", "0", "0", "0", "0", "0"]
    assert rows["all"] == ["6", "2", "1", "1", "1", "0", "0", "1", "0"]
    assert "WRONG by 0.051 mm: trial 2, c" in text and "NOT MET" in text
    assert "within 0.05 mm: 2 of 3" in text and "frames until accepted: median 23" in text
    # Clopper and Pearson for 1 of 6, from the binomial distribution by hand: 5 % where P(at most 1 of 6) = 0.05.
    chance = 0.5818
    assert (1 - chance) ** 6 + 6 * chance * (1 - chance) ** 5 == pytest.approx(0.05, abs=1e-3)
    assert "wrong: 1 of 6 trials, at most 58.18 %" in text
    fine = as_text(machine, 7, outcomes[:2])
    assert "   met" in fine and "NOT MET" not in fine
