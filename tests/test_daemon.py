"""The loop with stand-ins at its four seams: what it says, to whom, and what it survives."""

from __future__ import annotations

import gc
import json
import logging
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import msgspec
import pytest
from loopback import frame_record, reference_record
from stand_ins import REFUSED, Listener, ScriptedMonitor, ScriptedSource

from gripmon.daemon import DaemonSettings, EstimatesFile, log_to_stderr, run
from gripmon.daemon.watch import Watch
from gripmon.records import (
    Alert,
    AlertKind,
    Cause,
    Frame,
    FrameRecord,
    Origin,
    Severity,
    State,
    Verdict,
)
from gripmon.sources import Waiting

NEVER = 1000.0  # seconds that no test takes


class Bench:
    """One daemon between stand-ins."""

    def __init__(self, items: Iterable[object], monitor: ScriptedMonitor | None = None, **settings: object) -> None:
        self.source = ScriptedSource(items)
        self.monitor = monitor or ScriptedMonitor()
        self.network, self.recording = Listener(), Listener()
        self.settings = DaemonSettings(**{"state_period_s": NEVER, **settings})  # type: ignore[arg-type]

    def run(self, **more: object) -> int:
        return run(
            self.monitor, self.source, self.network, self.recording, self.settings,
            robot="arm", camera="wrist", **more,  # type: ignore[arg-type]
        )  # fmt: skip

    @property
    def states(self) -> list[tuple[State, str]]:
        return [(state.state, state.message) for state in self.network.states]

    @property
    def alerts(self) -> list[tuple[AlertKind, Cause]]:
        return [(alert.kind, alert.cause) for alert in self.network.alerts]


def pause(seconds: float) -> Callable[[object], None]:
    return lambda _: time.sleep(seconds)


def test_every_frame_is_published_recorded_and_written_in_order(tmp_path: Path):
    bench = Bench(range(5))
    assert bench.run(estimates=tmp_path / "estimates.jsonl") == 0
    assert [record.seq for record in bench.network.transforms] == [0, 1, 2, 3, 4]
    assert all(record.latency_ns > 0 for record in bench.network.transforms)
    assert [(frame.seq, record) for frame, record in bench.recording.offered] == list(
        enumerate(bench.network.transforms)
    )
    lines = (tmp_path / "estimates.jsonl").read_bytes().splitlines()
    assert [msgspec.json.decode(line, type=FrameRecord) for line in lines] == bench.network.transforms
    assert bench.network.references == [reference_record(3)]
    assert (bench.source.closed, bench.network.closed, bench.recording.closed) == (1, 1, 1)


def test_latency_counts_from_the_hand_over():
    def answers(seq: int) -> dict[str, object]:
        time.sleep(0.05)
        return {}

    bench = Bench([0, pause(0.6), 1], ScriptedMonitor(answers))
    bench.run()
    assert all(0.05e9 <= record.latency_ns < 0.6e9 for record in bench.network.transforms)


def test_a_changed_state_is_said_at_once_and_an_unchanged_one_is_not():
    told = {2: State.OCCLUDED, 3: State.OCCLUDED, 4: State.TRACKING}
    bench = Bench(range(6), ScriptedMonitor(lambda seq: {"state": told.get(seq, State.TRACKING)}))
    bench.run()
    assert [(state.state, state.seq, state.frames) for state in bench.network.states] == [
        (State.ACQUIRING, -1, 0),
        (State.TRACKING, 0, 1),
        (State.OCCLUDED, 2, 3),
        (State.TRACKING, 4, 5),
        (State.STALE, 5, 6),
    ]
    assert bench.network.states[-1].verdict is Verdict.UNKNOWN
    assert [message for _, message in bench.states] == ["no frame yet", "", "", "", "stopped"]


