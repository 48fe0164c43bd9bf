"""The loop with stand-ins at its four seams: what it says, and to whom."""

from __future__ import annotations

import contextlib
import gc
import json
import logging
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import BinaryIO

import msgspec
import pytest
from support.daemon_bench import NEVER, Bench, pause
from support.loopback import frame_record, reference_record, state_record, wait_until
from support.stand_ins import REFUSED, ScriptedMonitor

from gripmon.daemon.estimates import EstimatesFile
from gripmon.daemon.neighbours import Reports
from gripmon.daemon.service import log_to_stderr
from gripmon.io.sources import Waiting
from gripmon.model.records import (
    Alert,
    AlertEvent,
    AlertKind,
    Cause,
    CauseWeight,
    Command,
    CommandName,
    CommandReply,
    Frame,
    FrameRecord,
    Severity,
    State,
    Verdict,
    to_json,
)


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


def test_what_waited_before_the_hand_over_counts_as_latency():
    waited = Frame(0, 5, None, arrived_ns=time.monotonic_ns() - 3 * 10**9)
    bench = Bench([waited, 1], ScriptedMonitor())
    bench.run()
    first, second = (record.latency_ns for record in bench.network.transforms)
    assert first > 3e9 and second < 3e9


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
    assert bench.alerts == [(AlertKind.SOURCE, Cause.NO_CAMERA)] * 2
    raised, cleared = bench.network.alerts
    assert (raised.event, cleared.event) == (AlertEvent.RAISED, AlertEvent.CLEARED)
    assert raised.alert_id == cleared.alert_id and raised.alert_id and raised.since_ns
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
    alert = Alert(
        AlertKind.STEP, Cause.CAMERA_MOUNT, Severity.WARNING, "moved 4.5 mm", AlertEvent.RAISED, "a-7", "left",
        (CauseWeight(Cause.CAMERA_MOUNT, 0.9),), (0.001, 0.002, 0.003), 0.02, 1e-5, 60.0, 12, True,
    )  # fmt: skip
    bench = Bench(range(3), ScriptedMonitor(lambda seq: {"alerts": (alert,)} if seq == 1 else {}))
    bench.run()
    (said,) = bench.network.alerts
    told = msgspec.structs.asdict(alert)
    assert said.seq == 1 and {name: getattr(said, name) for name in told} == told
    assert bench.recording.alerts == [said]  # which has it in the frame's own record, and knows


def test_a_new_reference_is_known_before_anything_names_it():
    alert = Alert(AlertKind.RECALIBRATED, Cause.CAMERA_MOUNT, Severity.INFO, "new reference")
    bench = Bench(range(2), ScriptedMonitor(lambda seq: {"revision": 4, "alerts": (alert,)} if seq else {}))
    bench.run()
    first = bench.network.order.index(("reference", 4))
    assert bench.network.order[first : first + 3] == [("reference", 4), ("transform", 4), ("alert", 4)]
    assert all(revision == 3 for _, revision in bench.network.order[:first])
    without_states = [told for told in bench.recording.order if told[0] != "state"]
    assert without_states == [("reference", 3), ("transform", 3), ("reference", 4), ("transform", 4), ("alert", 4)]


def test_an_alert_has_the_stamp_of_its_frame():
    alert = Alert(AlertKind.STEP, Cause.CAMERA_MOUNT, Severity.WARNING, "moved 4.5 mm")
    told: dict[int, dict[str, object] | Exception] = {1: {"alerts": (alert,)}, 2: ValueError("singular")}
    script = [0, 1, 2, pause(0.05), Waiting("unplugged"), 3]
    bench = Bench(script, ScriptedMonitor(lambda seq: told.get(seq, {})), no_camera_alert_after_s=0.04)
    bench.run()
    step, lost, missing, back, judged = bench.network.alerts
    assert [(a.kind, a.event, a.stamp_ns) for a in (step, lost, back, judged)] == [
        (AlertKind.STEP, AlertEvent.NOTED, 1_001), (AlertKind.LOST, AlertEvent.RAISED, 1_002),
        (AlertKind.SOURCE, AlertEvent.CLEARED, 1_003), (AlertKind.LOST, AlertEvent.CLEARED, 1_003),
    ]  # fmt: skip
    assert abs(missing.stamp_ns - time.time_ns()) < 60e9


