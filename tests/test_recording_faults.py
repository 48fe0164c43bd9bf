"""What a black box is for: crashes, a full disk, a stalled process; and nothing is left behind."""

from __future__ import annotations

import errno
import os
import resource
import shutil
import signal
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import psutil
import pytest
from support.loopback import alert_record
from support.recorded import (
    INTERVAL_NS,
    START_NS,
    Recorded,
    frame,
    image,
    record,
    recorder,
    scene,
    trace,
    wait_until,
)

from gripmon.model.geometry import make_transform, to_record
from gripmon.model.records import ReferenceRecord
from gripmon.record.container import whole_bytes
from gripmon.record.files import FileSeries
from gripmon.record.recorder import Row
from gripmon.record.write import ProcessRecorder


@pytest.fixture(autouse=True)
def no_child_left() -> Iterator[None]:
    before = set(psutil.Process().children())
    yield
    # One that has all it needs may write on for a while.
    _, alive = psutil.wait_procs(set(psutil.Process().children()) - before, timeout=120.0)
    assert not alive


PICTURE = image(0)


def offer(writer: ProcessRecorder, first: int, count: int) -> None:
    for i in range(first, first + count):
        writer.frame(frame(i, PICTURE), record(i), partial(trace, i))


def offer_and_wait(writer: ProcessRecorder, first: int, count: int) -> None:
    written = writer.frames_written
    offer(writer, first, count)
    wait_until(lambda: writer.frames_written == written + count)


def open_files() -> set[int]:
    """Numbers of this process's descriptors (those that survive the look at them)."""
    return {int(path.name) for path in Path("/proc/self/fd").iterdir() if path.exists()}


def running_worker(writer: ProcessRecorder) -> int:
    wait_until(lambda: writer.path is not None)
    assert writer.process_id is not None
    return writer.process_id


def test_a_killed_recording_process_is_replaced(tmp_path: Path) -> None:
    writer = recorder(tmp_path)
    worker = running_worker(writer)
    offer_and_wait(writer, 0, 20)
    os.kill(worker, signal.SIGKILL)
    wait_until(lambda: writer.failure is not None)
    assert "code -9" in str(writer.failure)
    offer(writer, 20, 10)
    wait_until(lambda: writer.frames_written == 30)
    assert running_worker(writer) != worker
    offer_and_wait(writer, 30, 5)
    wait_until(lambda: writer.failure is None)
    writer.close(60.0)
    assert (writer.frames_written, writer.dropped) == (35, 0)
    first, second = sorted(tmp_path.glob("*.rrd"))
    assert (first.name, second.name) == ("run-0001.rrd", "run-0002.rrd")
    told = Recorded(second)
    assert told.seqs() == list(range(20, 35))
    assert told.by_seq("status/state", "state")[20] == ["tracking"]
    # The first file lacks its footer, but holds what had been flushed.
    from rerun.chunk import RrdReader

    with pytest.warns(match="no footer"):
        reader = RrdReader(first)
    assert sum(chunk.num_rows for chunk in reader.stream().to_chunks() if chunk.entity_path == "/record") == 20


def test_frames_that_a_killed_process_took_with_it_are_counted(tmp_path: Path) -> None:
    writer = recorder(tmp_path, flush_period_s=10.0)
    worker = running_worker(writer)
    offer(writer, 0, 20)
    wait_until(lambda: writer._worker is not None and writer._worker.frames_sent == 20)  # handed over, not flushed
    os.kill(worker, signal.SIGKILL)
    wait_until(lambda: writer.failure is not None)
    assert writer.dropped == 20
    writer.close(60.0)
    assert (writer.frames_written, writer.dropped) == (0, 20)


def test_a_stalled_process_costs_frames_not_memory(tmp_path: Path) -> None:
    writer = recorder(tmp_path, queue_frames=100, queue_images=4, image_rate_hz=1000.0)
    worker = running_worker(writer)
    os.kill(worker, signal.SIGSTOP)
    count = 600
    offer(writer, 0, count)
    time.sleep(0.1)
    offer(writer, count, 200)
    # A pipe's worth of records left, the rest waits in the queue or is dropped.
    assert 0 < writer.dropped < count + 100
    assert writer.images_dropped > 0
    os.kill(worker, signal.SIGCONT)
    writer.close(60.0)
    assert writer.failure is None
    assert writer.frames_written + writer.dropped == count + 200
    (path,) = tmp_path.glob("*.rrd")
    told = Recorded(path)
    assert len(told.seqs()) == writer.frames_written
    assert 1 <= len(told.timed("rig/camera/image")) <= writer.frames_written - writer.images_dropped