def test_state_carries_the_counts_and_names():
    refused = {1, 3}

    def drop_two(source: object) -> None:
        source.dropped = 2  # type: ignore[attr-defined]

    bench = Bench([0, 1, drop_two, 2, 3], ScriptedMonitor(lambda seq: REFUSED if seq in refused else {}))
    bench.recording.dropped = 7
    bench.run()
    last = bench.network.states[-1]
    assert (last.frames, last.frames_refused, last.frames_dropped, last.recording_dropped) == (4, 2, 2, 7)
    assert (last.robot, last.camera, last.reference_id, last.revision) == ("arm", "wrist", "plate-2", 3)
    assert abs(last.stamp_ns - time.time_ns()) < 60e9
    assert (State.TRACKING, "frames refused: black") in bench.states


def test_an_unchanged_state_is_repeated_while_nothing_comes():
    waiting = [item for _ in range(40) for item in (pause(0.01), Waiting("silent"))]
    bench = Bench([0, *waiting], state_period_s=0.05, stale_after_s=NEVER, no_camera_alert_after_s=NEVER)
    bench.run()
    messages = [message for _, message in bench.states]
    assert messages[:2] == ["no frame yet", ""] and messages[-1] == "stopped"
    assert 3 <= len(messages) - 3 <= 40


def test_a_missing_camera_is_said_on_the_network_and_its_return_too():
    script = [0, pause(0.1), Waiting("camera 0 can't be opened"), Waiting("camera 0 can't be opened"), 1]
    bench = Bench(script, stale_after_s=0.02, no_camera_alert_after_s=0.05)
    assert bench.run() == 0
    stale = next(state for state in bench.network.states if state.state is State.STALE)
    assert not stale.camera_connected and stale.verdict is Verdict.UNKNOWN and stale.frames_per_s == 0.0
    assert stale.message == "no frames: camera 0 can't be opened"
    assert [state for state, _ in bench.states].count(State.STALE) == 2  # and at the end
    assert bench.alerts == [(AlertKind.SOURCE, Cause.NO_CAMERA), (AlertKind.RECOVERED, Cause.NO_CAMERA)]
    assert bench.network.alerts[0].severity is Severity.ERROR
    assert bench.recording.alerts == bench.network.alerts
    assert (bench.network.states[-2].state, bench.network.states[-2].camera_connected) == (State.TRACKING, True)


def test_a_camera_that_never_comes_is_a_failure_at_the_end():
    bench = Bench([pause(0.1), Waiting("no device")], stale_after_s=0.02, no_camera_alert_after_s=0.05)
    assert bench.run() == 3
    assert bench.alerts == [(AlertKind.SOURCE, Cause.NO_CAMERA)]


def test_only_refused_frames_are_a_failure_at_the_end():
    bench = Bench(range(3), ScriptedMonitor(lambda seq: REFUSED))
    assert bench.run() == 3
    assert len(bench.network.transforms) == 3


def test_alerts_of_the_monitor_go_out_with_their_frame():
    alert = Alert(AlertKind.JUMP, Cause.CAMERA_MOUNT, Severity.WARNING, "moved 4.5 mm")
    bench = Bench(range(3), ScriptedMonitor(lambda seq: {"alerts": (alert,)} if seq == 1 else {}))
    bench.run()
    (said,) = bench.network.alerts
    assert (said.seq, said.kind, said.cause, said.severity, said.text) == (1, *msgspec.structs.astuple(alert))
    assert bench.recording.alerts == []  # the frame's own record takes it there


def test_a_new_revision_is_published_and_recorded():
    bench = Bench(range(4), ScriptedMonitor(lambda seq: {"revision": 3 if seq < 2 else 4}))
    bench.run()
    assert [reference.revision for reference in bench.network.references] == [3, 4]
    assert [reference.revision for reference in bench.recording.references] == [4]
    assert (4, 2) in [(state.revision, state.seq) for state in bench.network.states]


