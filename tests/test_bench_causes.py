"""``tools/bench causes``: trials are pure draws, and what counts as right."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "tools"))

from benchmarks import causes
from benchmarks.causes_runs import Told
from benchmarks.causes_trials import ROWS, make_trial, scaled

from gripmon.model.camera import PaperLens, make_camera
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


def test_the_report_has_a_row_for_each_cause_and_says_whether_targets_are_met():
    trials = {row: make_trial(ROWS[row], 1, 0) for row in ("nothing", "mount")}
    outcomes = [causes.judged("mount", k, trials["mount"], told((Cause.CAMERA_MOUNT, None))) for k in range(98)]
    outcomes += [causes.judged("mount", 98, trials["mount"], told((Cause.LENS, None)))]
    outcomes += [causes.judged("nothing", 0, trials["nothing"], told())]
    text = causes.as_text(MACHINE, 1, outcomes)
    assert "99.0 %   met" in text and "1.0 %   met" in text and "1 wrong" in text
    outcomes += [causes.judged("mount", 99, trials["mount"], told((Cause.LENS, None)))]
    assert "NOT MET" in causes.as_text(MACHINE, 1, outcomes)


@pytest.mark.parametrize("row", ROWS)
def test_a_trial_is_a_pure_function_of_its_numbers(row: str):
    first, again, other = (make_trial(ROWS[row], 1, number) for number in (4, 4, 5))
    assert first.what == again.what and first.rig.scenario == again.rig.scenario
    np.testing.assert_array_equal(first.rig.start_cam_T_grip, again.rig.start_cam_T_grip)
    assert first.rig.scenario != other.rig.scenario
    assert (ROWS[row].cause is Cause.FINGER_BENT) == (first.part is not None)
    assert not (ROWS[row].reported and not first.rig.scenario.jaw.reported)


def test_another_focal_length_scales_the_image_about_its_principal_point():
    lens = PaperLens(
        width_px=768, height_px=576, fx_px=962.0, fy_px=950.0, cx_px=380.0, cy_px=290.0, kappa_per_px2=2e-7
    )
    points = np.random.default_rng(1).uniform([-0.04, -0.03, 0.1], [0.04, 0.03, 0.14], (50, 3))
    centre = np.array([380.0, 290.0])
    before, after = make_camera(lens).project(points), make_camera(scaled(lens, 1.02)).project(points)
    np.testing.assert_allclose(after - centre, 1.02 * (before - centre), rtol=1e-9)
