"""How often the drift test cries wolf, and how soon it notices.

The drift test on streams of estimates at 60 frames/s whose noise was measured on simulated images of the demo's camera
and gripper (tools/benchmarks/noise_model.py), in three regimes: the robot stands (quiet), it works over clutter
(working), and vibration, flicker, light steps and compression on top (rough).

False alarms of an unmoved camera, counted against the contract of one a day, with a 95 % confidence interval, and by a
generalised Pareto tail fitted to the largest statistics of 1024 frames each; the tail's estimate is validated where
alarms can be counted, at a contract of 1000 a day.  Delays after steps and in creeps, beside a bare threshold on the
TCP's shift and Hotelling's T² of single frames, both tuned to one false alarm a day in the same regime by such a tail.
Motions begin after --warm-up frames, by which a test that learns has learnt; streams are as long as --streams of them
need to be for all frames.  At last the noise changes from quiet to working half-way, ten minutes each.
The other parts of the same decisions have benchmarks of their own: causes, recalibration.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np

from benchmarks import kit
from benchmarks.drift_streams import (
    BLOCK_FRAMES,
    FRAMES_PER_S,
    Alarms,
    Bare,
    Chart,
    Hotelling,
    Ours,
    count_alarms,
    delays,
    tuned_threshold,
)
from benchmarks.kit import Report
from benchmarks.noise_model import REGIMES, NoiseModel
from gripmon.model.records import Array

REQUIRED = {0.1: 3, 0.05: 10}
"""A step of this many mm must be detected within this many frames."""
STEPS_MM = (0.02, 0.05, 0.1, 0.5, 4.5)
CREEPS_MM_PER_MIN = (0.01, 0.1)
CONTRACT = "ours, 1 a day"
CHANGE_STREAMS, CHANGE_FRAMES = 64, 36_864
"""Of the change of regime: before it and after it, ten minutes each."""
LOOK_FRAMES, CREEP_FRAMES = 600, 36_000
_BARE_M, _T_SQUARED = 1e-4, 40.0
"""Thresholds of the peers before they are tuned by their tails."""

Motion = Callable[[int], Array]
Tick = Callable[[int], object]


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=kit.count, default=1, metavar="N", help="of everything random (default 1)")
    kit.numbers(
        parser,
        frames=(10_000_000, "of false alarms, each regime"),
        streams=(128, "side by side; fewer are longer"),
        warm_up=(40_960, "frames before a motion begins: eleven minutes, the test learns its limits in five"),
    )
    parser.add_argument("--no-creep", action="store_true", help="leave out creeps, which take longest")


def run(arguments: argparse.Namespace, report: Report) -> None:
    streams, warm_up, seed = arguments.streams, arguments.warm_up, arguments.seed
    frames = -(-arguments.frames // (streams * BLOCK_FRAMES)) * BLOCK_FRAMES
    report.say(f"seed {seed}; {streams} streams of {frames} frames; motions after {warm_up} frames")
    report.values |= {"seed": seed, "streams": streams, "warm_up": warm_up, "regimes": {}}
    motions = _motions(streams, seed, not arguments.no_creep)
    kept = []
    for regime in REGIMES:
        model = NoiseModel.load(regime)
        with kit.bar("frame") as bar:
            alarms = _false_alarms(model, streams, frames, seed, bar.update)
            _say_alarms(regime, alarms, report)
            rows = _delays(model, alarms, streams, warm_up, seed, motions, bar.update)
            _say_delays(regime, rows, report)
        report.values["regimes"][regime] = {
            "alarms": {name: _plain(of) for name, of in alarms.items()},
            "delays": {name: {chart: _percentiles(v) for chart, v in row.items()} for name, row in rows.items()},
        }
        kept.append((regime, alarms[CONTRACT].interval_per_day[0]))
    report.values["change"] = _change(seed, report)
    what = "one false alarm a day is within the interval"
    report.reach((f"{name}: {what}", f"from {low:.3g}", low <= 1.0) for name, low in kept)


def _false_alarms(model: NoiseModel, streams: int, frames: int, seed: int, tick: Tick) -> dict[str, Alarms]:
    """Every chart without the camera having moved."""
    rng = np.random.default_rng(seed)
    out = count_alarms({CONTRACT: Ours(streams, 1.0)}, model, streams, frames, rng, tick)
    few = max(frames // 8 // BLOCK_FRAMES, 8) * BLOCK_FRAMES
    others: dict[str, Chart] = {
        "ours, 1000 a day": Ours(streams, 1000.0), "bare": Bare(_BARE_M), "T²": Hotelling(_T_SQUARED),
    }  # fmt: skip
    return {**out, **count_alarms(others, model, streams, few, rng, tick)}


def _motions(streams: int, seed: int, creeps: bool) -> dict[str, Motion]:
    """What is added to the shift, by name: steps along the camera's axes and in random directions, and creeps."""
    directions = np.random.default_rng(seed).normal(size=(streams, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    axes = {**{name: np.eye(3)[k] for k, name in enumerate("xyz")}, "any": directions}

    def shift(m: Array, grows: bool) -> Motion:
        added = np.concatenate([m, np.zeros_like(m)], axis=-1)
        return lambda frames: frames * added if grows else added

    out = {f"step {mm:g} mm, {name}": shift(1e-3 * mm * axis, False) for mm in STEPS_MM for name, axis in axes.items()}
    per_frame = 1e-3 / 60.0 / FRAMES_PER_S
    for v in CREEPS_MM_PER_MIN if creeps else ():
        out[f"creep {v:g} mm/min, any"] = shift(v * per_frame * directions, True)
    return out


def _delays(
    model: NoiseModel, alarms: dict[str, Alarms], streams: int, warm_up: int, seed: int, motions: dict[str, Motion],
    tick: Tick,
) -> dict[str, dict[str, Array]]:  # fmt: skip
    charts: dict[str, Chart] = {
        "ours": Ours(streams, 1.0),
        "bare": Bare(_BARE_M * tuned_threshold(alarms["bare"], 1.0)),
        "T²": Hotelling(_T_SQUARED * tuned_threshold(alarms["T²"], 1.0)),
    }
    out = {}
    for kind, frames in (("step", LOOK_FRAMES), ("creep", CREEP_FRAMES)):
        some = {name: motion for name, motion in motions.items() if name.startswith(kind)}
        if some:
            rng = np.random.default_rng(seed + 1)
            out |= delays(charts, model, streams, warm_up, some, frames, rng, tick)
    return out


def _change(seed: int, report: Report) -> dict[str, int]:
    """Alarms in this many frames of quiet, and in as many of working noise that follow for the same charts."""
    charts: dict[str, Chart] = {"ours": Ours(CHANGE_STREAMS, 1.0)}
    rng = np.random.default_rng(seed + 2)
    counts = {}
    with kit.bar("frame") as bar:
        for name, regime in (("before", "quiet"), ("after", "working")):
            model = NoiseModel.load(regime)
            counts[name] = count_alarms(charts, model, CHANGE_STREAMS, CHANGE_FRAMES, rng, bar.update)["ours"].count
    report.say(
        "### quiet, then working: alarms of an unmoved camera",
        f"{CHANGE_STREAMS} changes: {counts['after']} in the {CHANGE_FRAMES} frames after each, {counts['before']} in "
        "as many before",
    )
    return {"changes": CHANGE_STREAMS, "frames": CHANGE_FRAMES, **counts}


def _say_alarms(regime: str, alarms: dict[str, Alarms], report: Report) -> None:
    rows = [
        [name, f"{of.frames:.3g}", of.count, f"{of.per_day:.3g}", "{:.3g} to {:.3g}".format(*of.interval_per_day),
         f"{of.tail_per_day():.3g}"]
        for name, of in alarms.items() if name.startswith("ours")
    ]  # fmt: skip
    head = ("chart", "frames", "alarms", "a day", "95 % interval", "by the tail")
    report.say(f"### {regime}: alarms of an unmoved camera", kit.table(head, rows))


def _say_delays(regime: str, rows: dict[str, dict[str, Array]], report: Report) -> None:
    lines = []
    for name, row in rows.items():
        required = REQUIRED.get(float(name.split()[1])) if name.startswith("step") else None
        met = ""
        if required is not None:
            met = f"{required}, {'met' if _percentiles(row['ours'])['median'] <= required else 'NOT MET'}"
        lines.append([name, *(_cell(row[chart]) for chart in ("ours", "bare", "T²")), met])
    report.say(
        f"### {regime}: frames until noticed, median / 95 %; noticed at all in {LOOK_FRAMES} (creeps {CREEP_FRAMES})",
        kit.table(("motion", "ours", "bare threshold", "Hotelling T²", "required"), lines),
    )


def _cell(frames: Array) -> str:
    values = _percentiles(frames)
    median, p95 = (f"{v:.0f}" if np.isfinite(v) else "-" for v in (values["median"], values["p95"]))
    return f"{median} / {p95}, {100.0 * values['noticed']:.0f} %"


def _percentiles(frames: Array) -> dict[str, float]:
    median, p95 = np.percentile(frames, [50.0, 95.0], method="higher").tolist()
    return {"median": median, "p95": p95, "noticed": float(np.isfinite(frames).mean())}


def _plain(alarms: Alarms) -> dict[str, object]:
    return {
        "frames": alarms.frames, "count": alarms.count, "per_day": alarms.per_day,
        "per_day_95": alarms.interval_per_day, "per_day_by_tail": alarms.tail_per_day(),
    }  # fmt: skip
