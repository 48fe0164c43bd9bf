"""The parts of ``tools/bench latency`` that run the daemon on a live camera, alone and on a machine under load."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import msgspec

from benchmarks import harness, scene
from benchmarks.latency_program import Plan
from benchmarks.parts import Measured, Row
from benchmarks.switched import SwitchedRecorder
from gripmon.io.sources import Waiting
from gripmon.io.sources.realtime import SimulatedCamera
from gripmon.model import priority
from gripmon.model.records import Frame

OF_A_CORE = 12.0
_BEGIN_S = 2.0
"""Of the daemon's run, before the loop's time counts."""
_NEVER_ASLEEP, LOADED, LOADED_MS = 2, 2.0, 10.0


@dataclass(frozen=True)
class _Maker:
    """The camera's frames, in its own process: rendered before, so that they cost it next to nothing."""

    path: Path
    kept: list[scene.Ring] = dataclasses.field(default_factory=list, compare=False)

    def frame(self, index: int) -> Frame:
        if not self.kept:
            self.kept.append(scene.Ring.load(self.path))
        return self.kept[0].frame(index)


class _Live(harness.RingSource):
    """A camera that waits for no one, switched on when the loop first asks; notes the time of its frames, and the
    loop's use of its core.
    """

    live = True

    def __init__(self, ring: scene.Ring, path: Path, count: int) -> None:
        super().__init__(ring, count)
        self._path, self._size = path, ring.size
        self._camera: SimulatedCamera | None = None
        self._begun: tuple[float, float, float] | None = None
        self.loop_s = self.process_s = self.wall_s = 0.0
        self.dropped_at_first = 0  # before the loop's time counts

    @property
    def dropped(self) -> int:  # type: ignore[override]
        return 0 if self._camera is None else self._camera.dropped

    def read(self) -> Frame | Waiting | None:  # type: ignore[override]
        if self._camera is None:
            self._camera = SimulatedCamera(
                _Maker(self._path), size_px=self._size, fps=scene.FPS, name="bench", frame_count=self._count
            )
        item = self._camera.read()
        if isinstance(item, Frame):
            self.handed_ns[item.seq] = time.monotonic_ns()
            self._look(item.seq)
        return item

    def _look(self, seq: int) -> None:
        now = time.thread_time(), time.process_time(), time.monotonic()
        if self._begun is None:
            if seq >= _BEGIN_S * scene.FPS:
                self._begun, self.dropped_at_first = now, self.dropped
            return
        self.loop_s, self.process_s, self.wall_s = (b - a for a, b in zip(self._begun, now, strict=True))

    def close(self) -> None:
        if self._camera is not None:
            self._camera.close()


class _Lived(NamedTuple):
    """A live run: its source, summary of its frames' times (ms), what its recording dropped and wrote (bytes), and how
    many records a subscriber received of how many.
    """

    source: _Live
    ms: dict[str, float]
    unrecorded: int
    written: int
    received: str


def _lived(path: Path, seconds: float, real_time: bool = False) -> _Lived:
    """A live camera at 60 frames/s, the loop with its publisher and its recording, on any core."""
    ring = scene.Ring.load(path)
    config = scene.config_for(ring.size)
    prioritised = msgspec.structs.replace(config.settings.daemon, real_time=real_time)
    config = dataclasses.replace(config, settings=msgspec.structs.replace(config.settings, daemon=prioritised))
    count = round((_BEGIN_S + seconds) * scene.FPS)
    with tempfile.TemporaryDirectory(prefix="gripmon-bench-") as scratch:
        recorder = SwitchedRecorder(config, Path(scratch))
        recorder.on = True
        source = _Live(ring, path, count)
        with harness.published(config) as (publisher, subscriber):
            harness.run_loop(config, source, publisher, recorder)
        written = sum(file.stat().st_size for file in Path(scratch).glob("*.rrd"))
    came = source.handed_ns >= 0
    came[: round(_BEGIN_S * scene.FPS)] = False
    ms = harness.summary(1e-3 * source.latency_us()[came])
    return _Lived(source, ms, recorder.dropped, written, f"{len(subscriber.seqs):,} of {count:,}")


@contextlib.contextmanager
def _never_asleep(count: int) -> Iterator[None]:
    """Processes that take all that the scheduler gives them, on any core."""
    command = [sys.executable, "-c", "while True: pass"]
    processes = [subprocess.Popen(command) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def load(paths: tuple[Path, ...], plan: Plan) -> Measured:
    """The daemon alone, and beside two processes that never sleep; then there with real-time priority."""
    free = _lived(paths[0], plan.load_s)
    with _never_asleep(_NEVER_ASLEEP):
        busy, first = (_lived(paths[0], plan.load_s, real_time) for real_time in (False, True))
    title = f"beside {_NEVER_ASLEEP} processes that never sleep on {len(os.sched_getaffinity(0))} cores"
    with priority.real_time() as (_, given):
        got = f"real-time priority asked for: {given}"
    rows = _beside(title, busy, free), _beside("the same with real-time priority", first, free)
    received = f"the subscriber in another process received {busy.received}, free {free.received}"
    return Measured(rows[0] + rows[1], (received, got))


def _beside(title: str, busy: _Lived, free: _Lived) -> tuple[Row, ...]:
    """A run beside others' work, against the ``free`` one."""
    most_ms = max(LOADED_MS, 5.0 * free.ms["median"])
    return (
        Row(f"{title}, median over the free one", busy.ms["median"] / free.ms["median"], "times", LOADED,
            note=f"{busy.ms['median']:.3g} ms, free {free.ms['median']:.3g} ms"),
        Row(f"{title}, 99 %", busy.ms["p99"], "ms", most_ms,
            note=f"free {free.ms['p99']:.3g} ms; 10 ms, or 5 usual frames of a slower machine"),
        Row(f"{title}, longest of {busy.ms['count']:,}", busy.ms["max"], "ms", note=f"free {free.ms['max']:.3g} ms"),
        Row(f"{title}, frames dropped after the first {_BEGIN_S:g} s", _dropped(busy), "frames", 0,
            note=f"free {_dropped(free)}; in these {busy.source.dropped_at_first} and {free.source.dropped_at_first}"),
    )  # fmt: skip


def _dropped(run: _Lived) -> int:
    return run.source.dropped - run.source.dropped_at_first


def daemon(paths: tuple[Path, ...], plan: Plan) -> Measured:
    """A live camera at 60 frames/s, with recording."""
    source, ms, unrecorded, written, received = _lived(paths[0], plan.daemon_s)
    share, whole = (100.0 * s / source.wall_s for s in (source.loop_s, source.process_s))
    return Measured(
        (
            Row("daemon at 60 frames/s with recording: the loop's thread", share, "% of a core", OF_A_CORE,
                note=f"the whole process {whole:.3g} %, and the recording's own process"),
            Row(f"frames dropped in {_BEGIN_S + plan.daemon_s:g} s", source.dropped, "frames", 0,
                note="aimed at in ten minutes: --daemon-s 600" if plan.daemon_s < 600.0 else ""),
            Row("frames that the recording dropped", unrecorded, "frames", 0,
                note=f"{1e-6 * written:.0f} MB written"),
            Row("frame handed over -> published, median", ms["median"], "ms",
                note=f"99 % {ms['p99']:.3g} ms, longest {ms['max']:.3g} ms"),
        ),
        (f"the subscriber in another process received {received}",),
    )  # fmt: skip