def test_a_new_reference_is_known_before_anything_names_it():
    alert = Alert(AlertKind.RECALIBRATED, Cause.CAMERA_MOUNT, Severity.INFO, "new reference")
    bench = Bench(range(2), ScriptedMonitor(lambda seq: {"revision": 4, "alerts": (alert,)} if seq else {}))
    bench.run()
    first = bench.network.order.index(("reference", 4))
    assert bench.network.order[first : first + 3] == [("reference", 4), ("transform", 4), ("alert", 4)]
    assert all(revision == 3 for _, revision in bench.network.order[:first])
    assert bench.recording.order == [("offer", 3), ("reference", 4), ("offer", 4)]


def test_an_alert_has_the_stamp_of_its_frame():
    alert = Alert(AlertKind.JUMP, Cause.CAMERA_MOUNT, Severity.WARNING, "moved 4.5 mm")
    told: dict[int, dict[str, object] | Exception] = {1: {"alerts": (alert,)}, 2: ValueError("singular")}
    script = [0, 1, 2, pause(0.05), Waiting("unplugged"), 3]
    bench = Bench(script, ScriptedMonitor(lambda seq: told.get(seq, {})), no_camera_alert_after_s=0.04)
    bench.run()
    jump, lost, missing, back = bench.network.alerts
    assert [(a.kind, a.stamp_ns) for a in (jump, lost, back)] == [
        (AlertKind.JUMP, 1_001), (AlertKind.LOST, 1_002), (AlertKind.RECOVERED, 1_003)
    ]  # fmt: skip
    assert abs(missing.stamp_ns - time.time_ns()) < 60e9


def test_one_failing_frame_is_survived_and_said(caplog: pytest.LogCaptureFixture):
    bench = Bench(range(4), ScriptedMonitor(lambda seq: ValueError("singular\nmatrix") if seq == 1 else {}))
    with caplog.at_level(logging.INFO, "gripmon"):
        assert bench.run() == 0
    assert [record.seq for record in bench.network.transforms] == [0, 1, 2, 3]
    broken = bench.network.transforms[1]
    assert (broken.verdict, broken.source, broken.cam_T_grip) == (Verdict.UNKNOWN, Origin.HELD, None)
    assert broken.reason == "internal error: ValueError: singular matrix"
    assert bench.alerts == [(AlertKind.LOST, Cause.UNKNOWN)]
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


@pytest.mark.parametrize("fails", ["transform", "offer", "everything"])
def test_a_broken_output_is_survived_for_a_while(fails: str):
    bench = Bench(range(100), give_up_after_errors=5)
    bench.network, bench.recording = Listener(fails=fails), Listener(fails=fails)
    assert bench.run() == 3
    assert len(bench.monitor.frames) == 5


def test_a_network_fault_costs_nobody_else_anything(tmp_path: Path):
    alert = Alert(AlertKind.JUMP, Cause.CAMERA_MOUNT, Severity.WARNING, "moved 4.5 mm")
    bench = Bench(range(3), ScriptedMonitor(lambda seq: {"alerts": (alert,)}))
    bench.network = Listener(fails="transform")
    assert bench.run(estimates=tmp_path / "estimates.jsonl") == 0
    assert [frame.seq for frame, _ in bench.recording.offered] == [0, 1, 2]
    assert len((tmp_path / "estimates.jsonl").read_bytes().splitlines()) == 3
    assert [said.kind for said in bench.network.alerts] == [AlertKind.JUMP] * 3
    assert bench.network.states[-1].frames == 3
    assert bench.states[1] == (State.TRACKING, "transform not delivered: OSError: the line is cut")
    assert State.LOST not in [state for state, _ in bench.states]


def test_a_broken_recorder_costs_the_network_nothing_and_its_end_is_said(caplog: pytest.LogCaptureFixture):
    bench = Bench([0, 1, lambda _: setattr(bench.recording, "fails", ""), 2])
    bench.recording = Listener(fails="offer")
    with caplog.at_level(logging.ERROR, "gripmon"):
        assert bench.run() == 0
    assert [record.seq for record in bench.network.transforms] == [0, 1, 2]
    assert [frame.seq for frame, _ in bench.recording.offered] == [2]
    fault = "recording not delivered: OSError: the line is cut"
    assert bench.states[1:3] == [(State.TRACKING, fault), (State.TRACKING, "")]
    assert caplog.messages == [fault]


