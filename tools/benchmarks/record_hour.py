"""An hour of recording, written by the recording's own files and rows as fast as they go; and what reading it takes."""

from __future__ import annotations

import contextlib
import itertools
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import msgspec

from benchmarks import machine, parts, scene, switched
from gripmon.model.records import StateRecord
from gripmon.monitor import Monitor
from gripmon.record.files import FileSeries
from gripmon.record.pictures import encode_picture
from gripmon.record.recorder import Row, Scene, pack_trace

WITHIN_S = 60.0
"""To reach: each command on an hour."""
COMMANDS: dict[str, tuple[str, ...]] = {
    "report": ("--out", "report.html"),
    "correct": ("--out", "corrected.jsonl"),
    "export": ("--out", "table"),
}


@dataclass(frozen=True)
class Plan:
    """Frames of the recording and of each file; ``quiet`` and ``moving`` ones are judged and then repeated."""

    frames: int = 216_000
    in_file: int = 18_000
    quiet: int = 1200
    moving: int = 2400
    commands: tuple[str, ...] = tuple(COMMANDS)
    timeout_s: float = 900.0


@dataclass(frozen=True)
class _Part:
    """Consecutive frames as they were judged."""

    rows: list[Row]
    monitor: Monitor


def measure(paths: tuple[Path, ...], plan: Plan) -> parts.Measured:
    """Written here, read by the commands as processes; ``paths``: of quiet and of moving frames."""
    with tempfile.TemporaryDirectory(prefix="gripmon-bench-") as directory:
        written = write(*paths, Path(directory), plan)
        done = read(Path(directory), plan)
    rows = []
    for name, each in done.items():
        cpu = f"{each['cpu_s']:.1f} s of a core" + ("" if each["code"] == 0 else f"; {each['said']}")
        rows.append(parts.Row(f"gripmon {name} of an hour", each["took_s"], "s", WITHIN_S, note=cpu))
        if each["code"] != 0:
            rows.append(parts.Row(f"gripmon {name} of an hour: not done, exit code {each['code']}", 1.0, "", 0.0))
    said = (
        f"{written['frames']:,} frames, {written['images']:,} images, {written['alerts']} alerts; {written['files']} "
        f"files, {1e-9 * written['bytes']:.2f} GB (written in {written['written_s']:.0f} s), default policy"
    )
    return parts.Measured(tuple(rows), (said,), {"written": written, "read": done})


def write(quiet: Path, moving: Path, directory: Path, plan: Plan) -> dict[str, Any]:
    """Write the hour: quiet but for some frames in its middle, in which the mount creeps back and forth."""
    cv2.setNumThreads(1)
    calm_ring, busy_ring = scene.Ring.load(quiet), scene.Ring.load(moving)
    config = scene.config_for(calm_ring.size)
    described = switched.described(config, directory, budget_bytes=0, max_file_s=1e9, max_file_bytes=1 << 40)
    calm, busy = _judge(calm_ring, plan.quiet), _judge(busy_ring, plan.moving)
    start_s = time.monotonic()
    images = _write(described, _sequence(calm.rows, busy.rows, plan.frames), plan)
    files = sorted(directory.glob("*.rrd"))
    return {
        "frames": plan.frames,
        "files": len(files),
        "bytes": sum(file.stat().st_size for file in files),
        "images": images,
        "alerts": sum(len(row.record.alerts) for row in busy.rows),
        "written_s": time.monotonic() - start_s,
    }


def _judge(ring: scene.Ring, count: int) -> _Part:
    """A monitor's records of this many frames; an image every sixth frame, which is 10 per second."""
    config = scene.config_for(ring.size)
    monitor = Monitor(config.camera, config.gripper, config.settings.monitor, config.reference)
    rows = []
    pictures: dict[int, Any] = {}
    for seq in range(count):
        frame = ring.frame(seq)
        record = monitor.process(frame)
        picture = trace = None
        if seq % 6 == 0:
            place = ring.place(seq)
            if place not in pictures:
                pictures[place] = encode_picture(ring.images[place], config.settings.recording)
            picture = pictures[place]
            measured = monitor.trace()
            trace = None if measured is None else pack_trace(measured)
        notes = monitor.notes()
        rows.append(Row(record, picture, trace, None, frame.jaw_opening_m, notes.statistic_share, notes.limits))
        monitor.learn()
    return _Part(rows, monitor)


