"""The thread that writes a file of rerun ends with the first write that fails: who asks it for more waits for ever."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from support.recorded import Recorded, frame, record, recorder, trace, wait_until
from support.small_disks import fill, small_disk


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    with small_disk(tmp_path / "disk", 3_000_000) as place:
        yield place


def noise(i: int) -> np.ndarray:
    """A picture that takes its 77 kB also as PNG."""
    return np.random.default_rng(i).integers(0, 255, (240, 320)).astype(np.uint8)


def test_a_recording_that_outgrows_its_disk_ends_at_once(disk: Path) -> None:
    """Whichever write it is that fails: six of them, each with another length before it."""
    for i in range(6):
        writer = recorder(disk / f"run{i}", patience_s=30.0, image_every=1, image_format="png")
        for k in range(60):
            writer.frame(frame(k, noise(k)[: 200 + 8 * i]), record(k), partial(trace, k))
        begun_s = time.monotonic()
        writer.close(60.0)
        assert time.monotonic() - begun_s < 30.0
        assert writer.failure is not None and "can't write" in writer.failure and writer.dropped > 0
        subprocess.run(["rm", "-r", disk / f"run{i}"], check=True)


def test_a_recording_goes_on_when_there_is_room_again_however_its_writer_died(disk: Path) -> None:
    writer = recorder(disk / "run", image_every=1, image_format="png")
    for i in range(3):
        wait_until(lambda: writer.path is not None and writer.failure is None, 60.0)
        ballast = fill(disk)
        deadline_s = time.monotonic() + 60.0
        k = 1000 * i
        while writer.failure is None:
            assert time.monotonic() < deadline_s
            writer.frame(frame(k, noise(k)), record(k), partial(trace, k))
            k += 1
            time.sleep(0.05)
        ballast.unlink()
    wait_until(lambda: writer.path is not None and writer.failure is None, 60.0)
    written = writer.frames_written
    writer.frame(frame(9000, noise(0)), record(9000), partial(trace, 9000))
    wait_until(lambda: writer.frames_written == written + 1, 60.0)
    last = writer.path
    writer.close(30.0)
    assert last is not None and Recorded(last).seqs() == [9000]
