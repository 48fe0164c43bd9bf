"""One side of ``tools/bench latency --against REV``, in a process with that revision's package and benchmarks:
RING SETTLE FRAMES BLOCK STAGED.

It says ``ready`` before each block and waits for a line; what it measured is the last line, JSON.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import sys
import time
from pathlib import Path
from typing import Any, TextIO

import cv2
import numpy as np


def main(ring_file: str, *numbers: str) -> None:
    settle, frames, block, staged = map(int, numbers)
    # What the product prints must not look like an answer.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    logging.getLogger("gripmon").setLevel(logging.CRITICAL)
    cv2.setNumThreads(1)
    measured = _measure(Path(ring_file), settle, settle + frames, block, bool(staged), answers)
    print(json.dumps(measured), file=answers, flush=True)


def _measure(ring_file: Path, settle: int, count: int, block: int, staged: bool, answers: TextIO) -> dict[str, Any]:
    """Times of the frames after ``settle``: µs until published and until the loop is back, and µs of each stage."""
    import gripmon
    from benchmarks import harness, scene, stages

    ring = scene.Ring.load(ring_file)
    config = scene.config_for(ring.size)
    totals_ns = np.zeros((count + 1, len(stages.STAGES) if staged else 0))
    cpu_s = np.zeros(count + 1)
    with contextlib.ExitStack() as opened:
        opened.enter_context(harness.on_one_core())
        watches = opened.enter_context(stages.stop_watches()) if staged else None

        def between(seq: int) -> None:
            note(seq)
            if seq >= settle and (seq - settle) % block == 0:
                print("ready", file=answers, flush=True)
                sys.stdin.readline()
                cpu_s[seq] = time.process_time()  # without what happened while it waited

        def note(seq: int) -> None:
            cpu_s[seq] = time.process_time()
            if watches is not None:
                totals_ns[seq] = list(watches.total_ns.values())

        source = harness.RingSource(ring, count, between=between)
        publisher, _ = opened.enter_context(harness.published(config))
        harness.run_loop(config, source, publisher)
        note(count)
    spent_us = 1e-3 * np.diff(totals_ns, axis=0)[settle:]
    # The last frame of a block ends where the next begins, which waited: without it.
    spent_s = np.diff(cpu_s)[settle:].reshape(-1, block)[:, :-1]
    return {
        "package": str(Path(gripmon.__file__).parent),
        "published_us": source.latency_us()[settle:].tolist(),
        "loop_us": source.loop_us()[settle:].tolist(),
        "cpu_us": (1e6 * spent_s.mean(axis=1)).tolist(),
        "stages_us": {name: spent_us[:, k].tolist() for k, name in enumerate(stages.STAGES)} if staged else {},
        "measured": int(source.measured[settle:].sum()),
        "valid": int(source.valid[settle:].sum()),
    }


if __name__ == "__main__":
    main(*sys.argv[1:])
