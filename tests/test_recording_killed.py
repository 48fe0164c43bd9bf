"""SIGKILL at any moment: what was reported as written is there, and the file opens."""

from __future__ import annotations

import contextlib
import logging
import os
import random
import shutil
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from support.recorded import Recorded, frame, record, recorder, scene, wait_until

from gripmon.record.container import whole_bytes
from gripmon.record.files import FileSeries
from gripmon.record.keeping import repair
from gripmon.record.read import open_recordings
from gripmon.record.recorder import Row

HERE = Path(__file__).parent
MOST_LOST_S = 2.0
WORTH_JUDGING_S = 1.0

RECORDER = """
import sys, time
sys.path[:0] = sys.argv[2:]
from pathlib import Path
from support.recorded import *
w = recorder(Path(sys.argv[1]), flush_period_s=0.5, image_rate_hz=30.0)
wait_until(lambda: w.path is not None, 60.0)
print(w.process_id, flush=True)
i, started = 0, time.time_ns()
while True:
    at = started + i * 16_666_667
    time.sleep(max(0.0, 1e-9 * (at - time.time_ns())))
    f = frame(i)
    w.frame(Frame(i, at, f.image), record(i, stamp_ns=at), lambda: trace(i))
    i += 1
    print(w.frames_written, i, at, flush=True)
"""


@contextlib.contextmanager
def recording(directory: Path) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """A process that records 60 frames a second, and the number of the process that writes them."""
    command = [sys.executable, "-c", RECORDER, str(directory), str(HERE), str(HERE.parent)]
    daemon = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert daemon.stdout is not None
        yield daemon, int(daemon.stdout.readline())
    finally:
        daemon.kill()
        daemon.wait()


def rows_of(path: Path) -> list[int]:
    """The frames' numbers as rerun's own reader gives them, footer or not."""
    from rerun.chunk import RrdReader

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        batches = [c.to_record_batch() for c in RrdReader(path).stream().to_chunks() if c.entity_path == "/record"]
    return sorted(seq for batch in batches for seq in batch.column("frame").to_pylist())


@pytest.mark.parametrize("attempt", range(2))
def test_killed_at_a_random_moment(tmp_path: Path, attempt: int) -> None:
    chance = random.Random(attempt)
    with recording(tmp_path) as (daemon, worker):
        assert daemon.stdout is not None
        wanted, lines = chance.randint(60, 150), [""]
        for line in daemon.stdout:
            lines.append(line)
            if len(lines) > wanted and int(line.split()[0]) > 0:
                break
        time.sleep(chance.uniform(0.0, 0.02))
        victims = [worker, daemon.pid]
        for process_id in chance.sample(victims, 2):
            os.kill(process_id, signal.SIGKILL)
        killed_ns = time.time_ns()
        lines += daemon.stdout.readlines()
    wait_until(lambda: not psutil.pid_exists(worker) or psutil.Process(worker).status() == psutil.STATUS_ZOMBIE)
    told = [[int(word) for word in line.split()] for line in lines[1:] if line.endswith("\n")]
    written = told[-1][0]
    (path,) = tmp_path.glob("*.rrd")
    # Our own reader takes it as it was left, rerun's after the start of the next recording.
    (run,) = open_recordings([path]).recordings
    ours = run.frames.seq.tolist()
    series = FileSeries(scene(tmp_path))
    series.write()
    series.close()
    assert rows_of(path) == ours == list(range(len(ours)))
    assert len(ours) >= written > 0
    # The loss in seconds, where the machine had time to write at all.
    before_ns = told[-1][2] - told[min(written, len(told) - 1)][2]
    if 1e-9 * before_ns < WORTH_JUDGING_S:
        assert 1e-9 * (killed_ns - int(run.frames.stamp_ns[-1])) < MOST_LOST_S


def test_a_file_cut_anywhere_is_whole_after_the_next_start(tmp_path: Path) -> None:
    made = FileSeries(scene(tmp_path))
    for i in range(12):
        made.add_frames([Row(record(i), None, None, None)])
        made.write()
    assert made.path is not None
    growing = tmp_path / "growing.rrd"
    shutil.copy(made.path, growing)  # no footer yet
    assert repair(Path(made.path)) == 0, "it is being written"
    made.close()
    whole = next(tmp_path.glob("run-*.rrd"))
    assert whole_bytes(whole) == whole.stat().st_size and repair(whole) == 0
    assert Recorded(whole).seqs() == list(range(12))
    contents, chance = growing.read_bytes(), random.Random(1)
    assert rows_of(growing) == list(range(12))
    counts = []
    for cut in sorted(chance.sample(range(len(contents) // 2, len(contents)), 12)):
        growing.write_bytes(contents[:cut])
        removed = repair(growing)
        assert removed < 100_000
        counts.append(len(rows_of(growing)))
        assert repair(growing) == 0
    assert counts == sorted(counts) and counts[0] < counts[-1]


def test_what_is_no_recording_is_left_alone(tmp_path: Path) -> None:
    for name, contents in {"empty": b"", "text": b"precious" * 9, "short": b"RRF2"}.items():
        path = tmp_path / name
        path.write_bytes(contents)
        repair(path)
        assert path.read_bytes() == contents


def test_a_killed_recorders_file_is_told_with_the_command_that_makes_it_whole(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    writer = recorder(tmp_path)
    writer.frame(frame(0), record(0), lambda: None)
    wait_until(lambda: writer.frames_written == 1)
    assert writer.process_id is not None and writer.path is not None
    killed = writer.path
    os.kill(writer.process_id, signal.SIGKILL)
    wait_until(lambda: writer.failure is not None)
    writer.close(60.0)
    with caplog.at_level(logging.INFO, "gripmon.record"):
        again = recorder(tmp_path)
        wait_until(lambda: "no footer" in caplog.text)
        again.close(60.0)
    (line,) = (text for text in caplog.messages if "no footer" in text)
    assert line.startswith(f"1 earlier recordings have no footer, as their recorder was killed, the newest {killed};")
    assert line.endswith("rerun rrd optimize FILE.rrd -o WHOLE.rrd")
    rerun = str(Path(sys.executable).with_name("rerun"))
    whole = tmp_path / "whole.rrd"
    assert subprocess.run([rerun, "rrd", "verify", str(killed)], capture_output=True, check=False).returncode != 0
    subprocess.run([rerun, "rrd", "optimize", str(killed), "-o", str(whole)], capture_output=True, check=True)
    subprocess.run([rerun, "rrd", "verify", str(whole)], capture_output=True, check=True)
    assert Recorded(whole).seqs() == [0]
