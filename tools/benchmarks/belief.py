"""Is the belief's bound true of what is sampled from its own model, and of a world that differs from it?

Runs of eight seconds of random grippers.  Each rare fault is a stratum: forced once in a run and weighted back by its
probability; runs are what is counted, since the frames of one run depend on each other.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from benchmarks.belief_world import DT_S, FAULTS, SECOND, World
from gripmon.belief.core import Belief
from gripmon.belief.doubts import ALL_ENDS, FINGER, FOOLED_SHARE
from gripmon.belief.state import Priors

FRAMES = 120
RISKS = (1e-2, 1e-3, 1e-4)
ALERT_M, ALERT_RAD = 1e-3, math.radians(1.0)
VARIED = (
    "knock_per_s",
    "small_per_s",
    "small_m",
    "lasting_px",
    "near_px",
    "far_px",
    "creep_m_s",
    "length_m",
    "light_px",
)
"""Priors that ``--sensitivity`` changes by three, in the belief alone, in the own world without a rare fault."""


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


def run(seed: int, setup: Setup) -> Run:
    """One, of a seed."""
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


def many(seeds: range, setup: Setup, jobs: int) -> list[Run]:
    """All of them."""
    with ProcessPoolExecutor(jobs) as pool:
        out = []
        for n, done in enumerate(pool.map(partial(run, setup=setup), seeds), 1):
            out.append(done)
            print(f"\r{setup.fault or 'no rare fault'}: {n} of {len(seeds)} runs", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return out


def row(name: str, runs: list[Run]) -> str:
    """A line of the table."""
    frames = sum(r.frames for r in runs)
    beyond = [sum(r.beyond[k] for r in runs) / frames for k in range(len(RISKS))]
    bad = [sum(r.beyond[k] > 0 for r in runs) for k in range(len(RISKS))]
    available = [100.0 * sum(r.available[k] for r in runs) / frames for k in range(len(RISKS))]
    cells = " | ".join(f"{b:.1e} ({n})" for b, n in zip(beyond, bad, strict=True))
    shares = ", ".join(f"{a:.1f}" for a in available)
    middle = f"{1e3 * np.median([r.error_m for r in runs]):.4f} | {1e3 * np.median([r.bound_m for r in runs]):.3f}"
    return f"| {name} | {len(runs)} | {cells} | {shares} | {middle} | {np.mean([r.dropped for r in runs]):.1e} |"


HEAD = (
    "| | runs | " + " | ".join(f"beyond at {r:.0e} (runs)" for r in RISKS) + " | within 1 mm, 1 degree, % | "
    "error mm | bound mm at 1e-3 | dropped a frame |\n" + "|---" * (6 + len(RISKS)) + "|"
)


def sampled(seed: int, runs: int, jobs: int, differs: tuple[str, ...], setup: Setup) -> None:
    """The table by strata, and the risk of all together."""
    print(HEAD)
    usual = many(range(seed, seed + runs), replace(setup, differs=differs), jobs)
    print(row("no rare fault", usual), flush=True)
    risk = np.array([np.mean([r.beyond[k] / r.frames for r in usual]) for k in range(len(RISKS))])
    few = max(runs // 6, 1)
    for fault in FAULTS:
        forced = many(range(seed + 10**6, seed + 10**6 + few), replace(setup, fault=fault, differs=differs), jobs)
        print(row(fault, forced), flush=True)
        weight = probability(fault, Priors()) * (10.0 if "rates" in differs else 1.0)
        risk += weight * np.array([np.mean([r.beyond[k] / r.frames for r in forced]) for k in range(len(RISKS))])
    print(
        "\nsampled risk over stated risk: "
        + ", ".join(f"{s / r:.2g} at {r:.0e}" for s, r in zip(risk, RISKS, strict=True))
    )
    cpu = 1e3 * np.concatenate([r.cpu_s[1:] for r in usual])
    print(
        f"a frame: median {np.median(cpu):.2f} ms, 99 % {np.quantile(cpu, 0.99):.2f} ms of processor time\n", flush=True
    )


def handle(arguments: argparse.Namespace) -> int:
    setup = Setup(most=arguments.most, searching=not arguments.search_off)
    print(f"seed {arguments.seed}, {FRAMES} frames a run, at most {arguments.most} hypotheses\n")
    worlds = {"own": (), "second": SECOND, **{name: (name,) for name in SECOND}}
    if arguments.sensitivity:
        print(HEAD)
        for name in VARIED:
            for factor in (1.0 / 3.0, 3.0):
                priors = replace(Priors(), **{name: factor * asdict(Priors())[name]})
                runs = many(
                    range(arguments.seed, arguments.seed + arguments.runs),
                    replace(setup, priors=priors),
                    arguments.jobs,
                )
                print(row(f"{name} x {factor:.2g}", runs), flush=True)
        return 0
    print(f"{arguments.world} world\n")
    sampled(arguments.seed, arguments.runs, arguments.jobs, worlds[arguments.world], setup)
    return 0


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser("belief", description=__doc__, help="sampled risk of the belief's bound")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--runs", type=int, default=60, help="without a rare fault; a sixth of them with each (default 60)"
    )
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--most", type=int, default=256, help="hypotheses kept (default 256)")
    parser.add_argument("--world", choices=("own", "second", *SECOND), default="own")
    parser.add_argument("--search-off", action="store_true", help="without the search")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--sample", action="store_true", help="the risk of a world, by strata")
    what.add_argument("--sensitivity", action="store_true", help="priors times 3 and by 3, in the belief alone")
    parser.set_defaults(handler=handle)
