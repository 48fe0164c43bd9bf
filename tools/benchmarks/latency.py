"""``tools/bench latency``: from a frame handed over to its transform published, and what that costs."""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from benchmarks import options

_DESCRIPTION = """\
Times the daemon's own loop (gripmon.daemon.running.run with a Zenoh publisher and a subscriber in another process) on
cluttered simulator frames that were rendered beforehand, for two image sizes: latency, share of each stage,
frames per second on one core, memory, and the cost of recording; and beside it, in the same run, interleaved
and on one thread, AprilTags on the fingertips of the same images (cv2.aruco with sub-pixel corners, solvePnP).
Takes some five minutes; --quick, less exact, one."""

SIZES = ((768, 576), (1920, 1080))

_T = TypeVar("_T")


@dataclass(frozen=True)
class Plan:
    """How much of everything is measured."""

    sizes: tuple[tuple[int, int], ...] = SIZES
    ring: int = 90
    warm_up: int = 200
    frames: int = 6000
    block: int = 200
    tags_per_block: int = 10
    staged: int = 3000
    paced_block: int = 300
    paced_blocks: int = 6
    memory_marks: tuple[int, ...] = (1_000, 10_000, 100_000)


QUICK = Plan(ring=60, frames=2000, staged=1000, paced_block=120, paced_blocks=4, memory_marks=(1_000, 5_000, 20_000))


def add_parser(commands: Any) -> None:
    """Add the benchmark to ``tools/bench``."""
    options.add_command(
        commands,
        "latency",
        run,
        "time from frame to published transform, memory, recording; against AprilTags",
        _DESCRIPTION,
        quick="a shorter run",
        as_json="write everything that was measured",
        markdown=True,
    )


def run(arguments: argparse.Namespace) -> int:
    """Handle ``tools/bench latency``."""
    from benchmarks import report

    results = measure(QUICK if arguments.quick else Plan())
    options.deliver(arguments, "latency", report.as_text(results), results)
    return 0


def measure(plan: Plan) -> dict[str, Any]:
    """Run all parts, each in a new process; plain values by part and size."""
    from benchmarks import machine

    results: dict[str, Any] = {"machine": machine.description(), "plan": {"frames": plan.frames, "ring": plan.ring}}
    with tempfile.TemporaryDirectory(prefix="gripmon-bench-") as scratch:
        for size in plan.sizes:
            name = f"{size[0]}x{size[1]}"
            path = Path(scratch) / f"{name}.npz"
            render(size, plan.ring, path)
            parts: dict[str, Callable[..., dict[str, Any]]] = {
                "latency": _latency, "stages": _stages, "recording": _recording,
            }  # fmt: skip
            if size == plan.sizes[0]:
                parts["memory"] = _memory
            for part, function in parts.items():
                print(f"{name}: {part} …", file=sys.stderr)
                results.setdefault(part, {})[name] = in_new_process(function, size, path, plan)
            path.unlink()
    results["machine"]["load_after"] = machine.load()
    return results


def render(size: tuple[int, int], count: int, path: Path, **how: float) -> None:
    """Frames of the benchmarks' scene into a file; ``how`` as :func:`benchmarks.scene.render` takes it."""
    from tqdm import tqdm

    from benchmarks import scene

    with tqdm(total=count, desc=f"render {size[0]}x{size[1]}", unit="frame", file=sys.stderr, disable=None) as bar:
        scene.render(size, count, bar.update, **how).save(path)


def in_new_process(function: Callable[..., _T], *arguments: Any) -> _T:
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=1, mp_context=context, initializer=_quiet) as pool:
        return pool.submit(function, *arguments).result()


def _quiet() -> None:
    """Half an hour of creep passes in seconds: its alerts are published, but not also printed."""
    import logging

    import cv2

    logging.getLogger("gripmon").setLevel(logging.CRITICAL)
    cv2.setNumThreads(1)


