"""Disks that are full, read-only or don't answer: the loop goes on, someone is told, and recording comes back."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
from support.daemon_bench import Bench
from support.recorded import Recorded, frame, record, recorder, trace, wait_until

from gripmon.daemon.watch import DaemonSettings, Watch
from gripmon.model.records import AlertEvent, AlertKind, Severity
from gripmon.record.container import is_complete
from gripmon.record.health import SILENT, SILENT_AFTER_S, Health
from gripmon.record.write import ProcessRecorder

LONG_S = 60.0


def command(*arguments: str) -> None:
    subprocess.run(arguments, check=True, capture_output=True)


@pytest.fixture
def freezable_disk(tmp_path: Path) -> Iterator[Path]:
    """An ext4 in a file, which fsfreeze can stop."""
    tools = [shutil.which(name) for name in ("mkfs.ext4", "fsfreeze", "mount")]
    place, file = tmp_path / "disk", tmp_path / "disk.img"
    place.mkdir()
    try:
        if None in tools:
            raise OSError
        with file.open("wb") as whole:
            whole.truncate(64_000_000)
        command("mkfs.ext4", "-q", "-F", str(file))
        command("mount", "-o", "loop", str(file), str(place))
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("mounting a file as ext4, or freezing it, is not possible here")
    yield place
    subprocess.run(["fsfreeze", "--unfreeze", str(place)], check=False, capture_output=True)
    command("umount", "--lazy", str(place))


def offer(writer: ProcessRecorder, first: int, count: int) -> None:
    for i in range(first, first + count):
        writer.frame(frame(i), record(i), partial(trace, i))


def offer_and_wait(writer: ProcessRecorder, first: int, count: int) -> None:
    written = writer.frames_written
    offer(writer, first, count)
    wait_until(lambda: writer.frames_written == written + count, LONG_S)


def test_a_disk_that_doesn_t_answer(freezable_disk: Path) -> None:
    writer = recorder(freezable_disk, queue_frames=50)
    offer_and_wait(writer, 0, 20)
    first = writer.path
    command("fsfreeze", "--freeze", str(freezable_disk))
    count = 20
    slowest_s = 0.0
    while "doesn't answer" not in str(writer.failure) or writer.dropped == 0:  # until then it only can't keep up
        assert count < 20_000, "nobody notices"
        before_s = time.monotonic()
        offer(writer, count, 1)
        slowest_s = max(slowest_s, time.monotonic() - before_s)
        count += 1
        time.sleep(0.01)
    assert "the disk" in str(writer.failure) and "doesn't answer" in str(writer.failure)
    assert writer.frames_written == 20
    command("fsfreeze", "--unfreeze", str(freezable_disk))
    wait_until(lambda: writer.failure is None, LONG_S)
    wait_until(lambda: writer.frames_written + writer.dropped == count, LONG_S)
    offer_and_wait(writer, count, 10)
    assert writer.path == first, "it waited, and nothing was cut off"
    writer.close(60.0)
    assert first is not None
    seqs = Recorded(first).seqs()
    assert seqs[:20] == list(range(20)) and seqs[-10:] == list(range(count, count + 10))
    assert len(seqs) == writer.frames_written


def test_closing_while_the_disk_doesn_t_answer_takes_no_longer_than_allowed(freezable_disk: Path) -> None:
    writer = recorder(freezable_disk)
    offer_and_wait(writer, 0, 20)
    command("fsfreeze", "--freeze", str(freezable_disk))
    offer(writer, 20, 20)
    closing = threading.Thread(target=writer.close, args=(1.0,))
    closing.start()
    closing.join(LONG_S)
    held, told = closing.is_alive(), writer.dropped  # without a bound it takes as long as the disk stays frozen
    command("fsfreeze", "--unfreeze", str(freezable_disk))
    assert not held
    (path,) = freezable_disk.glob("*.rrd")
    wait_until(lambda: is_complete(path) or writer.failure is not None, LONG_S)
    assert len(Recorded(path).seqs()) + told == 40, "what it was given is there after all, or was counted"


def test_a_process_that_is_stopped_is_noticed_and_frames_are_counted(tmp_path: Path) -> None:
    writer = recorder(tmp_path, queue_frames=50)
    offer_and_wait(writer, 0, 10)
    worker = writer.process_id
    assert worker is not None
    os.kill(worker, signal.SIGSTOP)
    wait_until(lambda: writer.failure is not None, LONG_S)
    assert writer.failure == SILENT
    os.kill(worker, signal.SIGCONT)
    wait_until(lambda: writer.failure is None, LONG_S)
    offer_and_wait(writer, 10, 10)
    writer.close(60.0)
    assert (writer.frames_written, writer.dropped) == (20, 0)


def test_what_a_paused_recording_loses_is_no_thinning() -> None:
    """The reason that it gave itself stands, and none of its losses count when it has gone on."""
    health = Health(0.0)

    def look(at_s: float, frames: int, explained: bool) -> str | None:
        health.look(at_s, at_s, True, frames, 0, explained)
        return health.fault

    assert [look(1.1 * i, 10 * i, explained=True) for i in range(1, 9)] == [None] * 8
    assert [look(1.1 * i, 80, explained=False) for i in range(9, 15)] == [None] * 6
    assert [look(1.1 * i, 80 + 10 * (i - 14), explained=False) is None for i in range(15, 18)] == [True, True, False]
    assert health.fault is not None and "it can't keep up, frames are dropped" in health.fault
    assert look(20.0, 200, explained=True) is None
    health.look(20.0 + 2.0 * SILENT_AFTER_S, 20.0, True, 200, 0, True)
    assert health.fault is not None and health.fault.startswith("recording pauses: its process"), "silence counts"


def test_losses_that_go_on_are_said_and_a_burst_is_not() -> None:
    health = Health(0.0)

    def look(at_s: float, frames: int, images: int) -> str | None:
        health.look(at_s, at_s, True, frames, images)
        return health.fault

    assert [look(t, 5, 0) for t in (1.0, 2.0, 3.0, 4.0, 5.0)] == [None] * 5, "once"
    said = [look(t, 5, int(t)) for t in (6.0, 7.0, 8.0, 9.0)]
    assert said == [None, None, *["recording thins: it can't keep up, images are dropped"] * 2]
    after = [look(t, 5, 9) for t in (10.0, 11.0, 12.0, 13.0, 14.0, 15.0)]
    assert after[0] is not None and after[-1] is None
    health.look(20.0 + SILENT_AFTER_S, 19.0, True, 5, 9)
    assert health.fault == "recording pauses: its process hasn't answered for 5 s"
    assert look(26.0, 5, 9) is None


def test_the_alert_about_the_recording() -> None:
    watch = Watch(DaemonSettings(), 0.0)
    assert watch.recording(None, 1.0, 10) == []
    (raised,) = watch.recording("recording failed: no space", 2.0, 20)
    assert (raised.kind, raised.severity, raised.event) == (AlertKind.RECORDING, Severity.WARNING, AlertEvent.RAISED)
    assert raised.text == "recording failed: no space"
    assert watch.recording("recording failed: no space", 3.0, 30) == [], "said once"
    (standing,) = watch.standing(())
    assert (standing.kind, standing.alert_id) == (AlertKind.RECORDING, raised.alert_id)
    (cleared,) = watch.recording(None, 4.0, 40)
    assert (cleared.event, cleared.alert_id) == (AlertEvent.CLEARED, raised.alert_id)
    assert watch.standing(()) == ()


def test_another_reason_is_told_and_other_figures_are_not() -> None:
    watch = Watch(DaemonSettings(), 0.0)
    watch.recording("recording failed: can't write /d/a-0001.rrd (0.0 MB free): its thread ended", 0.0, 10)
    for at_s, figure in ((11.0, 2), (22.0, 3)):
        same = f"recording failed: can't write /d/a-000{figure}.rrd ({figure}.1 MB free): its thread ended"
        assert watch.recording(same, at_s, 20) == []
    (updated,) = watch.recording("recording pauses: /d: No such file or directory", 33.0, 30)
    assert (updated.event, updated.text) == (AlertEvent.UPDATED, "recording pauses: /d: No such file or directory")
    (standing,) = watch.standing(())
    assert standing.text == updated.text


def test_the_daemon_says_so_and_goes_on() -> None:
    def failing(why: str | None):
        return lambda _: setattr(bench.recording, "failure", why)

    bench = Bench([])
    bench.source._items = iter([0, failing("recording failed: no space"), 1, 2, failing(None), 3, 4])
    assert bench.run() == 0
    told = [(a.kind, a.event, a.seq) for a in bench.network.alerts]
    assert told == [(AlertKind.RECORDING, AlertEvent.RAISED, 1), (AlertKind.RECORDING, AlertEvent.CLEARED, 3)]
    assert [a.event for a in bench.recording.alerts] == [AlertEvent.RAISED, AlertEvent.CLEARED]
    assert [r.seq for r in bench.network.transforms] == [0, 1, 2, 3, 4]
    assert [len(s.open_alerts) for s in bench.network.states if "no space" in s.message][:1] == [1]