def test_a_monitor_that_fails_is_alerted_though_the_network_failed_before():
    bench = Bench(
        [0, lambda _: setattr(bench.network, "fails", ""), 1],
        ScriptedMonitor(lambda seq: ValueError("singular") if seq == 1 else {}),
    )
    bench.network = Listener(fails="everything")
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


def test_a_duration_ends_a_source_that_has_no_end():
    def forever() -> Iterable[object]:
        seq = 0
        while True:
            yield seq
            yield pause(0.005)
            seq += 1

    bench = Bench(forever())
    assert bench.run(duration_s=0.2) == 0
    assert 2 <= len(bench.network.transforms) <= 41


class Jaw:
    def opening_m(self) -> float | None:
        return 0.0125

    def fault(self) -> str:
        return "2 malformed jaw messages"


def test_a_jaw_feed_replaces_the_frames_opening_and_its_fault_is_said():
    bench = Bench([Frame(0, 1, None, jaw_opening_m=0.03)])
    bench.run(jaw=Jaw())
    assert bench.monitor.frames[0].jaw_opening_m == 0.0125
    assert bench.recording.offered[0][0].jaw_opening_m == 0.0125
    assert bench.states[1] == (State.TRACKING, "2 malformed jaw messages")


def test_without_a_feed_the_frames_opening_stays():
    bench = Bench([Frame(0, 1, None, jaw_opening_m=0.03)])
    bench.run()
    assert bench.network.transforms[0].jaw_opening_m == 0.03


def test_a_recording_that_fails_is_said():
    bench = Bench([0])
    bench.recording.failure = "disk full"
    bench.run()
    assert bench.states[1] == (State.TRACKING, "disk full")


def test_everything_is_closed_even_if_closing_fails():
    bench = Bench([0])
    bench.recording = Listener(closing_fails=True)
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


def test_estimates_are_on_disk_after_a_flush(tmp_path: Path):
    path = tmp_path / "estimates.jsonl"
    path.write_text("old\n")
    estimates = EstimatesFile(path)
    estimates.write(frame_record(1))
    estimates.flush()
    assert [json.loads(line)["seq"] for line in path.read_text().splitlines()] == [1]
    estimates.close()
    estimates.write(frame_record(2))
    assert len(path.read_text().splitlines()) == 1


def test_the_interpreter_is_left_as_it_was():
    before = (
        gc.isenabled(),
        sys.getswitchinterval(),
        signal.getsignal(signal.SIGINT),
        signal.getsignal(signal.SIGTERM),
    )
    seen: list[tuple[object, ...]] = []
    Bench([0, lambda _: seen.append((gc.isenabled(), signal.getsignal(signal.SIGTERM)))]).run()
    assert before == (
        gc.isenabled(),
        sys.getswitchinterval(),
        signal.getsignal(signal.SIGINT),
        signal.getsignal(signal.SIGTERM),
    )
    assert seen and not seen[0][0] and seen[0][1] != before[3]
    assert gc.get_freeze_count() == 0


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 0)])
def test_signals_stop_the_loop_with_their_code(number: signal.Signals, code: int):
    bench = Bench([0, lambda _: signal.raise_signal(number), 1, 2, 3])
    assert bench.run() == code
    assert [record.seq for record in bench.network.transforms] == [0, 1]


def test_it_runs_beside_the_main_thread():
    bench = Bench(range(3))
    codes: list[int] = []
    thread = threading.Thread(target=lambda: codes.append(bench.run()))
    thread.start()
    thread.join(20.0)
    assert codes == [0]