def test_a_duration_ends_a_source_that_has_no_end():
    def forever() -> Iterable[object]:
        seq = 0
        while True:
            yield seq
            yield pause(0.005)
            seq += 1

    bench = Bench(forever())
    assert bench.run(duration_s=1.0) == 0
    assert 2 <= len(bench.network.transforms) <= 201


class Jaw:
    def opening_m(self, stamp_ns: int | None = None) -> float | None:
        return 0.0125

    def fault(self) -> str:
        return "2 malformed jaw messages"


def test_a_jaw_feed_replaces_the_frames_opening_and_its_fault_is_said():
    bench = Bench([Frame(0, 1, None, jaw_opening_m=0.03)])
    bench.run(jaw=Jaw())
    assert bench.monitor.frames[0].jaw_opening_m == 0.0125
    assert bench.recording.offered[0][0].jaw_opening_m == 0.0125
    assert bench.states[1] == (State.TRACKING, "2 malformed jaw messages")


def test_faults_and_counts_of_those_around_the_loop_are_said_in_the_state():
    counts = [0, 0]

    def more(_: object) -> None:
        counts[:] = [4, 3]

    reports = Reports(
        faults=(lambda: "no Zenoh session yet" if counts[0] else "", lambda: None, lambda: "2 malformed frames"),
        unsent=lambda: counts[0],
        malformed=lambda: counts[1],
    )
    bench = Bench([0, more, 1])
    bench.run(reports=reports, jaw=Jaw())
    jaw = "2 malformed jaw messages"
    assert bench.states[1:3] == [
        (State.TRACKING, f"{jaw}; 2 malformed frames"),
        (State.TRACKING, f"{jaw}; no Zenoh session yet; 2 malformed frames"),
    ]
    assert [(said.transforms_unsent, said.malformed) for said in bench.network.states[1:3]] == [(0, 0), (4, 3)]


def test_the_log_says_another_reason_for_the_same_verdict_once(caplog: pytest.LogCaptureFixture):
    """After a knock transforms stayed suspect, and the log named only the first reason, of one frame."""
    reasons = ["not yet confirmed", "may be 2.1 mm off", "may be 2.2 mm off", "a side", "may be 1.9 mm off", "a side"]

    def reasoned(seq: int) -> dict[str, object]:
        return {"verdict": Verdict.SUSPECT, "reason": reasons[seq]} if seq < len(reasons) else {}

    with caplog.at_level(logging.INFO, "gripmon"):
        Bench(range(len(reasons) + 1), ScriptedMonitor(reasoned)).run()
    said = [text.partition("transform ")[2] for text in caplog.messages if text.startswith("state tracking")]
    told = [f"suspect ({reasons[number]})" for number in (0, 1, 3)]
    assert said == [*told, "valid"], "figures change with every frame, and reasons come again"


def test_a_report_that_fails_stops_nothing(caplog: pytest.LogCaptureFixture):
    def fails() -> int:
        raise RuntimeError("the session is\nclosed")

    with caplog.at_level(logging.ERROR, logger="gripmon"):
        bench = Bench(range(4), state_period_s=1e-6)
        reports = Reports(faults=(fails, lambda: "the line is cut"), unsent=fails, malformed=fails)  # type: ignore[arg-type]
        assert bench.run(reports=reports) == 0
    assert [record.seq for record in bench.network.transforms] == [0, 1, 2, 3]
    assert bench.states[1] == (State.TRACKING, "the line is cut")
    assert caplog.messages == ["a report for the state message fails: RuntimeError: the session is closed"]


@pytest.mark.parametrize(("opened", "length"), [(os.pipe, 20), (os.pipe, 9000), (os.openpty, 20), (os.openpty, 200)])
def test_a_log_that_nobody_reads_stops_nothing_and_says_what_is_missing(
    opened: Callable[[], tuple[int, int]], length: int, monkeypatch: pytest.MonkeyPatch
):
    """A pipe, which takes 64 KiB, and a terminal, which takes some KiB and has room for less than a line then."""
    reader, writer = opened()
    os.set_blocking(reader, False)
    filler = "." * length
    with os.fdopen(writer, "w") as stream, os.fdopen(reader, "rb", buffering=0) as read:
        monkeypatch.setattr(sys, "stderr", stream)
        log_to_stderr()
        log = logging.getLogger("gripmon.test")
        for number in range(5000):
            log.info("line %d %s", number, filler)
        taken = all_of(read)
        log.info("the last one")
        log.info("one more")
        taken += all_of(read)
        logging.getLogger("gripmon").handlers.clear()
    lines = [line.split(" ", 3)[3] for line in taken.decode().splitlines() if line]
    number = lost = 0
    for line in lines[:-2]:
        if (missing := re.fullmatch(r"(\d+) lines of this log are missing: nobody read it", line)) is not None:
            number, lost = number + int(missing[1]), lost + int(missing[1])
        else:
            assert line == f"line {number} {filler}"
            number += 1
    assert number == 5000 and 0 < lost < 5000
    assert lines[-2:] == ["the last one", "one more"]


