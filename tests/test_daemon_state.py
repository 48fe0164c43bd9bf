"""What the loop keeps and when, and commands between frames; stand-ins for monitor, source, network and disk."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable

import pytest
from support.daemon_bench import Bench
from support.loopback import frame_record, reference_record, wait_until
from support.stand_ins import ScriptedMonitor

from gripmon.daemon import loop as daemon_loop
from gripmon.daemon.keeping import StateKeeper
from gripmon.io.sources import Waiting
from gripmon.model.records import (
    Alert,
    AlertKind,
    Cause,
    Command,
    CommandError,
    CommandFault,
    CommandName,
    CommandReply,
    MonitorState,
    OpenAlert,
    RecordedCommand,
    Severity,
)

UNDO = Command(CommandName.UNDO)
REFUSED_COMMAND = Command(CommandName.ACCEPT, "p-1")


class Disk:
    """Takes states; notes in ``order``, shared with the network's stand-in, which revision was written when."""

    def __init__(self, order: list[tuple[str, int]] | None = None, *, full: bool = False) -> None:
        self.order = [] if order is None else order
        self.states: list[MonitorState] = []
        self.full = full
        self.closed = 0
        self.slow: threading.Event | None = None
        self.writing = threading.Event()

    @property
    def failure(self) -> str:
        return "state not kept: disk full" if self.full else ""

    def write(self, state: MonitorState) -> bool:
        self.writing.set()
        if self.slow is not None:
            assert self.slow.wait(20.0)
        if not self.full:
            self.states.append(state)
            self.order.append(("kept", state.references[-1].revision))
        return not self.full

    def close(self) -> None:
        self.closed += 1


class Asker:
    """A feed of commands, and those who asked."""

    def __init__(self, commands: Iterable[Command], order: list[tuple[str, int]] | None = None) -> None:
        self.waiting = list(commands)
        self.answers: list[CommandReply | CommandError] = []
        self.order = [] if order is None else order

    def poll(self) -> _Asked | None:
        return _Asked(self.waiting.pop(0), self) if self.waiting else None


class _Asked:
    def __init__(self, command: Command, asker: Asker) -> None:
        self.command, self._asker = command, asker

    def answer(self, answer: CommandReply | CommandError) -> None:
        self._asker.answers.append(answer)
        self._asker.order.append(("answer", getattr(answer, "revision", -1)))


def revisions(disk: Disk) -> list[int]:
    return [state.references[-1].revision for state in disk.states]


def test_a_reference_is_kept_before_it_is_published_or_named():
    bench = Bench(range(4), ScriptedMonitor(lambda seq: {"revision": 3 if seq < 2 else 4}))
    disk = Disk(bench.network.order)
    assert bench.run(keeper=StateKeeper(disk)) == 0
    order = bench.network.order
    for revision in (3, 4):
        names = [what for what, number in order if number == revision]
        assert names[:2] == ["kept", "reference"] and "transform" in names[2:]
    assert disk.closed == 1


def test_what_is_no_reference_is_kept_after_the_transform():
    monitor = ScriptedMonitor()

    def answers(seq: int) -> dict[str, object]:
        monitor.state_revision += seq == 2
        return {}

    monitor.answers = answers
    bench = Bench([0, 1, 2, lambda _: wait_until(lambda: len(disk.states) == 2, "the writer"), 3, 4], monitor)
    disk = Disk(bench.network.order)
    bench.run(keeper=StateKeeper(disk))
    order = [what for what, _ in bench.network.order if what in ("transform", "kept")]
    assert order[0] == "kept" and "kept" not in order[1:4]  # at the start, then after the third frame
    assert order.count("kept") == 3  # and at the end
    assert bench.monitor.state_revision == 1


def test_a_slow_disk_holds_up_no_frame_for_an_alert_and_the_newest_state_wins():
    monitor = ScriptedMonitor()

    def answers(seq: int) -> dict[str, object]:
        monitor.state_revision += 1
        return {}

    monitor.answers = answers

    def slow_now(_: object) -> None:
        disk.writing.clear()
        disk.slow = threading.Event()

    def released(_: object) -> None:
        assert len(bench.network.transforms) == 50, "the frames did not wait"
        assert disk.slow is not None
        disk.slow.set()

    bench = Bench([slow_now, *range(50), released], monitor)
    disk = Disk()
    bench.run(keeper=StateKeeper(disk))
    assert 2 <= len(disk.states) <= 6, "what was overtaken is not written"


