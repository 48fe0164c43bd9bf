"""``tools/bench causes``: trials are pure draws, and what counts as right."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "tools"))

from benchmarks import causes
from benchmarks.causes import Told
from benchmarks.causes_trials import ROWS, make_trial

from gripmon.model.records import Cause

MACHINE = {"commit": "0", "date": "today", "cpu": "one", "cpus": 1, "system": "some"}


def told(*named: tuple[Cause, str | None], ever: tuple[tuple[Cause, str | None], ...] = ()) -> Told:
    return Told(frozenset(named), frozenset(named + ever), (), "said")


@pytest.mark.parametrize(
    ("row", "said", "verdict"),
    [
        ("mount", [(Cause.CAMERA_MOUNT, None)], "right"),
        ("mount", [(Cause.LENS, None)], "wrong"),
        ("mount", [(Cause.UNKNOWN, None)], "unknown"),
        ("mount", [(Cause.CAMERA_MOUNT, None), (Cause.VIEW_BLOCKED, None)], "wrong"),
        ("mount", [], "silent"),
        ("nothing", [], "right"),
        ("nothing", [(Cause.UNKNOWN, None)], "unknown"),
        ("nothing", [(Cause.CAMERA_MOUNT, None)], "wrong"),
    ],
)
def test_what_counts(row: str, said: list[tuple[Cause, str | None]], verdict: str):
    trial = make_trial(ROWS[row], 1, 0)
    assert causes.judged(row, 0, trial, told(*said)).verdict == verdict


def test_the_other_finger_is_wrong_and_being_misled_for_a_while_is_told():
    trial = make_trial(ROWS["finger"], 1, 3)
    other = next(name for name in trial.rig.gripper.finger_ids if name != trial.part)
    assert causes.judged("finger", 3, trial, told((Cause.FINGER_BENT, other))).verdict == "wrong"
    outcome = causes.judged("finger", 3, trial, told((Cause.FINGER_BENT, trial.part), ever=((Cause.LENS, None),)))
    assert (outcome.verdict, outcome.misled) == ("right", True)


@pytest.mark.parametrize("row", ROWS)
def test_a_trial_is_a_pure_function_of_its_numbers(row: str):
    first, again, other = (make_trial(ROWS[row], 1, number) for number in (4, 4, 5))
    assert first.what == again.what and first.rig.scenario == again.rig.scenario
    np.testing.assert_array_equal(first.rig.start_cam_T_grip, again.rig.start_cam_T_grip)
    assert first.rig.scenario != other.rig.scenario
    assert (ROWS[row].cause is Cause.FINGER_BENT) == (first.part is not None)
    assert not (ROWS[row].reported and not first.rig.scenario.jaw.reported)