def _sequence(calm: list[Row], busy: list[Row], count: int) -> Iterator[Row]:
    """``count`` rows on one clock: the first of ``calm`` once, its second half again and again, ``busy`` in between."""
    half = len(calm) // 2
    before = itertools.chain(calm, itertools.cycle(calm[half:]))
    middle = max((count - len(busy)) // 2, 0)
    rows = itertools.chain(itertools.islice(before, middle), busy, itertools.cycle(calm[half:]))
    start_ns = time.time_ns() - round(count / scene.FPS * 1e9)
    for seq, row in enumerate(itertools.islice(rows, count)):
        stamp_ns = start_ns + round(seq * 1e9 / scene.FPS)
        yield _moved(row, seq, stamp_ns)


def _moved(row: Row, seq: int, stamp_ns: int) -> Row:
    record = msgspec.structs.replace(row.record, seq=seq, stamp_ns=stamp_ns)
    return Row(record, row.picture, row.trace, None, row.jaw_reported_m, row.statistic_share, row.limits)


def _write(described: Scene, rows: Iterator[Row], plan: Plan) -> int:
    """As the recording process would: a chunk every flush period, a state message a second, a file now and then."""
    chunk = max(round(described.settings.flush_period_s * scene.FPS), 1)
    images = written = 0
    series = FileSeries(described)
    while batch := list(itertools.islice(rows, chunk)):
        series.add_frames(batch)
        if written % round(scene.FPS) < chunk:
            series.add_events([_state(described, batch[-1])])
        series.write()
        written += len(batch)
        images += sum(row.picture is not None for row in batch)
        if written % plan.in_file == 0 and written < plan.frames:
            series.close()
            series.write()  # the next file
    series.close()
    if series.frames_lost:
        raise RuntimeError(f"{series.frames_lost} frames are missing: {series.failure}")
    return images


def _state(described: Scene, row: Row) -> StateRecord:
    record = row.record
    return StateRecord(
        robot=described.robot, camera=described.camera, state=record.state, verdict=record.verdict,
        stamp_ns=record.stamp_ns, seq=record.seq, reference_id=record.reference_id, revision=record.revision,
        frames=record.seq + 1, frames_refused=0, frames_dropped=0, frames_per_s=scene.FPS,
        uptime_s=record.seq / scene.FPS, camera_connected=True, recording_dropped=0, message="",
        version=described.version,
    )  # fmt: skip


def read(directory: Path, plan: Plan) -> dict[str, Any]:
    """Each of the commands on the hour, as a process."""
    files = [str(file) for file in sorted(directory.glob("*.rrd"))]
    return {name: _timed(name, files, directory, plan) for name in plan.commands}


def _timed(name: str, files: list[str], directory: Path, plan: Plan) -> dict[str, Any]:
    arguments = [str(directory / part) if part[0] != "-" else part for part in COMMANDS[name]]
    start_s = time.monotonic()
    before_s = machine.children_s()
    command = [sys.executable, "-m", "gripmon", name, *files, *arguments]
    with contextlib.suppress(subprocess.TimeoutExpired):
        done = subprocess.run(command, capture_output=True, text=True, timeout=plan.timeout_s, check=False)
        return {
            "took_s": time.monotonic() - start_s,
            "cpu_s": machine.children_s() - before_s,
            "code": done.returncode,
            "said": (done.stdout + done.stderr).strip()[-400:],
        }
    return {"took_s": math.inf, "cpu_s": math.nan, "code": None, "said": f"not done after {plan.timeout_s:g} s"}
