"""The parts of ``tools/bench latency`` that time the daemon's own loop in this process, on rendered frames."""

from __future__ import annotations

import contextlib
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import harness, kit, machine, scene, stages, tags, visp
from benchmarks.parts import Measured, Row, skipped
from gripmon.daemon.config import Config
from gripmon.model.geometry import from_record
from gripmon.model.records import Array

LARGER, TAIL, MEDIAN_MS, LONGEST_MS, GROWN_MIB = 1.3, 3.0, 0.5, 10.0, 2.0
FASTER = {"clutter": 20.0, "plain": 8.0}
FASTER_THAN_VISP, UNREPORTED, GONE_MS = 4.0, 3.0, 5.0


@dataclass(frozen=True)
class Plan:
    """Frames of each part, after ``settle`` in which caches are filled and the first averages made.

    ``block`` frames of ours, then ``beside`` of what is compared; ``turns`` of ``turn`` frames.
    """

    settle: int = 200
    frames: int = 100_000
    compared: int = 6000
    block: int = 200
    beside: int = 10
    turns: int = 4
    turn: int = 800
    gone: int = 1500
    staged: int = 3000


def frame(paths: tuple[Path, ...], plan: Plan) -> Measured:
    """Back to back on one core, and what the process' memory does meanwhile."""
    config, ring = _scene(paths[0])
    rss: list[int] = []

    def look(seq: int) -> None:
        if seq in (min(1000, plan.frames // 2), plan.settle + plan.frames - 1):
            rss.append(machine.rss_bytes())

    with _progress(plan.settle + plan.frames) as step, harness.on_one_core():
        source = harness.RingSource(ring, plan.settle + plan.frames, between=_both(step, look))
        with harness.published(config) as (publisher, subscriber):
            harness.run_loop(config, source, publisher)
    tracking = source.tracking[plan.settle :]
    ms = harness.summary(1e-3 * source.latency_us()[plan.settle :][tracking])
    loop = harness.summary(1e-3 * source.loop_us()[plan.settle :])
    aside = len(tracking) - ms["count"]
    title = "768 x 576, handed over -> published"
    return Measured(
        (
            Row(f"{title}, median", ms["median"], "ms", MEDIAN_MS),
            Row(f"{title}, 99 % over the median", ms["p99"] / ms["median"], "times", TAIL, note=f"{ms['p99']:.3g} ms"),
            Row(f"{title}, longest of {ms['count']:,}", ms["max"], "ms", LONGEST_MS),
            Row("frames in which the state was not tracking or drifting", aside, "frames", 0),
            Row("memory of the process, from the 1000th frame to the last", (rss[-1] - rss[0]) / 2**20, "MiB",
                GROWN_MIB, note=f"{rss[-1] / 2**20:.0f} MiB"),
        ),
        (
            f"until the loop wants the next frame: median {loop['median']:.3g} ms, 99 % {loop['p99']:.3g} ms",
            f"the subscriber in another process received {len(subscriber.seqs):,} of {plan.settle + plan.frames:,}",
        ),
    )  # fmt: skip


def size(paths: tuple[Path, ...], plan: Plan) -> Measured:
    """The same scene at two image sizes, in turns."""
    small, large = (_scene(path) for path in paths)
    ms, _ = _in_turns(plan, {"small": (*small, {}), "large": (*large, {})})
    ratio = float(np.median(ms["large"]) / np.median(ms["small"]))
    text = f"{np.median(ms['large']):.3g} ms, smaller {np.median(ms['small']):.3g} ms"
    return Measured((Row("1920 x 1080 over 768 x 576, median", ratio, "times", LARGER, note=text),))


def against_tags(paths: tuple[Path, ...], plan: Plan, kind: str) -> Measured:
    """Tags on the fingers of the same images (cv2.aruco, sub-pixel corners, solvePnP) between blocks of ours."""
    config, ring = _scene(paths[0])
    tracker = tags.TagTracker(config.camera)
    times_us: list[float] = []
    errors_m: list[float] = []

    def beside(place: int) -> None:
        with _timed(times_us):
            tcp_m = tracker.tcp_m(ring.tagged[place], float(ring.jaw_openings_m[place]))
        if tcp_m is not None:
            errors_m.append(float(np.linalg.norm(tcp_m - ring.true_tcp_m[place])))

    ms = _beside(config, ring, plan, beside)
    other = harness.summary(1e-3 * np.array(times_us))
    return Measured(
        (
            Row(f"tags in a {kind} scene take, median over ours", other["median"] / ms["median"], "times",
                FASTER[kind], at_least=True, note=f"{other['median']:.3g} ms, ours {ms['median']:.3g} ms"),
            Row("the same, 99 %", other["p99"] / ms["p99"], "times",
                note=f"{other['p99']:.3g} ms, ours {ms['p99']:.3g} ms"),
        ),
        (f"both tags found in {len(errors_m)} of {len(times_us)} frames, {_error(errors_m)}",),
    )  # fmt: skip


def against_visp(paths: tuple[Path, ...], plan: Plan) -> Measured:
    """ViSP's edge tracker on the same images, without their distortion, between blocks of ours."""
    title = "ViSP's edge tracker takes, median over ours"
    why = visp.missing()
    if why is not None:
        return skipped(title, why)
    config, ring = _scene(paths[0])
    times_us: list[float] = []
    errors_m: list[float] = []
    with tempfile.TemporaryDirectory(prefix="gripmon-bench-") as scratch, harness.on_one_core():
        start_T = from_record(config.reference.cam_T_grip)
        with visp.tracker(config, ring, start_T, Path(scratch)) as tracker:

            def beside(_: int) -> None:
                place = ring.place(len(times_us))  # frame by frame: it follows, and can't jump
                took_us, tcp_m = tracker.track(place)
                times_us.append(took_us)
                if tcp_m is not None:
                    errors_m.append(float(np.linalg.norm(tcp_m - ring.true_tcp_m[place])))

            ms = _beside(config, ring, plan, beside)
    other = harness.summary(1e-3 * np.array(times_us))
    followed = sum(error_m < 2e-3 for error_m in errors_m)
    return Measured(
        (Row(title, other["median"] / ms["median"], "times", FASTER_THAN_VISP, at_least=True,
             note=f"{other['median']:.3g} ms, ours {ms['median']:.3g} ms"),),
        (f"within 2 mm of the truth in {followed} of {len(times_us)} frames, {_error(errors_m)}",),
    )  # fmt: skip


def unreported(paths: tuple[Path, ...], plan: Plan) -> Measured:
    """The same frames with the jaw opening and without it, in turns."""
    config, ring = _scene(paths[0])
    runs = {"reported": (config, ring, {}), "unreported": (config, ring, {"opening": False})}
    ms, measured = _in_turns(plan, runs)
    medians = {name: float(np.median(values)) for name, values in ms.items()}
    note = f"{medians['unreported']:.3g} ms, reported {medians['reported']:.3g} ms"
    ratio = medians["unreported"] / medians["reported"]
    return Measured(
        (Row("opening unreported over reported, median", ratio, "times", UNREPORTED, note=note),),
        ("measured: " + ", ".join(f"{name} {100.0 * share:.1f} % of the frames" for name, share in measured.items()),),
    )


def gone(paths: tuple[Path, ...], plan: Plan, kind: str) -> Measured:
    """At the camera's rate on any core, as the daemon runs: searches go on beside the frames."""
    config, ring = _scene(paths[0])
    with _progress(plan.gone) as step:
        source = harness.RingSource(ring, plan.gone, paced=True, between=step)
        with harness.published(config) as (publisher, _):
            harness.run_loop(config, source, publisher)
    away = np.array([ring.gone[ring.place(seq)] for seq in range(plan.gone)])
    settled = np.arange(plan.gone) >= scene.WARM_UP_PACED
    ms = harness.summary(1e-3 * source.latency_us()[away & settled])
    seen = harness.summary(1e-3 * source.latency_us()[~away & settled])
    wrong, measured = (int(np.count_nonzero(which & away)) for which in (source.valid, source.measured))
    title = {"hidden": "gripper hidden", "lost": "gripper lost"}[kind]
    back = ~away & (np.cumsum(away) > 0)
    again, shown = np.count_nonzero(source.measured & back), np.count_nonzero(back)
    return Measured(
        (
            Row(f"{title}, frame handed over -> answered, 99 %", ms["p99"], "ms", GONE_MS),
            Row(f"{title}, longest of {ms['count']:,}", ms["max"], "ms", note=f"median {ms['median']:.3g} ms"),
            Row("frames that were valid though nothing of it is in view", wrong, "frames", 0,
                note=f"measured, but not valid: {measured - wrong}"),
        ),
        (f"else 99 % {seen['p99']:.3g} ms, longest {seen['max']:.3g} ms; back: {again} of {shown} frames measured",),
    )  # fmt: skip


def profile(paths: tuple[Path, ...], plan: Plan) -> Measured:
    """Mean time of each stage, with stop watches in them: of frames that track, and of those that show no gripper."""
    tracking, hidden = (_staged(path, plan, gone=gone) for path, gone in zip(paths, (False, True), strict=True))
    totals_us = [sum(mean_us.values()) for mean_us in (tracking, hidden)]
    shares = zip((tracking, hidden), totals_us, strict=True)
    columns = [[f"{run[stage]:.0f}, {100 * run[stage] / us:.1f} %" for stage in stages.STAGES] for run, us in shares]
    head = ("mean, µs and share", "tracking", "gripper hidden")
    notes = kit.table(head, zip(stages.STAGES, *columns, strict=True))
    rows = (Row(f"a frame {which}, all stages below", 1e-3 * us, "ms", note="mean, with stop watches")
            for which, us in zip(("while tracking", "without a gripper"), totals_us, strict=True))  # fmt: skip
    return Measured(tuple(rows), (notes,))


def _staged(path: Path, plan: Plan, *, gone: bool) -> dict[str, float]:
    """Mean time of each stage, µs, of frames in which the gripper is in view, or ``gone``."""
    config, ring = _scene(path)
    count = plan.settle + (max(plan.staged // 4, 2 * len(ring)) if gone else plan.staged)
    counted = [seq >= plan.settle and bool(ring.gone[ring.place(seq)]) == gone for seq in range(count)]
    with harness.on_one_core(), stages.stop_watches() as watches, _progress(count) as step:

        def begin(seq: int) -> None:
            watches.counting = counted[seq]

        source = harness.RingSource(ring, count, between=_both(step, begin))
        with harness.published(config) as (publisher, _):
            harness.run_loop(config, source, publisher)
    return {stage: 1e-3 * total_ns / sum(counted) for stage, total_ns in watches.total_ns.items()}


def _scene(path: Path) -> tuple[Config, scene.Ring]:
    """A rendered ring, and the configuration of its camera."""
    ring = scene.Ring.load(path)
    return scene.config_for(ring.size), ring


def _beside(config: Config, ring: scene.Ring, plan: Plan, beside: Callable[[int], None]) -> dict[str, float]:
    """Ours on one core, ms; ``beside`` is called with places of the ring between blocks."""

    def between(seq: int) -> None:
        if seq >= plan.settle and seq % plan.block == 0:
            for place in map(ring.place, range(seq, seq + plan.beside)):
                beside(place)

    with _progress(plan.settle + plan.compared) as step, harness.on_one_core():
        source = harness.RingSource(ring, plan.settle + plan.compared, between=_both(step, between))
        with harness.published(config) as (publisher, _):
            harness.run_loop(config, source, publisher)
    return harness.summary(1e-3 * source.latency_us()[plan.settle :])


def _in_turns(
    plan: Plan, runs: dict[str, tuple[Config, scene.Ring, dict[str, Any]]]
) -> tuple[dict[str, Array], dict[str, float]]:
    """Each run for some seconds, in turns, on one core: times, ms, and the share of frames that were measured."""
    ms: dict[str, list[Array]] = {name: [] for name in runs}
    measured: dict[str, list[float]] = {name: [] for name in runs}
    with contextlib.ExitStack() as opened:
        step = opened.enter_context(_progress(plan.turns * len(runs) * (plan.settle + plan.turn)))
        opened.enter_context(harness.on_one_core())
        publishers = {name: opened.enter_context(harness.published(run[0]))[0] for name, run in runs.items()}
        for _ in range(plan.turns):
            for name, (config, ring, how) in runs.items():
                source = harness.RingSource(ring, plan.settle + plan.turn, between=step, **how)
                harness.run_loop(config, source, publishers[name])
                ms[name].append(1e-3 * source.latency_us()[plan.settle :])
                measured[name].append(float(source.measured[plan.settle :].mean()))
    return {k: np.concatenate(v) for k, v in ms.items()}, {k: float(np.mean(v)) for k, v in measured.items()}


@contextlib.contextmanager
def _progress(total: int) -> Iterator[Callable[[int], None]]:
    """A bar; what is yielded is called before each frame."""
    with kit.bar("frame", total) as bar:
        yield lambda _: bar.update()


def _both(*calls: Callable[[int], None]) -> Callable[[int], None]:
    def each(seq: int) -> None:
        for call in calls:
            call(seq)

    return each


@contextlib.contextmanager
def _timed(times_us: list[float]) -> Iterator[None]:
    start_ns = time.perf_counter_ns()
    yield
    times_us.append(1e-3 * (time.perf_counter_ns() - start_ns))


def _error(errors_m: list[float]) -> str:
    return f"median error of the TCP {1e3 * np.median(errors_m):.3f} mm" if errors_m else "no pose"