def test_an_older_state_never_replaces_a_newer_one():
    disk = Disk()
    keeper = StateKeeper(disk)
    old, new = (MonitorState((reference_record(revision),)) for revision in (1, 2))
    disk.slow = threading.Event()
    keeper.soon(old)
    assert disk.writing.wait(20.0)
    both = threading.Thread(target=keeper.now, args=(new,))
    both.start()
    time.sleep(0.02)
    disk.slow.set()
    both.join()
    keeper.close()
    assert revisions(disk) == [1, 2]


def test_a_full_disk_is_said_stops_nothing_and_is_tried_again(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("gripmon.daemon.keeping.RETRY_S", 0.01)

    def freed(_: object) -> None:
        disk.full = False
        wait_until(lambda: disk.states, "the state to be kept")

    bench = Bench(
        [0, 1, 2, freed, 3], ScriptedMonitor(lambda seq: {"revision": 3 if seq < 1 else 4}), state_period_s=1e-6
    )
    disk = Disk(full=True)
    assert bench.run(keeper=StateKeeper(disk)) == 0
    assert [record.seq for record in bench.network.transforms] == [0, 1, 2, 3]
    messages = [message for _, message in bench.states]
    assert messages[1] == "state not kept: disk full" and messages[-2:] == ["", "stopped"]
    assert revisions(disk)[0] == 4


def test_a_disk_that_stays_full_does_not_keep_it_from_stopping():
    bench = Bench(range(2))
    begun_s = time.monotonic()
    assert bench.run(keeper=StateKeeper(Disk(full=True))) == 0
    assert time.monotonic() - begun_s < 10.0


def test_a_monitor_that_can_not_tell_its_state_goes_on():
    monitor = ScriptedMonitor(lambda seq: {"revision": 3 + seq})
    monitor.state = lambda: 1 / 0  # type: ignore[method-assign,return-value,assignment]
    bench = Bench(range(3), monitor)
    assert bench.run(keeper=StateKeeper(Disk())) == 0
    assert len(bench.network.transforms) == 3
    assert "ZeroDivisionError" in bench.states[2][1]


def test_the_state_message_says_which_alerts_are_open():
    class Alarmed(ScriptedMonitor):
        def state(self) -> MonitorState:
            raised = Alert(AlertKind.DRIFT, Cause.UNKNOWN, Severity.WARNING, "off", alert_id="1-a", since_ns=5)
            return MonitorState((self.reference,), alerts=(OpenAlert("drift", raised),) * (self.reference.revision > 3))

    bench = Bench(range(3), Alarmed(lambda seq: {"revision": 3 if seq < 1 else 4}), state_period_s=1e-6)
    assert bench.run() == 0
    said = [[alert.alert_id for alert in state.open_alerts] for state in bench.network.states]
    assert said == [[], [], ["1-a"], ["1-a"], ["1-a"]]
    shift_m = frame_record().drift.tcp_shift_m
    assert [state.tcp_shift_m for state in bench.network.states] == [None, shift_m, shift_m, shift_m, None]


def test_notices_of_the_start_are_alerts_behind_the_reference():
    notice = Alert(AlertKind.RESTARTED, Cause.UNKNOWN, Severity.WARNING, "set aside")
    bench = Bench(range(1))
    bench.run(notices=[notice])
    assert [(alert.kind, alert.text) for alert in bench.network.alerts] == [(AlertKind.RESTARTED, "set aside")]
    assert [alert.text for alert in bench.recording.alerts] == ["set aside"]
    assert [what for what, _ in bench.network.order][:2] == ["reference", "alert"]


# --- commands ---


@pytest.fixture(autouse=True)
def no_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    """These frames take no time, of which commands would get a quarter."""
    monkeypatch.setattr(daemon_loop, "_COMMAND_PAUSE_RATIO", 0.0)


def test_a_command_is_kept_and_published_before_it_is_answered():
    bench = Bench(range(3))
    asker = Asker([UNDO], bench.network.order)
    disk = Disk(bench.network.order)
    bench.run(keeper=StateKeeper(disk), commands=asker)
    assert [what for what, revision in bench.network.order if revision == 4][:3] == ["kept", "reference", "answer"]
    assert asker.answers == [CommandReply(CommandName.UNDO, True, "as you like", "plate-2", 4)]
    ((command, stamp_ns),) = bench.monitor.obeyed
    assert command == UNDO and abs(stamp_ns - time.time_ns()) < 60e9
    assert bench.recording.commands == [
        RecordedCommand(stamp_ns, -1, CommandName.UNDO, "", done=True, text="as you like")
    ]


def test_one_command_a_frame_also_while_none_comes():
    bench = Bench([0, 1, Waiting("silent"), Waiting("silent"), 2])
    asker = Asker([UNDO] * 4)
    bench.run(commands=asker)
    assert [answer.revision for answer in asker.answers] == [4, 5, 6, 7]
    assert [record.seq for record in bench.network.transforms] == [0, 1, 2]
    assert [reference.revision for reference in bench.network.references] == [3, 4, 5, 6, 7]


def test_a_refused_command_changes_and_keeps_nothing():
    bench = Bench(range(2))
    asker, disk = Asker([REFUSED_COMMAND]), Disk()
    bench.run(keeper=StateKeeper(disk), commands=asker)
    assert asker.answers == [CommandReply(CommandName.ACCEPT, False, "not so", "plate-2", 3)]
    assert len(bench.network.references) == 1 and len(disk.states) == 2  # at the start and at the end


def test_a_command_that_breaks_is_answered_and_the_loop_goes_on():
    bench = Bench(range(3))
    asker = Asker([Command(CommandName.UNDO, "fail"), UNDO])
    assert bench.run(commands=asker) == 0
    broken, done = asker.answers
    told = [(command.seq, command.done, command.text) for command in bench.recording.commands]
    assert told == [(-1, False, "internal error: RuntimeError: out of order"), (0, True, "as you like")]
    assert broken == CommandError(CommandFault.INTERNAL, "internal error: RuntimeError: out of order")
    assert isinstance(done, CommandReply) and done.done
    assert len(bench.network.transforms) == 3


def test_an_answer_says_when_what_was_done_can_not_be_kept():
    bench = Bench(range(2))
    asker = Asker([UNDO])
    bench.run(keeper=StateKeeper(Disk(full=True)), commands=asker)
    (answer,) = asker.answers
    assert answer.text == "as you like; but state not kept: disk full" and not answer.durable


def test_a_chain_that_cannot_be_kept_is_not_tried_again():
    disk = Disk(full=True)
    keeper = StateKeeper(disk)
    known = MonitorState((reference_record(1),), alerts_raised=7)
    keeper.now(known)
    longer = (*known.references, reference_record(2))
    assert keeper.references(longer) == "state not kept: disk full"
    disk.full = False
    wait_until(lambda: disk.states, "what was given to keep")
    assert disk.states == [known]
    assert keeper.references(longer) == "" and StateKeeper(None).references(longer) == ""
    assert disk.states[1:] == [MonitorState(longer, alerts_raised=7)]
    keeper.close()


def test_a_disk_that_hangs_delays_a_reference_and_no_frame():
    """It isn't in force before it is on the disk; what the disk gets too late doesn't stay there."""
    disk, known = Disk(), MonitorState((reference_record(1),))
    keeper = StateKeeper(disk)
    keeper.now(known)
    disk.slow = threading.Event()
    longer = (*known.references, reference_record(2))
    started_s = time.monotonic()
    assert keeper.references(longer) == "state not kept: the disk doesn't answer"
    assert time.monotonic() - started_s < 10.0 and keeper.failure
    disk.slow.set()
    wait_until(lambda: len(disk.states) == 3, "what was known")
    assert revisions(disk) == [1, 2, 1] and not keeper.failure
    assert keeper.references(longer) == ""
    assert revisions(disk) == [1, 2, 1, 2]
    keeper.close()


def test_an_asker_who_is_gone_disturbs_nobody():
    bench = Bench(range(3))
    asker = Asker([UNDO])
    asker.answers = None  # type: ignore[assignment]
    assert bench.run(commands=asker) == 0
    assert len(bench.network.transforms) == 3
