"""``tools/bench integrity``: its scenes, its figures of known frames, and a whole run in small."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gripmon.model.records import Alert, AlertEvent, AlertKind, Cause, Severity

pytestmark = pytest.mark.usefixtures("tools_importable")


def line(**columns: Any) -> dict[str, Any]:
    """A scene of ten frames, all good, with other columns where given."""
    n = 10
    good: dict[str, Any] = {
        "condition": "made up",
        "seed": 1,
        "scene": 0,
        "asked": n,
        "limit_m": 5e-4,
        "limit_rad": 0.02,
        "false_alerts": [],
        "seconds": 1.0,
        "view": [0] * n,
        "enough": [True] * n,
        "valid": [True] * n,
        "error_m": [1e-5] * n,
        "error_rad": [1e-4] * n,
        "level_m": [1e-4] * n,
        "level_rad": [1e-3] * n,
        "floor_m": [5e-5] * n,
        "nees": [6.0] * n,
        "why": [""] * n,
    }
    return {**good, **columns}


def test_figures_of_good_frames_leave_out_the_first():
    from benchmarks.integrity_stats import figures

    out = figures([line(valid=[False] + [True] * 9, error_m=[1.0] + [1e-5] * 9)])
    assert (out["scenes"], out["frames"], out["lies"], out["unbounded"], out["suspect_unbounded"]) == (1, 9, 0, 0, 0)
    assert out["available"] == [1.0, None, None, None]
    assert out["level_over_error"] == pytest.approx(10.0) and out["nees"] == pytest.approx(6.0)


def test_misleading_frames_are_counted_by_kind():
    from benchmarks.integrity_stats import figures, worst

    error_m = [1e-5, 2e-4, 6e-4, 6e-4, 1e-5, 1e-5, 1e-5, 1e-5, 1e-5, 1e-5]
    error_rad = [1e-4] * 5 + [5e-3] + [1e-4] * 4
    level_m = [1e-4, 1e-4, 1e-4, 1e-4, None, *[1e-4] * 5]
    valid = [True, True, True, False, True, *[True] * 5]
    lines = [line(error_m=error_m, error_rad=error_rad, level_m=level_m, valid=valid), line(scene=1)]
    out = figures(lines)
    # Frame 1 and 2 beyond their levels, 2 beyond the limit, too; 3 is suspect; 4 has no level; 5 is turned too far.
    assert (out["lies"], out["unbounded"], out["suspect_unbounded"], out["misleading_scenes"]) == (1, 3, 1, 1)
    found = worst(lines)
    assert (found[0]["scene"], found[0]["frame"], found[0]["misleading"]) == (0, 2, 3)


@pytest.mark.parametrize(
    ("kind", "cause", "event", "wrong", "false"),
    [
        (AlertKind.STEP, Cause.CAMERA_MOUNT, AlertEvent.RAISED, (), True),
        (AlertKind.STEP, Cause.CAMERA_MOUNT, AlertEvent.RAISED, (Cause.CAMERA_MOUNT,), False),
        (AlertKind.VIBRATION, Cause.CAMERA_MOUNT, AlertEvent.RAISED, (), False),
        (AlertKind.GRIPPER, Cause.FINGER_BENT, AlertEvent.UPDATED, (Cause.CAMERA_MOUNT,), True),
        (AlertKind.GRIPPER, Cause.FINGER_BENT, AlertEvent.CLEARED, (), False),
        (AlertKind.LENS, Cause.LENS, AlertEvent.RAISED, (Cause.LENS,), False),
        (AlertKind.OCCLUDED, Cause.VIEW_BLOCKED, AlertEvent.RAISED, (), False),
    ],
)
def test_an_alert_is_false_that_newly_names_what_is_not_wrong(
    kind: AlertKind, cause: Cause, event: AlertEvent, wrong: tuple[Cause, ...], false: bool
):
    from benchmarks.integrity_runs import is_false

    assert is_false(Alert(kind, cause, Severity.ERROR, "", event=event), wrong) == false


def test_a_valid_frame_without_a_level_misleads():
    from benchmarks.integrity_stats import figures

    assert figures([line(level_m=[None] * 10, level_rad=[None] * 10)])["unbounded"] == 9


@pytest.mark.parametrize(
    ("valid", "back"),
    [
        ([1, 0, 0, 0, 1, 1, 1, 1, 1, 1], 1.0),
        ([1, 0, 0, 0, 0, 0, 1, 1, 1, 1], 1.0),
        ([1, 0, 0, 0, 0, 0, 0, 1, 1, 1], 0.0),
        ([1, 0, 0, 0, 0, 0, 0, 0, 0, 0], 0.0),
    ],
)
def test_back_within_three_frames_after_the_view_is_free(valid: list[int], back: float):
    from benchmarks.integrity_stats import figures

    out = figures([line(view=[0, 1, 2, 3, 0, 0, 0, 0, 0, 0], valid=[bool(v) for v in valid])])
    assert (out["freed"], out["back"]) == (1, back)
    assert out["asked"] == [4, 1, 1, 1]  # frames 4 and 5 count as what was asked of being back


def test_the_bound_on_a_rate_is_exact():
    from benchmarks.integrity_stats import upper_bound

    assert upper_bound(0, 100_000) == pytest.approx(1.0 - 0.05 ** (1e-5), rel=1e-6)
    assert upper_bound(3, 3) == 1.0 and 0.0 < upper_bound(1, 100) < 0.05


def test_the_least_possible_level_is_that_of_the_worst_axis():
    from benchmarks.integrity_runs import normal_level_m

    covariance = np.diag([1e-10, 4e-10, 1e-12, 1.0, 1.0, 1.0])
    assert normal_level_m(covariance, 1e-5) == pytest.approx(4.417 * 2e-5, rel=1e-3)


@pytest.mark.slow("10 s: a benchmark in small; the figures that it computes are tested beside it")
def test_scenes_of_all_conditions_can_be_made_and_come_back_the_same():
    from benchmarks.integrity_practice import CONDITIONS
    from benchmarks.integrity_scenes import make_integrity_scene
    from benchmarks.outline_seen import outline_seen

    assert len({condition.name for condition in CONDITIONS}) == len(CONDITIONS)
    for condition in CONDITIONS:
        for number in range(4):
            scene = make_integrity_scene(condition, 5, number, 96)
            simulator, first = scene.simulator, scene.first
            assert 15.0 <= simulator.scenario.fps <= 30.0
            if not first:
                seen = [outline_seen(simulator, index) for index in (0, 14)]
                assert all(s.tips.min() > 0.99 and s.edges.min() > 0.99 for s in seen), condition.name
            truth = simulator.truth(first)
            assert 0.0 < np.linalg.norm(scene.start_cam_T_grip[:3, 3] - truth.cam_T_grip[:3, 3]) < 6e-4
            again = make_integrity_scene(condition, 5, number, 96)
            assert again.simulator.scenario == simulator.scenario
            assert np.array_equal(again.simulator.truth(40).cam_T_grip, simulator.truth(40).cam_T_grip)


@pytest.mark.slow("10 s: a benchmark in small; the figures that it computes are tested beside it")
def test_conditions_hide_what_they_say():
    from benchmarks.integrity_practice import CONDITIONS
    from benchmarks.integrity_runs import View, _view
    from benchmarks.integrity_scenes import make_integrity_scene

    by_name = {condition.name: condition for condition in CONDITIONS}

    def share(name: str, view: View) -> float:
        scenes = [make_integrity_scene(by_name[name], 3, number, 96) for number in range(10)]
        return float(np.mean([_view(scene, 48 if not scene.first else scene.first) is view for scene in scenes]))

    assert share("ordinary", View.FREE) == share("mirror", View.FREE) == share("rim beside", View.FREE) == 1.0
    assert share("box over one", View.ONE_TIP) > 0.6
    assert share("rim over tips", View.NO_TIP) > 0.5 and share("big grasp", View.NO_TIP) > 0.6
    assert share("grasp", View.BOTH_TIPS) > 0.6


@pytest.mark.slow("10 s: a benchmark in small; the figures that it computes are tested beside it")
def test_a_whole_run_in_small_goes_on_where_it_was_cut_off(tmp_path: Path):
    from benchmarks import integrity, integrity_report, integrity_table

    state = tmp_path / "state.jsonl"
    plan = integrity.Plan(only=("grasp", "model off"), scenes=1, frames=8, seed=2, jobs=1, state=state)
    lines = integrity.measure(plan)
    assert [(one["condition"], one["scene"], len(one["view"])) for one in lines] == [
        ("model off", 0, 8),
        ("grasp", 0, 8),
    ]
    kept = state.read_text().splitlines()
    # The first line is marked: if it comes back, it was not run again.  The second is of a version that didn't count
    # false alerts, and cut off besides: it is.
    marked = {**json.loads(kept[0]), "seconds": 12345.0}
    old = {key: value for key, value in json.loads(kept[1]).items() if key != "false_alerts"}
    state.write_text("\n".join([json.dumps(marked), json.dumps(old), kept[1][:50]]))
    more = integrity.measure(plan)
    assert sorted(one["seconds"] == 12345.0 for one in more) == [False, True]
    assert [one["error_m"] for one in more] == [one["error_m"] for one in lines]
    assert len(integrity.read_lines(state)) == 2

    results = integrity_report.summarize(more, plan.seed, plan.scenes, plan.frames)
    text = integrity_table.as_text(results)
    for word in ("model off", "grasp", "MISSED", "--seed 2 --scene 0", results["commits"][0]):
        assert word in text
    assert "frame" in integrity_table.frame_lines(more[0])[1]
    pytest.importorskip("matplotlib")
    (tmp_path / integrity_report.PICTURES).mkdir()
    integrity_report.write(results, more, tmp_path)
    report = (tmp_path / "integrity.md").read_text()
    for picture in ("all", "conditions_1"):
        assert f"(integrity/{picture}.png)" in report
        assert (tmp_path / "integrity" / f"{picture}.png").stat().st_size > 5000
    assert json.loads((tmp_path / "integrity.json").read_text())["total"]["scenes"] == 2
