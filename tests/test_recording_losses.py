"""What is missing in a recording is counted and said; whoever can wait loses nothing; no false alarm at an end."""

from __future__ import annotations

import logging
import os
import signal
from functools import partial
from pathlib import Path

import psutil
import pytest
from support.configurations import demo_in
from support.gripmon_process import gripmon
from support.recorded import (
    Recorded,
    frame,
    image,
    record,
    recorder,
    scene,
    trace,
    wait_until,
)

from gripmon.model.records import Alert, AlertKind, Cause, Severity
from gripmon.model.shared_images import SharedImages
from gripmon.record.container import is_complete
from gripmon.record.process import Worker
from gripmon.record.read import open_recordings
from gripmon.record.recorder import Status
from gripmon.record.write import ProcessRecorder

DRIFT = Alert(AlertKind.DRIFT, Cause.UNKNOWN, Severity.WARNING, "off")
PICTURE = image(0)


def stopped(writer: ProcessRecorder) -> int:
    """The recording process, stopped: nothing gets room any more."""
    wait_until(lambda: writer.path is not None)
    assert writer.process_id is not None
    os.kill(writer.process_id, signal.SIGSTOP)
    return writer.process_id


def pictures(directory: Path) -> set[int]:
    """Numbers of the frames whose image is in the recordings."""
    return {seq for path in directory.glob("*.rrd") for seq in Recorded(path).by_seq("rig/camera/image", "blob")}


def test_a_source_that_can_wait_loses_no_image(tmp_path: Path) -> None:
    """The monitor outruns an encoder of PNG; with a simulated camera that isn't in real time it waits."""
    config = demo_in(
        tmp_path,
        source={"kind": "simulator", "scenario": "bump", "duration_s": 1.5, "fps": 20.0, "realtime": False},
        publish={"enabled": False},
        recording={"image_format": "png", "image_every": 1, "min_free_bytes": 0},
    )
    done = gripmon("run", config, "--out", tmp_path / "out", timeout_s=400.0)
    assert done.returncode == 0 and "missing" not in done.stderr and "incomplete" not in done.stderr, done.stderr
    (run,) = open_recordings(sorted((tmp_path / "out").glob("*.rrd"))).recordings
    assert len(run.frames) == 30
    again = gripmon("replay", *(tmp_path / "out").glob("*.rrd"), "--out", tmp_path / "again.jsonl", timeout_s=400.0)
    assert "replay: all 30 as they were recorded, every number the same" in again.stderr


def test_images_that_have_no_room_are_counted_and_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    writer = recorder(tmp_path, image_every=1, queue_images=4)
    process = stopped(writer)
    with caplog.at_level(logging.WARNING, "gripmon.record"):
        for i in range(30):
            writer.frame(frame(i, PICTURE), record(i), partial(trace, i))
        wait_until(lambda: "missing in the recording so far: frames: 0" in caplog.text)
        os.kill(process, signal.SIGCONT)
        writer.close(60.0)
    assert (writer.dropped, writer.frames_written) == (0, 30)
    assert 0 < writer.images_dropped == 30 - len(pictures(tmp_path))
    assert f"missing in the recording so far: frames: 0; images of other frames: {writer.images_dropped}" in caplog.text


def test_images_around_an_alert_that_had_no_room_are_counted_when_it_comes(tmp_path: Path) -> None:
    """Before the alert no one misses them."""
    writer = recorder(tmp_path, image_rate_hz=0.0, queue_images=4)
    process = stopped(writer)
    for i in range(30):
        writer.frame(frame(i, PICTURE), record(i), partial(trace, i))
    os.kill(process, signal.SIGCONT)
    wait_until(lambda: writer.frames_written == 30)
    assert writer.images_dropped == 0
    writer.frame(frame(30, PICTURE), record(30, alerts=(DRIFT,)), partial(trace, 30))
    wait_until(lambda: writer.frames_written == 31)
    writer.close(60.0)
    assert 0 < writer.images_dropped == 31 - len(pictures(tmp_path))


def test_whoever_can_wait_gets_all_images_around_an_alert(tmp_path: Path) -> None:
    writer = recorder(tmp_path, patience_s=30.0, image_rate_hz=0.0, queue_images=4)
    for i in range(60):
        writer.frame(frame(i, PICTURE), record(i, alerts=(DRIFT,) * (i == 40)), partial(trace, i))
    writer.close(30.0)
    assert (writer.dropped, writer.images_dropped, pictures(tmp_path)) == (0, 0, set(range(60)))


def test_a_process_that_ends_while_it_is_written_to_still_says_why(tmp_path: Path) -> None:
    """The pipe towards it may break before its last report is read."""
    images = SharedImages(1, 64, 48)
    worker = Worker(scene(tmp_path), images)
    wait_until(lambda: worker.look() or worker.status.path is not None)
    path, worker.status = worker.status.path, Status()
    wait_until(worker._reports.poll)  # one more, which nobody has read
    worker.kill()
    assert worker._process.ended_within(60.0)
    worker.send(b"more")
    assert worker.gone and worker.status.path == path, "its reports were read"
    assert worker.reap() == "the recording process ended with code -9"
    images.close()


def test_a_process_that_has_everything_and_still_starts_is_left_to_finish(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Ctrl-C in a monitor's first second: the file is complete all the same, some time after the monitor's end."""
    writer = recorder(tmp_path)
    for i in range(20):
        writer.frame(frame(i, PICTURE), record(i), partial(trace, i))
    with caplog.at_level(logging.WARNING, "gripmon.record"):
        writer.close(0.2)
    assert (writer.failure, writer.dropped) == (None, 0) and "incomplete" not in caplog.text
    wait_until(lambda: any(is_complete(path) for path in tmp_path.glob("*.rrd")))
    (path,) = tmp_path.glob("*.rrd")
    assert Recorded(path).seqs() == list(range(20))


def test_a_recorder_that_was_given_nothing_ends_at_once_and_says_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    writer = recorder(tmp_path)
    wait_until(lambda: writer.process_id is not None)
    process = writer.process_id
    writer.close(2.0)
    assert (writer.failure, caplog.text) == (None, "")
    assert process is not None and not psutil.pid_exists(process) and not list(tmp_path.glob("*.rrd"))
