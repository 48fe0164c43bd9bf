"""The daemon's loop with its recording off, on, and on with a disk that stands still: in turns, in one run."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import harness, kit, scene, stalled_disk
from benchmarks.parts import Measured, Row
from benchmarks.switched import SwitchedRecorder
from gripmon.daemon.config import Config

CONDITIONS = {"off": "off", "on": "on", "stalled": "on, disk stalled"}
MEDIAN, TAIL = 1.10, 1.25
"""To reach: times with recording over those without, medians and 99th percentiles."""
_CAUGHT_UP_WITHIN_S = 60.0


@dataclass(frozen=True)
class Plan:
    """Frames of each condition at a time, of them to settle, and turns of all three; whether a disk may be mounted."""

    block: int = 600
    settle: int = 60
    rounds: int = 6
    may_mount: bool = True


class _Recorder(SwitchedRecorder):
    """On, off, and on with a stalled disk; the disk goes on before anybody waits for it."""

    def __init__(self, config: Config, disk: stalled_disk.Disk) -> None:
        super().__init__(config, disk.directory)
        self._disk = disk
        self.dropped_while = dict.fromkeys(CONDITIONS, 0)
        self._condition, self._dropped_before = "off", 0

    def change(self, condition: str) -> None:
        """Between two blocks: what waited meanwhile is written first, so that no block works for another."""
        self._settle()
        self.on = condition != "off"
        self._condition = condition
        if condition == "stalled":
            self._disk.stall(self.process_id)

    def close(self, timeout_s: float = 5.0) -> None:
        self._settle()
        super().close(timeout_s)

    def _settle(self) -> None:
        self._disk.go_on()
        end_s = time.monotonic() + _CAUGHT_UP_WITHIN_S
        while self.waiting > 0 and self.failure is None and time.monotonic() < end_s:
            time.sleep(0.02)
        self.dropped_while[self._condition] += self.dropped - self._dropped_before
        self._dropped_before = self.dropped


def measure(paths: tuple[Path, ...], plan: Plan) -> Measured:
    """At each size."""
    rows: list[Row] = []
    notes, values = ["at 60 frames/s, in turns: ms, median / 99 % (longest)"], {}
    for path in paths:
        ring = scene.Ring.load(path)
        size = f"{ring.size[0]}x{ring.size[1]}"
        found = values[size] = _one(ring, plan)
        rows += _rows(size, found)
        notes += [f"{size}; stalled: {found['how']}", _table(found)]
    return Measured(tuple(rows), tuple(notes), values)


def _rows(size: str, found: dict[str, Any]) -> list[Row]:
    return [
        Row(f"{size}: {what}, {CONDITIONS[condition]}: {label} over that of off",
            found[condition][times][figure] / found["off"][times][figure], "", limit)
        for what, times in (("until published", "published_us"), ("whole loop", "loop_us"))
        for condition in ("on", "stalled")
        for figure, label, limit in (("median", "median", MEDIAN), ("p99", "99 %", TAIL))
    ]  # fmt: skip


def _table(found: dict[str, Any]) -> str:
    lines = []
    for condition, title in CONDITIONS.items():
        row = found[condition]
        times = (
            f"{1e-3 * us['median']:.3f} / {1e-3 * us['p99']:.3f} ({1e-3 * us['max']:.1f})"
            for us in (row["published_us"], row["loop_us"])
        )
        lines.append([title, *times, row["frames"], found["dropped"][condition]])
    return kit.table(("", "until published", "whole loop", "frames", "not recorded"), lines)


def _one(ring: scene.Ring, plan: Plan) -> dict[str, Any]:
    """Times of every condition, µs."""
    config, conditions = scene.config_for(ring.size), tuple(CONDITIONS)
    order = [conditions[(i + turn) % 3] for turn in range(plan.rounds) for i in range(3)]
    count = plan.block * len(order)
    with (
        tempfile.TemporaryDirectory(prefix="gripmon-bench-") as scratch,
        stalled_disk.disk(Path(scratch), may_mount=plan.may_mount) as disk,
    ):
        recorder = _Recorder(config, disk)

        def change(seq: int) -> None:
            if seq % plan.block == 0:
                recorder.change(order[seq // plan.block])

        source = harness.RingSource(ring, count, paced=True, between=change)
        with harness.published(config) as (publisher, _):
            harness.run_loop(config, source, publisher, recorder)
        how = disk.how
    return _by_condition(plan, order, source) | {"how": how, "dropped": recorder.dropped_while}


def _by_condition(plan: Plan, order: list[str], source: harness.RingSource) -> dict[str, Any]:
    seqs = np.arange(plan.block * len(order))
    settled = seqs % plan.block >= plan.settle
    which = np.array([order[seq // plan.block] for seq in seqs])
    results: dict[str, Any] = {}
    for condition in CONDITIONS:
        mine = settled & (which == condition)
        results[condition] = {
            "frames": int(mine.sum()),
            "published_us": harness.summary(source.latency_us()[mine]),
            "loop_us": harness.summary(source.loop_us()[mine]),
        }
    return results
