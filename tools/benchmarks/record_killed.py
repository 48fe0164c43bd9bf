"""``kill -9`` of a daemon and its recording process at random moments: what the file then lacks."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import kit
from benchmarks.parts import Measured, Row
from benchmarks.scene import FPS

_DAEMON = Path(__file__).parent / "recorded_daemon.py"
LOSS_S = 2.0
"""To reach: the most that a kill loses."""
_FRAMES = 100_000  # no one gets that far


@dataclass(frozen=True)
class Plan:
    """This many kills, each at a random moment of the span, counted from the first frame."""

    tries: int = 50
    span_s: tuple[float, float] = (1.0, 6.0)
    seed: int = 1


def measure(paths: tuple[Path, ...], plan: Plan) -> Measured:
    """Loss of each try, s, and how many files rerun's own reader opens."""
    draw = random.Random(plan.seed)
    tries = [_kill_once(paths[0], draw.uniform(*plan.span_s), draw.random() < 0.5) for _ in range(plan.tries)]
    losses = sorted(each["loss_s"] for each in tries)
    opened = sum(each["opened"] for each in tries)
    note = f"median {losses[len(losses) // 2]:.2f} s; last frame delivered - last frame in the file"
    first_s, last_s = plan.span_s
    return Measured(
        (
            Row("kill -9 loses", losses[-1], "s", LOSS_S, note=note),
            Row("files that rerun's own reader opens after it", opened, "", len(tries), True, f"of {len(tries)}"),
        ),
        (f"daemon and recording process killed {len(tries)} times, {first_s:g} to {last_s:g} s after the start",),
        {"tries": tries},
    )


def _kill_once(path: Path, after_s: float, daemon_first: bool) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="gripmon-bench-") as directory:
        command = [sys.executable, str(_DAEMON), str(path), directory, str(_FRAMES)]
        daemon = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        assert daemon.stdout is not None
        try:
            word, worker = daemon.stdout.readline().decode().split()
            if word != "recording" or not daemon.stdout.readline():
                raise RuntimeError("the daemon did not start")
            # It takes a second or two: what a kill costs until then isn't the question.
            kit.until(lambda: any(Path(directory).glob("*.rrd")), "no recording began")
            time.sleep(after_s)
            pids = [daemon.pid, int(worker)]
            for pid in pids if daemon_first else reversed(pids):
                os.kill(pid, signal.SIGKILL)
            delivered = int(daemon.stdout.read().split(b"\n")[-2])
        finally:
            daemon.kill()
            daemon.communicate()
        opened, newest = read_back(Path(directory))
    return {
        "after_s": after_s,
        "delivered": delivered,
        "in_file": newest,
        "opened": opened,
        "loss_s": (delivered - newest) / FPS,
    }


def read_back(directory: Path) -> tuple[bool, int]:
    """Whether rerun's own reader opens every file, and the newest frame in them; -1 without any."""
    from rerun.chunk import RrdReader

    newest, opened = -1, True
    for path in sorted(directory.glob("*.rrd")):
        try:
            frames = 0
            for chunk in RrdReader(path).stream().filter(content="/record").to_chunks():
                seqs = chunk.to_record_batch().column("frame").to_pylist()
                newest, frames = max(newest, *seqs), frames + len(seqs)
            opened = opened and frames > 0
        except Exception:  # noqa: BLE001  whatever it says, it doesn't open
            opened = False
    return opened, newest