def all_of(file: BinaryIO) -> bytes:
    """What is there to be read."""
    data = b""
    while part := file.read(1 << 20):
        data += part
    return data


def write(estimates: EstimatesFile, seq: int) -> None:
    estimates.frame(Frame(seq, 1, None), frame_record(seq), lambda: None)


def test_a_disk_that_hangs_holds_no_frame_up_and_what_is_lost_is_counted(tmp_path: Path):
    """A pipe that nobody reads stands for the disk: it takes 64 KiB, then a write waits for ever."""
    path = tmp_path / "estimates.jsonl"
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    estimates = EstimatesFile(path)
    record = frame_record(0)
    for _ in range(6000):
        estimates.frame(Frame(0, 1, None), record, lambda: None)
    assert not estimates.has_room
    missing = int(re.search(r"keep up; (\d+) lines are missing", estimates.failure or "")[1])  # type: ignore[index]
    lines = 0
    reading = threading.Thread(target=estimates.close)
    reading.start()
    while reading.is_alive():
        with contextlib.suppress(BlockingIOError):
            lines += os.read(reader, 1 << 20).count(b"\n")
    with contextlib.suppress(BlockingIOError):
        lines += os.read(reader, 1 << 20).count(b"\n")
    os.close(reader)
    assert 0 < missing < 2000 and lines + missing == 6000


def test_estimates_of_an_earlier_run_are_kept(tmp_path: Path):
    path = tmp_path / "estimates.jsonl"
    for seq in (1, 2, 3):
        estimates = EstimatesFile(path)
        write(estimates, seq)
        estimates.close()
    names = ("estimates-1.jsonl", "estimates-2.jsonl", "estimates.jsonl")
    assert [json.loads((tmp_path / name).read_text())["seq"] for name in names] == [1, 2, 3]
    assert len(list(tmp_path.iterdir())) == 3


def test_estimates_are_on_disk_after_a_state_message(tmp_path: Path):
    path = tmp_path / "estimates.jsonl"
    path.write_text("old\n")
    estimates = EstimatesFile(path)
    write(estimates, 1)
    estimates.event(state_record())
    wait_until(path.read_text, "the line")
    assert [json.loads(line)["seq"] for line in path.read_text().splitlines()] == [1]
    estimates.close()
    write(estimates, 2)
    assert len(path.read_text().splitlines()) == 1


def test_estimates_stay_within_their_budget_and_the_newest_are_kept(tmp_path: Path):
    path = tmp_path / "estimates.jsonl"
    (tmp_path / "estimates-7.jsonl").write_bytes(b"an earlier run's\n" * 1000)
    (tmp_path / "estimates-x.jsonl").write_bytes(b"none of ours\n" * 10_000)
    budget_bytes = 200_000
    estimates = EstimatesFile(path, budget_bytes)
    for seq in range(300):
        write(estimates, seq)
        if seq % 3 == 2:
            estimates.event(state_record())
    estimates.close()
    files = sorted(tmp_path.glob("estimates-[0-9]*.jsonl"), key=lambda kept: int(kept.stem[10:]))
    assert files[0].name != "estimates-7.jsonl" and (tmp_path / "estimates-x.jsonl").exists()
    sizes = [kept.stat().st_size for kept in (*files, path)]
    line_bytes = len(to_json(frame_record(0))) + 3
    assert budget_bytes - 30_000 < sum(sizes) <= budget_bytes + 3 * line_bytes
    assert all(20_000 <= size < 20_000 + 4 * line_bytes for size in sizes[:-1])
    seqs = [json.loads(line)["seq"] for kept in (*files, path) for line in kept.read_text().splitlines()]
    assert seqs == list(range(seqs[0], 300)), "whole lines, in order, to the newest"


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


