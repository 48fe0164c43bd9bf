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
        "reference_m": [None] * n,
        "absolute_m": [1e-4] * n,
        "absolute_error_m": [1e-5] * n,
        "nees": [6.0] * n,
        "why": [""] * n,
        "valid_by": "absolute",
        "knock": None,
        "moved_alerts": [],
        "commit": "abc",
        "grey_dn": 100.0,
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


def test_figures_count_scenes_and_the_worst_excess():
    from benchmarks.integrity_stats import figures

    beyond = {"error_m": [1e-5] * 3 + [1.2e-4, 1.4e-4] + [1e-5] * 5}
    crash = line(condition="one finger: crash", error_m=[1e-5] * 5 + [9e-3] * 5)
    out = figures([line(**beyond), line(scene=1, **beyond), line(scene=2), crash])
    assert (out["unbounded"], out["unbounded_scenes"], out["lies"], out["lies_scenes"]) == (9, 3, 5, 1)
    assert out["worst_excess"] == pytest.approx(90.0)
    # A crash is in no promise; its 5 frames and its scene are not among these.
    kept = out["promised"]
    assert (kept["scenes"], kept["frames"], kept["lies"], kept["unbounded"], kept["unbounded_scenes"]) == (
        3,
        27,
        0,
        4,
        2,
    )
    assert kept["worst_excess"] == pytest.approx(1.4)
    # Two of three scenes, exactly: the p with P(at most 2 of 3) = 0.05 is that with p³ = 0.95.
    assert kept["unbounded_scenes_at_most"] == pytest.approx(0.95 ** (1.0 / 3.0))


@pytest.mark.parametrize(
    ("condition", "valid_by", "promised"),
    [
        ("tips worn", "absolute", False),
        ("one finger: tips worn", "absolute", False),
        ("tips worn", "reference", True),
        ("crash", "reference", False),
        ("bump", "absolute", True),
    ],
)
def test_the_promise_leaves_out_a_closed_list(condition: str, valid_by: str, promised: bool):
    from benchmarks import integrity_stats

    assert integrity_stats.promised(line(condition=condition, valid_by=valid_by)) is promised


def test_frames_from_a_knock_until_it_is_said_found_and_valid():
    from benchmarks.integrity_stats import Knock, knock_of

    # A jump of 2 mm before frame 3; measured within 0.5 mm from frame 5 on, held before; said at 6; valid from 7.
    errors = [1e-5] * 3 + [2e-3, 1e-4] + [1e-4] * 5
    nees = [6.0] * 3 + [6.0, None] + [6.0] * 5
    scene = line(
        knock=[3, 2e-3], error_m=errors, nees=nees, moved_alerts=[1, 6], valid=[True] * 3 + [False] * 4 + [True] * 3
    )
    assert knock_of(scene) == Knock(said=4.0, found=3.0, valid=3.0)
    assert knock_of(line(knock=[3, 2e-3], error_m=[2e-3] * 10)) == Knock(np.inf, np.inf, np.inf)
    assert knock_of(line()) is None and knock_of(line(knock=[-2, 2e-3])) is None


def test_alert_limits_are_data_and_follow_the_scale():
    from benchmarks import integrity_limits
    from benchmarks.integrity_limits import frozen_limits

    at_6, at_8 = (frozen_limits("two_box_fingers", False, scale) for scale in (6.0, 8.0))
    # The exponents and limits of the file, by hand.
    assert at_6.position_m == pytest.approx(2.64e-3)
    assert at_8.position_m == pytest.approx(2.64e-3 * (8.0 / 6.0) ** -1.11)
    assert at_6.rotation_rad == pytest.approx(0.035)
    # Never above 5 mm and 5 degrees, nor below 1 mm and 2 degrees.
    assert frozen_limits("two_box_fingers, one", True, 3.0) == integrity_limits.AlertLimits(5e-3, 0.0873)
    assert frozen_limits("rounded_fingers", True, 12.0) == integrity_limits.AlertLimits(1e-3, 0.035)
    with pytest.raises(KeyError, match="no limits of hand"):
        frozen_limits("hand", True, 6.0)


def test_the_monitor_that_is_judged_gets_the_frozen_limits():
    from benchmarks.integrity_practice import CONDITIONS
    from benchmarks.integrity_runs import _settings, _simulated
    from benchmarks.integrity_scenes import make_integrity_scene

    by_name = {condition.name: condition for condition in CONDITIONS}
    watched = _simulated(make_integrity_scene(by_name["pads"], 3, 0, 20))
    settings = _settings(watched)
    assert (settings.policy.alert_limit_m, settings.policy.alert_limit_rad) == (2.52e-3, 0.035)
    assert settings.corners.edges.response == "srgb"
    assert (watched.sequence.camera.width_px, watched.sequence.camera.height_px) == (1280, 720)


class _Bound:
    position_m, rotation_rad, since, since_ns = 1e-4, 2e-3, "reference", 0


class _Record:
    """As a record of schema 2."""

    def __init__(self, valid_by: str = "reference", stamp_ns: int = 0, since: _Bound | None = None):
        self.valid_by, self.stamp_ns, self.protection, self.absolute = valid_by, stamp_ns, _Bound(), None
        self.since_reference = since or _Bound()


