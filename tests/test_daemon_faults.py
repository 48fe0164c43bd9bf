"""The loop with stand-ins at its four seams: what it survives, and what a fault costs."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest
from support.daemon_bench import Bench
from support.stand_ins import Listener, ScriptedMonitor

from gripmon.model.records import (
    AlertEvent,
    AlertKind,
    Cause,
    Origin,
    State,
    Verdict,
)


def test_one_failing_frame_is_survived_and_said(caplog: pytest.LogCaptureFixture):
    bench = Bench(range(4), ScriptedMonitor(lambda seq: ValueError("singular\nmatrix") if seq == 1 else {}))
    with caplog.at_level(logging.INFO, "gripmon"):
        assert bench.run() == 0
    assert [record.seq for record in bench.network.transforms] == [0, 1, 2, 3]
    broken = bench.network.transforms[1]
    assert (broken.verdict, broken.source, broken.cam_T_grip) == (Verdict.UNKNOWN, Origin.HELD, None)
    assert broken.reason == "internal error: ValueError: singular matrix"
    assert bench.alerts == [(AlertKind.LOST, Cause.UNKNOWN)] * 2, "raised, and cleared when it was over"
    assert (State.LOST, "internal error: ValueError: singular matrix") in bench.states
    assert bench.states[-2:] == [(State.TRACKING, ""), (State.STALE, "stopped")]
    errors = [entry for entry in caplog.records if entry.levelno >= logging.ERROR]
    assert [entry.getMessage() for entry in errors if "frame 1" in entry.getMessage()] == [
        "frame 1: internal error: ValueError: singular matrix"
    ]
    assert not any(entry.exc_info for entry in errors)


def test_errors_that_persist_end_the_daemon_with_code_3():
    bench = Bench(
        range(100), ScriptedMonitor(lambda seq: RuntimeError("broken") if seq >= 10 else {}), give_up_after_errors=5
    )
    assert bench.run() == 3
    assert [record.seq for record in bench.network.transforms] == list(range(15))
    assert bench.alerts == [(AlertKind.LOST, Cause.UNKNOWN)]
    assert (bench.source.closed, bench.network.closed, bench.recording.closed) == (1, 1, 1)


def test_errors_that_come_and_go_do_not_add_up():
    bench = Bench(
        range(40), ScriptedMonitor(lambda seq: RuntimeError("broken") if seq % 2 else {}), give_up_after_errors=2
    )
    assert bench.run() == 0


@pytest.mark.parametrize("fails", ["transform", "everything"])
def test_a_broken_output_does_not_take_the_monitor_with_it(fails: str, caplog: pytest.LogCaptureFixture):
    bench = Bench(range(100), give_up_after_errors=5)
    bench.network, bench.recording = Listener("Zenoh", fails=fails), Listener("recording", fails=fails)
    with caplog.at_level(logging.ERROR, "gripmon"):
        assert bench.run() == 0
    assert len(bench.monitor.frames) == 100
    said = [text for text in caplog.messages if text.startswith("output raised: ") and "the line is cut" in text]
    assert len(said) == 1, "an alert, once, in the log where no one else hears of it"
    if fails != "everything":
        assert bench.alerts == [(AlertKind.OUTPUT, Cause.UNKNOWN)]


def test_a_broken_recorder_costs_the_network_nothing_and_its_end_is_said(caplog: pytest.LogCaptureFixture):
    bench = Bench([0, 1, lambda _: setattr(bench.recording, "fails", ""), 2])
    bench.recording = Listener("recording", fails="transform")
    with caplog.at_level(logging.ERROR, "gripmon"):
        assert bench.run() == 0
    assert [record.seq for record in bench.network.transforms] == [0, 1, 2]
    assert [frame.seq for frame, _ in bench.recording.offered] == [2]
    fault = "recording fails: OSError: the line is cut"
    assert bench.states[1:3] == [(State.TRACKING, fault), (State.TRACKING, "")]
    assert [text for text in caplog.messages if not text.startswith("output ")] == [fault]
    assert [(alert.kind, alert.event) for alert in bench.network.alerts] == [
        (AlertKind.OUTPUT, AlertEvent.RAISED),
        (AlertKind.OUTPUT, AlertEvent.CLEARED),
    ]


def test_a_monitor_that_fails_is_alerted_though_the_network_failed_before():
    bench = Bench(
        [0, lambda _: setattr(bench.network, "fails", ""), 1],
        ScriptedMonitor(lambda seq: ValueError("singular") if seq == 1 else {}),
    )
    bench.network = Listener("Zenoh", fails="everything")
    bench.run()
    assert bench.alerts == [(AlertKind.LOST, Cause.UNKNOWN)]
    assert [reference.revision for reference in bench.network.references] == [3]  # sent again when it could be


def test_a_source_that_breaks_ends_the_daemon_with_code_3():
    bench = Bench([0, 1, RuntimeError("driver crashed"), 2])
    assert bench.run() == 3
    assert len(bench.network.transforms) == 2
    assert bench.alerts == [(AlertKind.SOURCE, Cause.NO_CAMERA)]
    assert bench.network.alerts[0].text == "the source failed: RuntimeError: driver crashed"
    assert bench.source.closed == 1


def test_a_recording_that_fails_is_said():
    bench = Bench([0])
    bench.recording.failure = "disk full"
    bench.run()
    assert bench.states[1] == (State.TRACKING, "disk full")


def test_everything_is_closed_even_if_closing_fails():
    bench = Bench([0])
    bench.recording = Listener("recording", closing_fails=True)
    with pytest.raises(RuntimeError, match="can't close"):
        bench.run()
    assert (bench.source.closed, bench.network.closed, bench.recording.closed) == (1, 1, 1)


def test_everything_is_closed_when_the_estimates_can_not_be_opened(tmp_path: Path):
    bench = Bench([0])
    with pytest.raises(FileNotFoundError):
        bench.run(estimates=tmp_path / "missing" / "estimates.jsonl")
    assert (bench.source.closed, bench.network.closed, bench.recording.closed) == (1, 1, 1)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs the device that is always full")
def test_a_full_disk_stops_the_estimates_and_nothing_else():
    bench = Bench(range(200), state_period_s=1e-9)
    assert bench.run(estimates=Path("/dev/full")) == 0
    assert len(bench.network.transforms) == 200
    assert bench.states[-2] == (State.TRACKING, "/dev/full can't be written: No space left on device")


def test_an_output_that_fails_in_everything_costs_the_others_nothing(caplog: pytest.LogCaptureFixture):
    """Nor does it count as an error of the daemon, which gives up after some; its fault is over when it works again."""
    bench = Bench([*range(8), lambda _: setattr(bench.others[0], "fails", ""), 8, 9], give_up_after_errors=3)
    bench.others = (Listener("ROS 2", fails="everything", closing_fails=False),)
    with caplog.at_level(logging.ERROR, "gripmon"):
        assert bench.run() == 0
    assert [record.seq for record in bench.network.transforms] == list(range(10))
    assert [frame.seq for frame, _ in bench.recording.offered] == list(range(10))
    assert bench.states[1:3] == [(State.TRACKING, "ROS 2 fails: OSError: the line is cut"), (State.TRACKING, "")]
    said = [text for text in caplog.messages if text.startswith("ROS 2")]
    assert set(said) == {"ROS 2 fails: OSError: the line is cut"} and len(said) == 2, "once for frames, once for events"
    late = bench.others[0]
    assert isinstance(late, Listener) and len(late.references) == 1, "told as soon as it can be"
