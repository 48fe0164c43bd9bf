"""What the recording costs the loop, the disk and those who read it, and what a kill loses.

Times the daemon's own loop at 60 frames/s with its recording off, on, and on with a disk that stands still
(a frozen file system of its own as root, else the stopped recording process), in turns, in one run; counts
bytes an hour by image policy, from half a minute each; writes an hour of recording and times gripmon's
commands on it; kills a daemon and its recording process 50 times (SIGKILL) and looks what the file lacks.
--only memory: a day's frames (--quick: three hours') through the recorder, as fast as it takes them, and its memory
meanwhile.
Takes some half an hour; --quick, less exact, six minutes.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

from benchmarks import parts, record_bytes, record_hour, record_killed, record_loop, record_memory
from benchmarks.kit import Report
from benchmarks.parts import LARGE, Frames, Part

_BOTH_SIZES = tuple(Frames(size=size, count=60, quick=30) for size in (parts.SMALL, LARGE))
_HOUR = tuple(Frames(kind, count=60, quick=30) for kind in ("quiet", "clutter"))
PARTS = {
    "loop": Part(
        "the loop with recording off, on, and on with a disk that stands still", record_loop.measure,
        record_loop.Plan(), _BOTH_SIZES, {"block": 300, "rounds": 3},
    ),
    "bytes": Part(
        "bytes an hour by image policy", record_bytes.measure, record_bytes.Plan(),
        tuple(replace(frames, kind="quiet") for frames in _BOTH_SIZES), {"seconds": 10.0}, 1,
    ),
    "hour": Part("an hour of recording, and reading it", record_hour.measure, record_hour.Plan(), _HOUR),
    "killed": Part(
        "kill -9 of daemon and recording process", record_killed.measure, record_killed.Plan(),
        (Frames(count=30, quick=30),), {"tries": 10},
    ),
    "memory": Part(
        "memory over a day's frames", record_memory.measure, record_memory.Plan(),
        (Frames("quiet", record_memory.SIZE, 30, 30),), {"hours": 3.0},
    ),
}  # fmt: skip


def add_options(parser: argparse.ArgumentParser) -> None:
    parts.add_options(parser, "a shorter run")


def run(arguments: argparse.Namespace, report: Report) -> int | None:
    return parts.run(arguments, report, PARTS, unasked=("memory",))
