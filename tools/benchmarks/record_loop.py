"""The daemon's loop with its recording off, on, and on with a disk that stands still: in turns, in one run."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import harness, scene, stalled_disk
from benchmarks.switched import SwitchedRecorder
from gripmon.daemon.config import Config

CONDITIONS = ("off", "on", "stalled")
_CAUGHT_UP_WITHIN_S = 60.0


@dataclass(frozen=True)
class Plan:
    """Frames of each condition at a time, of them to settle, and turns of all three."""

    sizes: tuple[scene.Size, ...] = ((768, 576), (1920, 1080))
    ring: int = 60
    block: int = 600
    settle: int = 60
    rounds: int = 6


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


def measure(path: Path, size: scene.Size, plan: Plan, may_mount: bool = True) -> dict[str, Any]:
    """Times of every condition, µs, as plain values; ``path`` holds the rendered frames."""
    config, ring = scene.config_for(size), scene.Ring.load(path)
    order = [CONDITIONS[(i + turn) % 3] for turn in range(plan.rounds) for i in range(3)]
    count = plan.block * len(order)
    with (
        tempfile.TemporaryDirectory(prefix="gripmon-bench-") as scratch,
        stalled_disk.disk(Path(scratch), may_mount=may_mount) as disk,
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
