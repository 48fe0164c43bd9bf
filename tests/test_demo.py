"""The demo: what it promises, what it names, and how it compares with the truth."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import socket
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from support.gripmon_process import gripmon

from gripmon.analyse.comparison import compare
from gripmon.cli import main
from gripmon.daemon import simulated as demo
from gripmon.model.geometry import from_record, make_transform, to_record
from gripmon.model.records import (
    Alert,
    AlertEvent,
    AlertKind,
    Cause,
    FrameRecord,
    Origin,
    Severity,
    State,
    Verdict,
    to_json,
)
from gripmon.simulate import FrameTruth


def test_the_demo_keeps_what_it_promises(tmp_path: Path):
    """At few frames a second: what a busy machine drops of an event is no reason not to notice it."""
    out = tmp_path / "demo"
    done = gripmon("demo", "--seconds", "20", "--fps", "6", "--out", out)
    assert done.returncode == 0, done.stderr
    summary = json.loads((out / "summary.json").read_text())
    records = [
        msgspec.json.decode(line, type=FrameRecord) for line in (out / "estimates.jsonl").read_bytes().splitlines()
    ]
    assert len(list(out.glob("*.rrd"))) == 1 and summary["recordings"] == ["demo-0001.rrd"]
    assert summary["frames"] == len(records) > 20
    assert summary["transforms_received"] == summary["frames"]
    comparison = summary["comparison"]
    assert comparison["without_correction"]["across_mm"]["max"] > 4.0
    assert comparison["after_correction"]["across_mm"]["p95"] < 0.02
    assert comparison["after_correction"]["along_mm"]["p95"] < 0.06
    assert comparison["after_correction"]["frames"] > 0.6 * len(records)
    assert {"creep", "bump", "occlusion"} <= {event["event"] for event in comparison["events"]}
    assert all((event["noticed_after_s"] is None) == event["harmless"] for event in comparison["events"])
    assert "after correction" in done.stdout and re.search(r"look at it \S*rerun \S*demo-0001.rrd", done.stdout)
    assert re.search(r"report +\S*gripmon report \S+/demo-0001.rrd --out \S+/report.html", done.stdout)


def test_the_demo_takes_another_port_when_the_usual_one_is_taken(monkeypatch: pytest.MonkeyPatch):
    with socket.create_server(("127.0.0.1", 0)) as server:
        taken = server.getsockname()[1]
        monkeypatch.setattr(demo, "_ZENOH_PORT", taken)
        (other,) = demo.demo_config(4.0).settings.publish.listen
        assert other.startswith("tcp/127.0.0.1:") and other != f"tcp/127.0.0.1:{taken}"
    assert demo.demo_config(4.0).settings.publish.listen == (f"tcp/127.0.0.1:{taken}",)


def test_without_a_line_of_estimates_it_has_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(demo.Demo, "run", lambda *_, **__: (0, None))
    assert main(["demo", "--fps", "6", "--out", str(tmp_path)]) == 3
    assert capsys.readouterr().err.endswith(f"no frame is in {tmp_path}/estimates.jsonl; the log above says why\n")


def test_a_disk_that_fills_up_costs_a_line_and_the_file_not_the_summary(tmp_path: Path):
    records = [record(seq, (0.0, 0.0, 0.0)) for seq in range(6)]
    (tmp_path / "estimates.jsonl").write_bytes(b"\n".join(to_json(each) for each in records)[:-9])
    (tmp_path / "summary.json").mkdir()
    simulator = SimpleNamespace(truth=truth, scenario=SimpleNamespace(fps=10.0))
    summary = demo._summarise(tmp_path, simulator, 6, live=False)
    assert summary is not None and summary.frames == 5


def record(seq: int, error_m: tuple[float, float, float], **changes: Any) -> FrameRecord:
    transform = to_record(make_transform(np.eye(3), np.array([0.0, 0.0, 0.1]) + truth_shift_m(seq) + error_m))
    values: dict[str, Any] = {
        "seq": seq, "stamp_ns": seq, "verdict": Verdict.VALID, "state": State.TRACKING, "source": Origin.UPDATE,
        "cam_T_grip": transform, "covariance": None, "smoothed": None, "drift": None, "reference_id": "r",
        "revision": 0, "rms_px": None, "jaw_opening_m": None, "corners": (), "alerts": (),
    }  # fmt: skip
    return FrameRecord(**{**values, **changes})


def truth_shift_m(seq: int) -> np.ndarray:
    return np.array([0.003, 0.004, 0.0]) if seq >= 4 else np.zeros(3)


def truth(seq: int) -> FrameTruth:
    shift_m = truth_shift_m(seq)
    reference = make_transform(np.eye(3), np.array([0.0, 0.0, 0.1]))
    moved = make_transform(np.eye(3), reference[:3, 3] + shift_m)
    events = (("bumped",) if seq >= 4 else ()) + (("hand",) if seq in (7, 8) else ())
    return FrameTruth(
        index=seq, time_s=0.1 * seq, stamp_ns=seq, cam_T_grip=moved, reference_cam_T_grip=reference,
        tcp_shift_m=shift_m, jaw_opening_m=0.0, jaw_reported_m=None,
        corner_ids=(), corner_uv_px=np.zeros((0, 2)), hidden=(), finger_bend=np.zeros((0, 4, 4)),
        events=events, exposure=1.0, defocus_px=0.0,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("alerts", "noticed"),
    [
        ([("raised", "info", "step")], True),
        ([("cleared", "info", "step")], False),
        ([("updated", "warning", "creep")], False),
        ([("updated", "error", "creep")], True),
        ([("updated", "warning", "step")], True),
        ([("noted", "warning", "restarted")], False),
        ([("noted", "warning", "recalibrated")], False),
        ([("cleared", "info", "step"), ("raised", "warning", "occluded")], True),
    ],
)
def test_of_alerts_what_is_new_or_worse_is_noticed(alerts: list[tuple[str, str, str]], noticed: bool):
    """A creep was told of, as a warning, before the bump at frame 4."""

    def alert(event: str, severity: str, kind: str) -> Alert:
        name = "1-creep" if event != "raised" or kind == "creep" else "2-new"
        return Alert(AlertKind(kind), Cause.UNKNOWN, Severity(severity), "", event=AlertEvent(event), alert_id=name)

    records = [record(i, (0.0, 0.0, 0.0)) for i in range(7)]
    records[1] = record(1, (0.0, 0.0, 0.0), alerts=(alert("raised", "warning", "creep"),))
    records[5] = record(5, (0.0, 0.0, 0.0), alerts=tuple(alert(*each) for each in alerts))
    [bump] = compare(records, truth).events
    assert bump.noticed_after_s == (pytest.approx(0.1) if noticed else None)


def test_the_comparison_counts_by_hand():
    jump = Alert(AlertKind.STEP, Cause.CAMERA_MOUNT, Severity.WARNING, "it moved")
    recalibrated = Alert(AlertKind.RECALIBRATED, Cause.UNKNOWN, Severity.INFO, "a new reference")
    records = [record(i, (3e-6, 4e-6, -2e-6)) for i in range(4)]
    records += [record(4, (3e-6, 4e-6, -2e-6), alerts=(recalibrated,))]
    records += [record(5, (0.0, 0.0, 1e-5), alerts=(jump,)), record(6, (1.0, 1.0, 1.0), verdict=Verdict.SUSPECT)]
    records += [
        record(7, (1.0, 0.0, 0.0), source=Origin.HELD),
        record(8, (0.0, 0.0, 0.0), state=State.OCCLUDED, cam_T_grip=None),
    ]
    result = compare(records, truth)
    assert result.verdicts == {"valid": 8, "suspect": 1, "unknown": 0}
    assert result.without_correction.across_mm.max == pytest.approx(5.0)
    assert result.after_correction.frames == 6, "suspect, held and missing transforms are not counted"
    assert result.after_correction.across_mm.mean == pytest.approx(5 * 5e-3 / 6)
    assert result.after_correction.along_mm.max == pytest.approx(1e-2)
    assert result.smoothed.frames == 0 and result.smoothed.across_mm.mean is None
    bump, occlusion = result.events
    assert (bump.event, bump.frames, occlusion.event, occlusion.frames) == ("bump", 3, "occlusion", 2)
    assert bump.noticed_after_s == pytest.approx(0.1)
    assert bump.alerts == ("recalibrated (unknown)", "step (camera_mount_moved)"), "in order; the first is no alarm"
    assert occlusion.noticed_after_s is None and occlusion.alerts == ()
    assert from_record(records[0].cam_T_grip)[2, 3] == pytest.approx(0.1 - 2e-6)  # type: ignore[arg-type]


def test_frames_before_the_first_event_are_compared():
    result = compare([record(i, (3e-6, 4e-6, -2e-6)) for i in range(2)], truth)
    assert result.frames == 2 and result.events == ()


@pytest.mark.parametrize(("last", "slow"), [(11, False), (1187, True)])
def test_a_demo_that_dropped_too_much_says_so_first(tmp_path: Path, last: int, slow: bool):
    """What the figures are worth comes before them, as after 27 of 1188 frames, in which no event was noticed."""
    from gripmon.cli.start import _as_text

    records = [record(seq, (0.0, 0.0, 0.0)) for seq in (*range(7), 9, last)]
    records += [record(seq, (0.0, 0.0, 0.0), source=Origin.HELD) for seq in (7, 8)]  # covered by the hand
    records.sort(key=lambda each: each.seq)
    (tmp_path / "estimates.jsonl").write_bytes(b"".join(msgspec.json.encode(each) + b"\n" for each in records))
    simulator = SimpleNamespace(truth=truth, scenario=SimpleNamespace(fps=30.0))
    summary = demo._summarise(tmp_path, simulator, 11, live=True)  # type: ignore[arg-type]
    assert summary is not None and (summary.camera_fps, summary.frames) == (30.0, 11)
    assert json.loads((tmp_path / "summary.json").read_text())["caution"] == summary.caution
    first = _as_text(summary, tmp_path).splitlines()[1]
    few = "only 9 of 1186 frames were measured (1177 dropped, because this machine was too slow)"
    assert first.startswith(few) == bool(summary.caution) == slow
    assert "camera     30 frames/s" in _as_text(summary, tmp_path)


def test_the_demo_names_what_there_is_to_ask(tmp_path: Path):
    from gripmon.cli.start import _report_line

    out = tmp_path / "a shift"
    asked = shlex.split(_report_line([str(out / "demo-0001.rrd"), str(out / "demo-0002.rrd")], out))
    assert Path(asked[1]).name == "gripmon" and shutil.which(asked[1])
    assert asked[2:] == [
        "report", str(out / "demo-0001.rrd"), str(out / "demo-0002.rrd"), "--out", str(out / "report.html"),
    ]  # fmt: skip
    assert "none was written" in _report_line([], out)
