"""``tools/bench accuracy``: its scenes, what it makes of errors and covariances, and a whole run in small."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from gripmon.model.geometry import exp_rotation, make_transform, perturb, to_record
from gripmon.model.records import (
    Frame,
    FrameRecord,
    Origin,
    Protection,
    ReferenceRecord,
    State,
    Verdict,
    unmeasured_record,
)

TRUTH = make_transform(exp_rotation(np.array([0.5, 0.1, -0.2])), np.array([0.001, -0.002, 0.11]))
FRAME = Frame(3, 0, np.zeros((4, 4), np.uint8), 0.03)
REFERENCE = ReferenceRecord("first", 1, 0, "configuration", to_record(TRUTH), tuple(np.eye(6).ravel().tolist()))

pytestmark = pytest.mark.usefixtures("tools_importable")


def record(error: np.ndarray, covariance: np.ndarray, source: Origin = Origin.UPDATE) -> FrameRecord:
    """A published transform of which the truth is ``perturb(transform, error)``."""
    estimate = TRUTH.copy()
    estimate[:3, 3] -= error[:3]
    estimate[:3, :3] = exp_rotation(-error[3:]) @ TRUTH[:3, :3]
    assert np.allclose(perturb(estimate, error), TRUTH, atol=1e-12)
    blank = unmeasured_record(FRAME, REFERENCE, None, verdict=Verdict.VALID, state=State.TRACKING)
    flat = tuple(covariance.ravel().tolist())
    return msgspec.structs.replace(blank, cam_T_grip=to_record(estimate), covariance=flat, source=source)


def test_errors_and_their_squared_norm_follow_the_published_convention():
    """t_true = t + rho, R_true = exp(omega) R, and chi-square of six degrees of freedom for sampled errors."""
    from benchmarks.accuracy_runs import judge
    from benchmarks.scenes import Shot

    rng = np.random.default_rng(1)
    mixing = rng.normal(0.0, 1.0, (6, 6)) * np.array([1e-5] * 3 + [1e-4] * 3)[:, None]
    covariance = mixing @ mixing.T
    shot = Shot(FRAME, TRUTH, 0.03, True)
    nees = []
    for _ in range(400):
        error = mixing @ rng.normal(0.0, 1.0, 6)
        row = judge(record(error, covariance), shot, 0, 3, 1.0)
        assert np.allclose(row.error, error, atol=1e-10)
        nees.append(row.nees)
    assert np.mean(nees) == pytest.approx(6.0, abs=5.0 * np.sqrt(12.0 / 400))
    held = judge(record(np.full(6, 1e-3), covariance, Origin.HELD), shot, 0, 3, 1.0)
    assert np.isnan(held.error).all() and held.misleading  # 1.7 mm off, with a verdict of valid
    bounded = msgspec.structs.replace(record(np.full(6, 2e-4), covariance), protection=Protection(3e-4, 1.0, 1e-5, ""))
    assert judge(bounded, shot, 0, 3, 1.0).misleading  # 0.35 mm off, by its own bound at most 0.3
    assert not judge(record(np.full(6, 2e-4), covariance), shot, 0, 3, 1.0).misleading


def track(error_um: np.ndarray, **changes: Any) -> Any:
    from benchmarks.accuracy_runs import Track

    n = len(error_um)
    error = np.column_stack([1e-6 * error_um, np.zeros((n, 3))])
    columns: dict[str, Any] = {
        "scene": np.arange(n) // 10,
        "frame": np.arange(n) % 10,
        "judged": np.ones(n, bool),
        "valid": np.ones(n, bool),
        "misleading": np.zeros(n, bool),
        "error": error,
        "smoothed": error[:, :3],
        "nees": np.full(n, 6.0),
        "time_ms": np.linspace(1.0, 2.0, n),
    }
    return Track(**{**columns, **changes})


def test_figures_of_known_errors():
    from benchmarks.accuracy_runs import figures

    error_um = np.zeros((100, 3))
    error_um[:, 0] = np.tile([1.0, -3.0], 50)
    error_um[:, 2] = np.arange(100.0)
    out = figures(track(error_um), 30.0, (2.0, 5.0, 25.0), always_seen=True, standing=False)
    assert out["mean_um"] == pytest.approx([2.0, 0.0, 49.5])
    assert out["p95_um"] == pytest.approx([3.0, 0.0, 94.05])
    assert out["max_um"] == pytest.approx([3.0, 0.0, 99.0])
    assert (out["frames"], out["scenes"], out["measured"], out["valid"], out["misleading"]) == (100, 10, 1.0, 1.0, 0.0)
    assert out["median_ms"] == pytest.approx(1.5)
    assert out["verdict"] == "2.0 x the limit"


@pytest.mark.parametrize(
    ("change", "verdict"),
    [
        ({}, "met"),
        ({"error": np.full((20, 6), np.nan)}, "lost 100.0 %"),
        ({"misleading": np.arange(20) == 19}, "misleading 5.0 %"),
        ({"nees": np.full(20, 8.0)}, "covariance too small"),
        ({"nees": np.full(20, 1.0)}, "covariance too large"),
        ({"nees": np.array([5.0] * 19 + [40.0])}, "covariance too small"),
        ({"nees": np.array([3.0] * 19 + [40.0])}, "covariance too small"),
    ],
)
def test_verdicts(change: dict[str, Any], verdict: str):
    from benchmarks.accuracy_runs import figures

    out = figures(track(np.ones((20, 3)), **change), 30.0, (2.0, 2.0, 2.0), always_seen=True, standing=False)
    assert out["verdict"] == verdict


def test_a_misleading_transform_counts_also_where_errors_do_not():
    from benchmarks.accuracy_runs import figures

    unjudged = track(np.ones((20, 3)), judged=np.arange(20) > 10, misleading=np.arange(20) == 4)
    out = figures(unjudged, 30.0, None, always_seen=True, standing=False)
    assert out["misleading"] == pytest.approx(0.05) and out["verdict"] is None


@pytest.mark.slow("15 s: a benchmark in small; the figures that it computes are tested beside it")
def test_every_condition_has_enough_frames_and_its_scenes_can_be_made():
    from benchmarks.conditions import CONDITIONS, FPS
    from benchmarks.scenes import make_scene

    assert len({condition.name for condition in CONDITIONS}) == len(CONDITIONS)
    for condition in CONDITIONS:
        unjudged = max(1, int(np.ceil(condition.judged_s * FPS)))
        assert condition.scenes * (condition.frames - unjudged) >= 200, condition.name
        for number in range(3):
            scene = make_scene(condition, 1, number, condition.frames)
            first, last = scene.simulator.truth(0), scene.simulator.truth(condition.frames - 1)
            visible = [why for why in first.hidden if why not in (None, "self", "carrier")]
            assert not visible or condition.missing_finger, condition.name
            assert np.isfinite(last.corner_uv_px).all()
            start_error_m = scene.start_cam_T_grip[:3, 3] - first.cam_T_grip[:3, 3]
            assert 0.0 < np.linalg.norm(start_error_m) < (15e-4 if condition.taught else 5e-4)
            assert (scene.taught is not None) == condition.taught


@pytest.mark.slow("15 s: a benchmark in small; the figures that it computes are tested beside it")
def test_a_whole_run_in_small_leaves_its_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    from benchmarks.__main__ import main

    file = tmp_path / "accuracy.json"
    asked = ["accuracy", "--only", "clean", "jaw exact", "--scenes", "2", "--frames", "4", "--jobs", "1"]
    monkeypatch.setattr("sys.argv", ["bench", *asked, "--json", str(file)])
    assert main() == 0
    ours = json.loads(file.read_text())["rows"]["clean"]["ours"]["edges"]
    assert ours["frames"] == 6 and ours["scenes"] == 2 and ours["measured"] == 1.0
    assert max(ours["mean_um"]) < 20.0
    text = capsys.readouterr().out
    for word in ("| clean ", "clean, by corners", "clean, cornerSubPix", "clean, rapid", "aruco", "0.5 / 1.5 / 2.5"):
        assert word in text