def test_close_ends_a_process_that_never_finishes(tmp_path: Path) -> None:
    writer = recorder(tmp_path)
    worker = running_worker(writer)
    offer_and_wait(writer, 0, 10)
    os.kill(worker, signal.SIGSTOP)
    offer(writer, 10, 5)
    writer.close(1.0)
    assert "did not finish in time" in str(writer.failure)
    assert (writer.frames_written, writer.dropped) == (10, 5)
    assert not psutil.pid_exists(worker)


def test_a_full_disk_is_reported_and_recording_goes_on_afterwards(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whichever message of a file it is that finds no room: what is there before it can be read."""
    monkeypatch.setattr("gripmon.record.files._FIRST_RETRY_S", 0.0)
    room, written = [10**9], os.sendfile

    def sendfile(to: int, source: int, offset: int, count: int) -> int:
        if room[0] == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sent = written(to, source, offset, min(count, room[0]))
        room[0] -= sent
        return sent

    monkeypatch.setattr(os, "sendfile", sendfile)
    files = FileSeries(scene(tmp_path))

    def write(first: int) -> None:
        files.add_frames([Row(record(i), None, None, None) for i in range(first, first + 10)])
        files.write()

    write(0)
    room[0] = 5000
    write(10)
    assert str(files.failure).startswith(f"recording failed: can't write {tmp_path / 'run-0001.rrd'} (")
    assert str(files.failure).endswith("MB free): No space left on device")
    assert (files.frames_written, files.frames_lost, files.path) == (10, 10, None)
    files.add_events([alert_record(text="recording failed: no space")])
    write(20)
    assert (files.frames_lost, sorted(path.name for path in tmp_path.iterdir())) == (20, ["run-0001.rrd"]), "no room"
    room[0] = 10**9
    write(30)
    assert files.failure is None
    files.close()
    assert whole_bytes(tmp_path / "run-0001.rrd") == (tmp_path / "run-0001.rrd").stat().st_size
    told = Recorded(tmp_path / "run-0003.rrd")
    assert told.seqs() == list(range(30, 40))
    assert told.blueprint and told.timed("rig/reference")
    assert any("no space" in str(cell.values["text"]) for cell in told.timed("events")), "why there is a gap"


def test_a_process_that_can_t_encode_ends_and_is_replaced(tmp_path: Path) -> None:
    """A limit on the size of its files holds for memory, too: the thread of rerun that encodes ends."""
    writer = recorder(tmp_path)
    worker = running_worker(writer)
    offer_and_wait(writer, 0, 10)
    limit = 4096 + max(path.stat().st_size for path in tmp_path.glob("*.rrd"))
    resource.prlimit(worker, resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
    offer(writer, 10, 60)
    wait_until(lambda: writer.failure is not None)
    assert writer.failure == "the recording process ended with code 1"
    offer_and_wait(writer, 70, 10)
    assert writer.process_id != worker
    writer.close(60.0)
    assert (writer.frames_written, writer.dropped, writer.failure) == (20, 60, None)
    assert Recorded(tmp_path / "run-0002.rrd").seqs() == list(range(70, 80))


def test_space_that_the_disk_must_keep_pauses_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    free = [2_000_000_000]
    monkeypatch.setattr("gripmon.record.keeping.shutil.disk_usage", lambda _: SimpleNamespace(free=free[0]))
    monkeypatch.setattr("gripmon.record.files._FIRST_RETRY_S", 0.0)
    files = FileSeries(scene(tmp_path, min_free_bytes=1_000_000_000))
    files.add_frames([Row(record(0), None, None, None)])
    files.write()
    assert (files.frames_written, files.failure) == (1, None)

    free[0] = 900_000_000
    files.add_frames([Row(record(1), None, None, None)])
    files.write()  # the frame is still written, then the file is completed
    assert files.failure == f"recording pauses: {tmp_path} has 900 MB free, min_free_bytes keeps 1000 MB"
    assert files.path is None
    files.add_frames([Row(record(2), None, None, None)])
    files.write()
    assert (files.frames_written, files.frames_lost) == (2, 1)

    free[0] = 1_500_000_000
    files.add_frames([Row(record(3), None, None, None)])
    files.write()
    assert (files.frames_written, files.frames_lost, files.failure) == (3, 1, None)
    files.close()
    first, second = sorted(tmp_path.glob("*.rrd"))
    assert (Recorded(first).seqs(), Recorded(second).seqs()) == ([0, 1], [3])


def test_a_directory_that_vanishes_is_reported_and_made_again(tmp_path: Path) -> None:
    directory = tmp_path / "deep" / "recordings"
    writer = recorder(directory)
    running_worker(writer)
    offer_and_wait(writer, 0, 3)
    shutil.rmtree(directory.parent)
    offer(writer, 3, 3)
    wait_until(lambda: writer.failure is not None)
    assert str(directory) in str(writer.failure)
    wait_until(lambda: writer.failure is None)
    offer_and_wait(writer, 6, 3)
    writer.close(60.0)
    (path,) = directory.glob("*.rrd")
    assert Recorded(path).seqs() == [6, 7, 8]


def test_a_new_reference_is_recorded_and_is_in_later_files(tmp_path: Path) -> None:
    writer = recorder(tmp_path, truth=lambda i: (0.0, 0.0, 0.1), image_rate_hz=1000.0)
    worker = running_worker(writer)
    offer_and_wait(writer, 0, 5)
    moved = to_record(make_transform(np.eye(3), np.array([0.002, 0.003, 0.2])))
    new = ReferenceRecord("second", 2, START_NS + 5 * INTERVAL_NS, "recalibration", moved, (0.0,) * 36)
    writer.event(new)
    for i in range(5, 8):
        writer.frame(frame(i), record(i, reference_id="second", revision=2), partial(trace, i))
    wait_until(lambda: writer.frames_written == 8)
    os.kill(worker, signal.SIGKILL)
    wait_until(lambda: writer.failure is not None)
    writer.frame(frame(8), record(8, reference_id="second", revision=2), partial(trace, 8))
    wait_until(lambda: writer.frames_written == 9)
    writer.close(60.0)
    told = Recorded(tmp_path / "run-0002.rrd")
    (cell,) = told.timed("rig/reference")
    assert cell.values["translation"][0] == pytest.approx([0.002, 0.003, 0.2], rel=1e-6)
    assert told.by_seq("drift/truth_mm", "scalars")[8] == pytest.approx([-2.0, -3.0, -100.0])


def test_close_releases_everything(tmp_path: Path) -> None:
    process = psutil.Process()
    recorder(tmp_path / "warm").close(60.0)
    descriptors, threads = open_files(), threading.active_count()
    children = {child.pid for child in process.children()}  # other tests may have left some
    writer = recorder(tmp_path / "run")
    offer(writer, 0, 10)
    wait_until(lambda: {child.pid for child in process.children()} > children)
    assert "gripmon-images" in Path("/proc/self/maps").read_text()
    writer.close(60.0)
    writer.close(60.0)
    assert open_files() == descriptors
    assert threading.active_count() == threads
    assert {child.pid for child in process.children()} <= children
    assert "gripmon-images" not in Path("/proc/self/maps").read_text()


def test_a_broken_recorder_does_not_break_the_loop(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    def no_truth(_: int) -> tuple[float, float, float]:
        raise RuntimeError("no truth here")

    writer = recorder(tmp_path, truth=no_truth, queue_frames=10)
    offer(writer, 0, 5)
    wait_until(lambda: writer.failure is not None)
    assert "no truth here" in str(writer.failure) and "recording stopped" in caplog.text
    offer(writer, 5, 30)
    writer.close(60.0)
    assert writer.dropped == 35 and "no truth here" in str(writer.failure)
    assert "gripmon-images" not in Path("/proc/self/maps").read_text()