@pytest.mark.parametrize("wanted", [True, False])
def test_real_time_priority_is_asked_for_only_where_a_configuration_does(
    wanted: bool, caplog: pytest.LogCaptureFixture
):
    seen: list[int] = []
    with caplog.at_level(logging.INFO):
        Bench([0, lambda _: seen.append(os.sched_getscheduler(0)), 1], real_time=wanted).run()
    said = [each for each in caplog.records if each.message.startswith("real-time priority")]
    assert len(said) == wanted
    given = bool(said) and said[0].levelno == logging.INFO
    assert seen == [os.SCHED_RR if given else os.SCHED_OTHER]
    assert os.sched_getscheduler(0) == os.SCHED_OTHER


def test_it_runs_beside_the_main_thread():
    bench = Bench(range(3))
    codes: list[int] = []
    thread = threading.Thread(target=lambda: codes.append(bench.run()))
    thread.start()
    thread.join(60.0)
    assert codes == [0]


@pytest.mark.parametrize(
    ("dropped", "refused", "said"),
    [
        (0, set(), None),
        (1161, {1}, "only 26 of 1188 frames were measured (1161 dropped, because this machine was too slow, 1 refused"),
        (0, set(range(9)), "only 18 of 27 frames were measured (9 refused, because their image could not be used)"),
    ],
)
def test_a_run_that_measured_too_little_says_so_first(
    dropped: int, refused: set[int], said: str | None, caplog: pytest.LogCaptureFixture
):
    def drop(source: object) -> None:
        source.dropped = dropped  # type: ignore[attr-defined]

    with caplog.at_level("INFO", "gripmon"):
        Bench([drop, *range(27)], ScriptedMonitor(lambda seq: REFUSED if seq in refused else {})).run()
    last_two = [record.getMessage() for record in caplog.records][-2:]
    assert last_two[1] == f"stopped after 27 frames, {len(refused)} refused, {dropped} dropped"
    assert last_two[0].startswith(said) if said else "only" not in last_two[0]


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


def test_the_daemons_own_alerts_are_in_the_answers_to_commands():
    """The monitor knows nothing of a camera that is silent: `send state` said "tracking", `acknowledge` refused."""

    class Knowing(ScriptedMonitor):
        def command(self, command: Command, stamp_ns: int) -> CommandReply:
            if command.name is CommandName.STATE:
                text, state = "tracking, plate-2 in force, revision 3", self.state()
                return CommandReply(command.name, True, text, "plate-2", 3, state)
            return CommandReply(command.name, False, "no open alert that isn't acknowledged", "plate-2", 3)

    class Asked:
        def __init__(self, name: CommandName) -> None:
            self.command = Command(name)

        def answer(self, answer: CommandReply, attachment: bytes | None = None) -> None:
            answers.append(answer)

    class Asking:
        def poll(self) -> Asked | None:
            return Asked(waiting.pop(0)) if bench.network.alerts and waiting else None

    answers: list[CommandReply] = []
    waiting = 2 * [CommandName.STATE, CommandName.ACKNOWLEDGE]
    silent = [each for _ in range(12) for each in (pause(0.03), Waiting("no device"))]
    bench = Bench([0, *silent], Knowing(), stale_after_s=0.02, no_camera_alert_after_s=0.05)
    bench.run(commands=Asking())
    raised, acknowledged = bench.network.alerts
    state, seen, later, again = answers
    assert state.text == "stale, plate-2 in force, revision 3"
    assert [each.alert.kind for each in state.monitor.alerts] == [AlertKind.SOURCE]
    assert not state.monitor.alerts[0].alert.acknowledged and later.monitor.alerts[0].alert.acknowledged
    assert seen.done and seen.text == f"acknowledged: {raised.alert_id}" and not again.done
    assert acknowledged.acknowledged and acknowledged.alert_id == raised.alert_id


def test_commands_get_a_quarter_of_the_loops_time_at_most():
    """A flood of them delays frames little: the loop lives for a second, and each takes 20 ms."""
    took_s = 0.02

    class Slow(ScriptedMonitor):
        def command(self, command: Command, stamp_ns: int) -> CommandReply:
            time.sleep(took_s)
            return super().command(command, stamp_ns)

    class Asked:
        command = Command(CommandName.RESET)

        def answer(self, answer: object, attachment: bytes | None = None) -> None: ...

    class Flood:
        def poll(self) -> Asked:
            return Asked()

    bench = Bench((each for seq in range(10**6) for each in (pause(0.001), seq)), Slow())
    begun_s = time.monotonic()
    bench.run(commands=Flood(), duration_s=1.0)
    lasted_s = time.monotonic() - begun_s
    assert 0 < len(bench.monitor.obeyed) * took_s <= 0.25 * lasted_s + took_s
