"""Is the belief's bound true of what is sampled from its own model, and of a world that differs from it?

Runs of eight seconds of random grippers.  Each rare fault is a stratum: forced once in a run and weighted back by its
probability; runs are what is counted, since the frames of one run depend on each other.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import asdict, dataclass, field, replace
from typing import NamedTuple

import numpy as np

from benchmarks import kit
from benchmarks.belief_world import DT_S, FAULTS, SECOND, World
from benchmarks.kit import Report
from gripmon.belief.core import Belief
from gripmon.belief.doubts import ALL_ENDS, FINGER, FOOLED_SHARE
from gripmon.belief.state import Priors

FRAMES = 120
RISKS = (1e-2, 1e-3, 1e-4)
ALERT_M, ALERT_RAD = 1e-3, math.radians(1.0)
VARIED = (
    "knock_per_s", "small_per_s", "small_m", "lasting_px", "near_px", "far_px", "creep_m_s", "length_m", "light_px",
)  # fmt: skip
"""Priors that ``--sensitivity`` changes by three, in the belief alone, in the own world without a rare fault."""
_HEAD = (
    "", "runs", *(f"beyond at {r:.0e} (runs)" for r in RISKS), "within 1 mm, 1 degree, %", "error mm",
    "bound mm at 1e-3", "dropped a frame",
)  # fmt: skip


@dataclass(frozen=True)
class Setup:
    """What differs in a run: the world's ``fault`` and how it ``differs``, the belief's ``priors`` and its search."""

    fault: str | None = None
    differs: tuple[str, ...] = ()
    priors: Priors = field(default_factory=Priors)
    searching: bool = True
    most: int = 256


class Run(NamedTuple):
    """Of a run's frames after the fault: how many; beyond the bound at each risk; within the alert limits at each; and
    per frame the error, m, the bound at 1e-3, m, what was dropped, hypotheses' processor time, s.
    """

    frames: int
    beyond: tuple[int, ...]
    available: tuple[int, ...]
    error_m: float
    bound_m: float
    dropped: float
    cpu_s: tuple[float, ...]


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=kit.count, default=1, metavar="N", help="of everything random (default 1)")
    kit.numbers(
        parser,
        runs=(60, "without a rare fault; a sixth of them with each"),
        jobs=(2, "runs at the same time"),
        most=(256, "hypotheses kept"),
    )
    parser.add_argument("--world", choices=("own", "second", *SECOND), default="own", help="that is sampled")
    parser.add_argument("--search-off", action="store_true", help="without the search")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--sample", action="store_true", help="the risk of a world, by strata")
    what.add_argument("--sensitivity", action="store_true", help="priors times 3 and by 3, in the belief alone")


def run(arguments: argparse.Namespace, report: Report) -> None:
    setup = Setup(most=arguments.most, searching=not arguments.search_off)
    report.say(f"seed {arguments.seed}, {FRAMES} frames a run, at most {arguments.most} hypotheses")
    if arguments.sample:
        report.say(f"{arguments.world} world")
        worlds = {"own": (), "second": SECOND, **{name: (name,) for name in SECOND}}
        _sampled(arguments, replace(setup, differs=worlds[arguments.world]), report)
        return
    rows = []
    for name in VARIED:
        for factor in (1.0 / 3.0, 3.0):
            priors = replace(Priors(), **{name: factor * asdict(Priors())[name]})
            runs = many(arguments, 0, arguments.runs, replace(setup, priors=priors))
            rows.append(row(f"{name} x {factor:.2g}", runs))
    report.say(kit.table(_HEAD, rows))


def _sampled(arguments: argparse.Namespace, setup: Setup, report: Report) -> None:
    """The table by strata, and the risk of all together."""
    usual = many(arguments, 0, arguments.runs, setup)
    rows, risk = [row("no rare fault", usual)], _risk(usual)
    for fault in FAULTS:
        forced = many(arguments, 10**6, max(arguments.runs // 6, 1), replace(setup, fault=fault))
        rows.append(row(fault, forced))
        risk += probability(fault, Priors()) * (10.0 if "rates" in setup.differs else 1.0) * _risk(forced)
    ratios = ", ".join(f"{s / r:.2g} at {r:.0e}" for s, r in zip(risk, RISKS, strict=True))
    cpu = 1e3 * np.concatenate([r.cpu_s[1:] for r in usual])
    report.say(
        kit.table(_HEAD, rows),
        f"sampled risk over stated risk: {ratios}",
        f"a frame: median {np.median(cpu):.2f} ms, 99 % {np.quantile(cpu, 0.99):.2f} ms of processor time",
    )


def _risk(runs: list[Run]) -> np.ndarray:
    return np.array([np.mean([r.beyond[k] / r.frames for r in runs]) for k in range(len(RISKS))])


def many(arguments: argparse.Namespace, offset: int, count: int, setup: Setup) -> list[Run]:
    """So many runs, in the order of their seeds."""
    first = arguments.seed + offset
    done = kit.in_processes(one, [(seed, setup) for seed in range(first, first + count)], arguments.jobs, "run")
    return [found for _, found in sorted(done, key=lambda pair: pair[0][0])]


def one(seed: int, setup: Setup) -> Run:
    """A run."""
    world = World(np.random.default_rng(seed), Priors(), FRAMES, setup.fault, setup.differs)
    belief = Belief(
        world.view.doubts, world.view.axis, setup.priors, risk=RISKS[-1], most=setup.most, searching=setup.searching
    )
    beyond, available, frames = np.zeros(len(RISKS), int), np.zeros(len(RISKS), int), 0
    errors, bounds, dropped, cpu = [], [], [], []
    for t in range(FRAMES):
        sample = world.frame()
        start = time.thread_time()
        believed = belief.update(sample.seen, DT_S, sample.told, light_memory=sample.light_memory)
        cpu.append(time.thread_time() - start)
        if t < world.at:
            continue
        frames += 1
        off = believed.motion - sample.motion
        error_m, error_rad = float(np.linalg.norm(off[:3])), float(np.linalg.norm(off[3:]))
        for k, risk in enumerate(RISKS):
            bound = belief.bound(risk)
            beyond[k] += error_m > bound.position_m or error_rad > bound.rotation_rad
            available[k] += bound.within(ALERT_M, ALERT_RAD)
        errors.append(error_m)
        bounds.append(belief.bound(1e-3).position_m)
        dropped.append(believed.dropped)
    return Run(
        frames, tuple(map(int, beyond)), tuple(map(int, available)), float(np.median(errors)), float(np.median(bounds)),
        float(np.mean(dropped)), tuple(cpu),
    )  # fmt: skip


def probability(fault: str, priors: Priors) -> float:
    """That a run has the fault."""
    seconds = FRAMES * DT_S
    unseen = min(ALL_ENDS.first + ALL_ENDS.per_s * seconds, 1.0)
    return {
        "knock": priors.knock_per_s * seconds,
        "knock unseen": priors.unseen_knock * unseen,
        "finger": 2.0 * (FINGER.first + FINGER.per_s * seconds),
        "opening": priors.opening_per_s * seconds,
        "fooled": FOOLED_SHARE * unseen,
    }[fault]


def row(name: str, runs: list[Run]) -> list[str]:
    """A line of the table."""
    frames = sum(r.frames for r in runs)
    beyond = [(sum(r.beyond[k] for r in runs) / frames, sum(r.beyond[k] > 0 for r in runs)) for k in range(len(RISKS))]
    available = [f"{100.0 * sum(r.available[k] for r in runs) / frames:.1f}" for k in range(len(RISKS))]
    return [
        name, str(len(runs)), *(f"{part:.1e} ({bad})" for part, bad in beyond), ", ".join(available),
        f"{1e3 * np.median([r.error_m for r in runs]):.4f}", f"{1e3 * np.median([r.bound_m for r in runs]):.3f}",
        f"{np.mean([r.dropped for r in runs]):.1e}",
    ]  # fmt: skip