def test_lines_for_people_on_stderr(capsys: pytest.CaptureFixture[str]):
    logger = logging.getLogger("gripmon")
    before = (logger.handlers, logger.level, logger.propagate)
    try:
        log_to_stderr()
        Bench(range(3)).run()
        lines = capsys.readouterr().err.splitlines()
    finally:
        logger.handlers, logger.level, logger.propagate = before
    assert lines[0].endswith("INFO watching arm/wrist against plate-2, revision 3")
    assert any("state tracking, transform valid" in line for line in lines)
    assert lines[-1].endswith("INFO stopped after 3 frames, 0 refused, 0 dropped")


# The judgement beside the monitor, as tables: what happens (and when, in seconds) -> the alerts.

GOOD, BAD, NONE = "good", "bad", "none"
SETTINGS = DaemonSettings(stale_after_s=0.5, no_camera_alert_after_s=3.0)


@pytest.mark.parametrize(
    ("events", "alerts", "state"),
    [
        ([(0.1, GOOD), (0.2, GOOD)], [], State.TRACKING),
        ([(0.1, GOOD), (0.59, NONE)], [], State.TRACKING),
        ([(0.1, GOOD), (0.61, NONE)], [], State.STALE),
        ([(0.6, NONE)], [], State.STALE),
        ([(0.6, NONE), (2.9, NONE)], [], State.STALE),
        ([(2.0, NONE), (3.0, NONE), (9.0, NONE)], [(3.0, "source")], State.STALE),
        ([(3.0, NONE), (5.0, GOOD), (5.1, GOOD)], [(3.0, "source"), (5.0, "recovered")], State.TRACKING),
        ([(1.0, NONE), (1.5, GOOD)], [], State.TRACKING),
        ([(3.0, NONE), (4.0, GOOD), (7.1, NONE)], [(3.0, "source"), (4.0, "recovered"), (7.1, "source")], State.STALE),
        ([(1.0, BAD), (4.0, NONE), (4.1, BAD)], [(4.0, "source"), (4.1, "recovered")], State.TRACKING),
        ([(1.0, BAD), (2.9, BAD), (9.0, BAD)], [], State.TRACKING),
    ],
)  # fmt: skip
def test_what_the_watch_says(events: list[tuple[float, object]], alerts: list[tuple[float, str]], state: State):
    watch = Watch(SETTINGS, now_s=0.0)
    said: list[tuple[float, str]] = []
    for now_s, event in events:
        if event == NONE:
            due = watch.no_frame("unplugged", now_s)
        else:
            due = watch.frame(frame_record(**({} if event == GOOD else REFUSED)), now_s)
        said += [(now_s, alert.kind.value) for alert in due]
    assert said == alerts
    assert watch.state is state


def test_a_refusal_is_said_once_though_its_figures_change():
    watch = Watch(SETTINGS, now_s=0.0)
    messages = []
    for reason in ("black: at most 1 %", "black: at most 2 %", "white: at least 99 %", "white: at least 98 %"):
        watch.frame(frame_record(**(REFUSED | {"reason": reason})), now_s=1.0)
        messages.append(watch.message)
    assert messages == ["frames refused: black: at most 1 %"] * 2 + ["frames refused: white: at least 99 %"] * 2
    assert watch.frames_refused == 4
    watch.frame(frame_record(reason="too few edges agree"), now_s=1.0)
    assert watch.message == "too few edges agree"
    watch.frame(frame_record(), now_s=1.0)
    assert watch.message == ""


def test_the_rate_is_that_of_the_last_frames():
    watch = Watch(SETTINGS, now_s=0.0)
    for i in range(200):
        watch.frame(frame_record(i), now_s=10.0 + i / (30.0 if i < 100 else 50.0))
    assert watch.frames_per_s(10.0 + 199 / 50.0) == pytest.approx(50.0)
    assert watch.frames_per_s(10.0 + 199 / 50.0 + 0.6) == 0.0
    watch.frame(frame_record(200), now_s=30.0)
    watch.frame(frame_record(201), now_s=30.1)
    assert watch.frames_per_s(30.1) == pytest.approx(10.0)