def test_by_the_reference_its_own_error_is_no_error():
    from benchmarks.integrity_runs import Truth

    from gripmon.model.geometry import exp_rotation, make_transform, perturb

    true_start = make_transform(exp_rotation(np.array([0.5, 0.0, 0.1])), np.array([0.01, 0.0, 0.1]))
    wrong = perturb(true_start, np.array([1e-3, -2e-3, 5e-4, 0.01, 0.0, -0.02]))
    # The mount turns by a rotation and shifts the TCP: the reference, moved likewise, is right.
    motion = np.array([3e-3, 1e-3, -2e-3, 0.02, -0.01, 0.03])
    now = perturb(true_start, motion)
    truth = Truth(wrong, true_start)
    assert np.allclose(truth.of(_Record(), now), perturb(wrong, motion), atol=1e-12)  # type: ignore[arg-type]
    assert np.array_equal(truth.of(_Record("absolute"), now), now)  # type: ignore[arg-type]
    # Since the first proved frame, stamp 7: what moved before it is not in it.
    proved = _Bound()
    proved.since, proved.since_ns = "first_proved", 7
    assert np.allclose(truth.of(_Record(stamp_ns=7, since=proved), now), wrong, atol=1e-12)  # type: ignore[arg-type]
    later = perturb(now, motion)
    assert np.allclose(truth.of(_Record(stamp_ns=8, since=proved), later), perturb(wrong, motion), atol=1e-12)  # type: ignore[arg-type]


def test_valid_frames_beyond_the_absolute_bound_are_counted_whatever_makes_them_valid():
    from benchmarks.integrity_stats import figures

    error_m = [1e-5] * 3 + [2e-4, 2e-4] + [1e-5] * 5
    valid = [True] * 4 + [False] + [True] * 5
    assert figures([line(absolute_error_m=error_m, valid=valid), line()])["beyond_absolute"] == [1, 1]


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
    from benchmarks.kit import at_least, at_most

    assert at_most(0, 100_000) == pytest.approx(1.0 - 0.05 ** (1e-5), rel=1e-6)
    assert at_most(3, 3) == 1.0 and 0.0 < at_most(1, 100) < 0.05
    assert at_least(97, 100) == pytest.approx(1.0 - at_most(3, 100)) and at_least(0, 5) == 0.0


def test_the_least_possible_level_is_that_of_the_worst_axis():
    from benchmarks.integrity_runs import normal_level_m

    covariance = np.diag([1e-10, 4e-10, 1e-12, 1.0, 1.0, 1.0])
    assert normal_level_m(covariance, 1e-5) == pytest.approx(4.417 * 2e-5, rel=1e-3)


@pytest.mark.slow("10 s: a benchmark in small; the figures that it computes are tested beside it")
def test_a_whole_run_in_small_goes_on_where_it_was_cut_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    from benchmarks import integrity
    from benchmarks.__main__ import main

    state, file = tmp_path / "state.jsonl", tmp_path / "integrity.json"
    asked = ["--only", "grasp", "model off", "--scenes", "1", "--frames", "8", "--seed", "2", "--jobs", "1"]
    monkeypatch.setattr("sys.argv", ["bench", "integrity", *asked, "--resume", str(state), "--json", str(file)])
    main()
    first = integrity.read_lines(state)
    assert sorted((line["condition"], line["scene"], len(line["view"])) for line in first.values()) == [
        ("grasp", 0, 8),
        ("model off", 0, 8),
    ]
    kept = state.read_text().splitlines()
    # The first line is marked: if it comes back, it was not run again.  The second was cut off: it is.
    marked = {**json.loads(kept[0]), "seconds": 12345.0}
    state.write_text("\n".join([json.dumps(marked), kept[1][:50]]))
    main()
    more = integrity.read_lines(state)
    assert sorted(line["seconds"] == 12345.0 for line in more.values()) == [False, True]
    assert all(line["error_m"] == first[key]["error_m"] for key, line in more.items())
    text = capsys.readouterr().out
    for word in ("| model off ", "| grasp ", "MISSED", "--seed 2 --scene 0", marked["commit"]):
        assert word in text
    assert json.loads(file.read_text())["total"]["scenes"] == 2


def test_two_revisions_stand_in_each_cell(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    from benchmarks import integrity
    from benchmarks.kit import Report

    before = line(commit="old", valid=[True] * 5 + [False] * 5)
    integrity._compare([line(), line(scene=1)], [before, line(scene=7)], Report("tools/bench integrity"))
    text = capsys.readouterr().out
    assert "old → abc, seed 1, 1 scenes of both" in text and "1 scenes only here" in text
    assert "44.4 → 100.0" in text and "valid in both 4, only before 0, only after 5, in neither 0" in text


def test_a_picture_has_each_frame(tmp_path: Path):
    pytest.importorskip("matplotlib")
    from benchmarks import integrity_plots

    integrity_plots.draw([line(), line(scene=1)], tmp_path / "all.png")
    assert (tmp_path / "all.png").stat().st_size > 5000