def _latency(size: tuple[int, int], path: Path, plan: Plan) -> dict[str, Any]:
    """Back to back on one core, tags between blocks of ours; then the same at the camera's rate."""
    import time

    import numpy as np

    from benchmarks import harness, scene, tags

    config, ring = scene.config_for(size), scene.Ring.load(path)
    tracker = tags.TagTracker(config.camera)
    tags_us: list[float] = []
    errors_m: list[float] = []

    def tags_between(seq: int) -> None:
        if seq % plan.block or seq < plan.warm_up:
            return
        for place in map(ring.place, range(seq, seq + plan.tags_per_block)):
            start_ns = time.perf_counter_ns()
            tcp_m = tracker.tcp_m(ring.tagged[place], float(ring.jaw_openings_m[place]))
            tags_us.append(1e-3 * (time.perf_counter_ns() - start_ns))
            if tcp_m is not None:
                errors_m.append(float(np.linalg.norm(tcp_m - ring.true_tcp_m[place])))

    with harness.on_one_core():
        source = harness.RingSource(ring, plan.warm_up + plan.frames, between=tags_between)
        with harness.published(config) as (publisher, subscriber):
            harness.run_loop(config, source, publisher)
    paced = harness.RingSource(ring, plan.paced_block * plan.paced_blocks // 2, paced=True)
    with harness.published(config) as (publisher, paced_subscriber):
        harness.run_loop(config, paced, publisher)
    back_to_back = harness.summary(source.latency_us()[plan.warm_up :])
    arrived_us = 1e-3 * (paced_subscriber.arrivals_ns - paced.handed_ns[paced_subscriber.seqs])
    return {
        "published_us": back_to_back,
        "frames_per_s_one_core": float(1e6 / np.mean(source.loop_us()[plan.warm_up :])),
        "paced_published_us": harness.summary(paced.latency_us()[scene.WARM_UP_PACED :]),
        "paced_received_us": harness.summary(arrived_us[scene.WARM_UP_PACED :]),
        "received": [len(subscriber.seqs), plan.warm_up + plan.frames],
        "tags_us": harness.summary(np.array(tags_us)),
        "tags_found": [len(errors_m), len(tags_us)],
        "tags_tcp_error_m": float(np.median(errors_m)),
        "times_faster": float(np.median(tags_us) / back_to_back["median"]),
    }


def _stages(size: tuple[int, int], path: Path, plan: Plan) -> dict[str, Any]:
    """Mean time of each stage, µs, in a run of its own."""
    from benchmarks import harness, scene, stages

    config, ring = scene.config_for(size), scene.Ring.load(path)
    with harness.on_one_core(), stages.stop_watches() as watches:

        def begin(seq: int) -> None:
            if seq == plan.warm_up:
                watches.reset()

        source = harness.RingSource(ring, plan.warm_up + plan.staged, between=begin)
        with harness.published(config) as (publisher, _):
            harness.run_loop(config, source, publisher)
    return {stage: 1e-3 * total_ns / plan.staged for stage, total_ns in watches.total_ns.items()}


def _recording(size: tuple[int, int], path: Path, plan: Plan) -> dict[str, Any]:
    """Latency at the camera's rate with recording off and on, in turns, one process."""
    import numpy as np

    from benchmarks import harness, scene
    from benchmarks.switched import SwitchedRecorder

    config, ring = scene.config_for(size), scene.Ring.load(path)
    count = plan.paced_block * plan.paced_blocks
    with tempfile.TemporaryDirectory(prefix="gripmon-bench-", dir=path.parent) as scratch:
        recorder = SwitchedRecorder(config, Path(scratch))

        def switch(seq: int) -> None:
            recorder.on = bool(seq // plan.paced_block % 2)

        source = harness.RingSource(ring, count, paced=True, between=switch)
        with harness.published(config) as (publisher, _):
            harness.run_loop(config, source, publisher, recorder)
        written = sum(file.stat().st_size for file in Path(scratch).glob("*.rrd"))
    seqs = np.arange(count)
    settled = seqs % plan.paced_block >= scene.WARM_UP_PACED
    recorded = (seqs // plan.paced_block % 2).astype(bool)
    off, on = (source.latency_us()[settled & which] for which in (~recorded, recorded))
    loop_off, loop_on = (source.loop_us()[settled & which] for which in (~recorded, recorded))
    return {
        "off_us": harness.summary(off),
        "on_us": harness.summary(on),
        "loop_off_us": harness.summary(loop_off),
        "loop_on_us": harness.summary(loop_on),
        "dropped": recorder.dropped,
        "written_bytes": written,
    }


def _memory(size: tuple[int, int], path: Path, plan: Plan) -> dict[str, Any]:
    """Memory of the process after so many frames; the frames themselves are part of it, and always the same."""
    from benchmarks import harness, machine, scene

    config, ring = scene.config_for(size), scene.Ring.load(path)
    rss: dict[str, int] = {}

    def look(seq: int) -> None:
        if seq in plan.memory_marks:
            rss[str(seq)] = machine.rss_bytes()

    source = harness.RingSource(ring, plan.memory_marks[-1] + 1, between=look)
    with harness.published(config) as (publisher, subscriber):
        harness.run_loop(config, source, publisher)
    return {"rss_bytes": rss, "received": [len(subscriber.seqs), plan.memory_marks[-1] + 1]}
