"""``tools/bench laser``: the laser-pointer paper's figures 6 and 7, its real set-up with wrong spots, time, honesty."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks import options

if TYPE_CHECKING:
    import numpy as np

    from benchmarks.laser_trials import Trial

_DESCRIPTION = """\
The laser-pointer paper's simulations on its own set-up: errors of base_T_cam over noise (0 to 1 px, 50
samples: figure 6) and over samples (30 to 120 at 0.5 px: figure 7), by the closed form as printed, the
one with a common plane, refined, and by Dornaika and Horaud's method (closed, refined, refined with the
poses' covariances) on as many points; errors against Cramér-Rao's bound and coverage of the 95 %
region, from more trials, as a hundred tell them to no more than 6 and 4 %; a set-up like the paper's
real one with wrong spots; time for 90 samples.  Exit code 1 if a figure is not reached."""

_MEASURES = ("translation", "rotation")


@dataclass(frozen=True)
class Plan:
    """How much is measured."""

    trials: int = 100
    honesty_trials: int = 600
    real_trials: int = 100
    noises_px: tuple[float, ...] = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
    orientations: tuple[int, ...] = (3, 4, 5, 6, 8, 10, 12)
    wrong_shares: tuple[float, ...] = (0.0, 0.05, 0.1, 0.2, 0.3)
    seed: int = 1


def add_parser(commands: Any) -> None:
    """Add the benchmark to ``tools/bench``."""
    parser = options.add_command(
        commands, "laser", run, "the laser-pointer method: errors, bound, coverage, wrong spots, time",
        _DESCRIPTION, quick="a tenth of the trials", as_json="write everything that was measured", markdown=True,
    )  # fmt: skip
    parser.add_argument("--trials", type=options.count, metavar="N", help="trials a point (default 100)")
    parser.add_argument(
        "--honesty-trials", type=options.count, metavar="N",
        help="trials a point for bound and coverage, refined only (default six times --trials)",
    )  # fmt: skip
    parser.add_argument("--seed", type=options.count, default=1, metavar="N", help="of everything (default 1)")
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="draw the figures")


def run(arguments: argparse.Namespace) -> int:
    """Handle ``tools/bench laser``."""
    from benchmarks import laser_report

    trials = arguments.trials or (10 if arguments.quick else 100)
    honesty = arguments.honesty_trials or 6 * trials
    results = measure(Plan(trials=trials, honesty_trials=honesty, real_trials=trials, seed=arguments.seed))
    options.deliver(arguments, "laser", laser_report.as_text(results), results)
    if arguments.picture is not None:
        laser_report.draw(results, arguments.picture)
    return 0 if all(met for _, _, met in laser_report.verdicts(results)) else 1


def measure(plan: Plan) -> dict[str, Any]:
    """Everything, as plain values."""
    from benchmarks import machine
    from benchmarks.laser_trials import paper_trial, real_trial

    results: dict[str, Any] = {
        "machine": machine.description(), "trials": plan.trials, "honesty_trials": plan.honesty_trials,
        "seed": plan.seed,
    }  # fmt: skip
    results["noise"] = [
        {"noise_px": noise, **_point(plan, 1, k, plan.trials, lambda rng, n=noise: paper_trial(rng, 5, n))}
        for k, noise in enumerate(plan.noises_px)
    ]
    results["samples"] = [
        {"samples": 10 * count, **_point(plan, 2, k, plan.trials, lambda rng, m=count: paper_trial(rng, m, 0.5))}
        for k, count in enumerate(plan.orientations)
    ]
    results["honesty"] = _honesty(plan)
    # The same set-ups and noise for each share: seeds don't depend on it.
    results["wrong"] = [
        {"share": share, **_point(plan, 3, 0, plan.real_trials, lambda rng, s=share: real_trial(rng, 0.5, s))}
        for share in plan.wrong_shares
    ]
    results["machine"]["load_after"] = machine.load()
    return results


def _honesty(plan: Plan) -> list[dict[str, Any]]:
    """The points of both figures again, their data sets first, then more."""
    from benchmarks.laser_trials import paper_trial

    points = [(f"noise {noise:g}", 1, k, 5, noise) for k, noise in enumerate(plan.noises_px) if noise > 0.0]
    points += [(f"samples {10 * count}", 2, k, count, 0.5) for k, count in enumerate(plan.orientations)]
    return [
        {"point": name, **_point(plan, part, k, plan.honesty_trials,
                                 lambda rng, m=count, n=noise: paper_trial(rng, m, n, refined_only=True))}
        for name, part, k, count, noise in points
    ]  # fmt: skip


def _point(
    plan: Plan, part: int, index: int, trials: int, trial: Callable[[np.random.Generator], Trial]
) -> dict[str, Any]:
    import numpy as np

    print(f"part {part}, point {index + 1} …", file=sys.stderr)
    done = [trial(np.random.default_rng([plan.seed, part, index, k])) for k in range(trials)]
    return summary(done)


def summary(trials: Sequence[Trial]) -> dict[str, Any]:
    """Means over trials; failures counted."""
    import numpy as np

    out: dict[str, Any] = {"errors": {}, "failed": {}}
    for method in trials[0].errors:
        found = [t.errors[method] for t in trials]
        good = np.array([e for e in found if e is not None]).reshape(-1, 2)
        out["failed"][method] = len(found) - len(good)
        out["errors"][method] = {
            name: {"mean": float(good[:, i].mean()), "median": float(np.median(good[:, i]))}
            for i, name in enumerate(_MEASURES)
        } if len(good) else None  # fmt: skip
    whole = [t for t in trials if t.squared is not None and t.bound is not None and t.seconds is not None]
    if whole:
        squared, bound = np.array([t.squared for t in whole]), np.array([t.bound for t in whole])
        # Each trial by its own bound, so that the worst geometry doesn't stand for all.
        shares = squared / bound
        over = np.sqrt(shares.mean(axis=0))
        out["over_bound"] = dict(zip(_MEASURES, over.tolist(), strict=True))
        # Standard errors: of a mean, through the root.
        spread = shares.std(axis=0, ddof=min(1, len(shares) - 1)) / np.sqrt(len(shares)) / (2.0 * over)
        out["over_bound_sigma"] = dict(zip(_MEASURES, spread.tolist(), strict=True))
        out["rmse"] = {name: float(np.sqrt(squared[:, i].mean())) for i, name in enumerate(_MEASURES)}
        out["bound"] = {name: float(np.sqrt(bound[:, i].mean())) for i, name in enumerate(_MEASURES)}
        covered = [t.covered for t in whole if t.covered is not None]
        out["coverage"] = float(np.mean(covered)) if covered else None
        out["coverage_interval"] = _proportion_interval(sum(covered), len(covered)) if covered else None
        seconds, wall_s = np.array([t.seconds for t in whole]), [t.wall_s for t in whole]
        out["seconds"] = {
            "start": float(np.median(seconds[:, 0])), "refinement": float(np.median(seconds[:, 1])),
            "both_99": float(np.quantile(seconds.sum(axis=1), 0.99)),
            "wall": float(np.median(wall_s)), "wall_99": float(np.quantile(wall_s, 0.99)),
        }  # fmt: skip
        out["wrong_used"] = float(np.mean([t.wrong_used for t in whole]))
        out["good_left"] = float(np.mean([t.good_left for t in whole]))
    return out


def _proportion_interval(hits: int, count: int) -> tuple[float, float]:
    """95 % interval of a proportion (Wilson, 1927)."""
    from scipy.stats import binomtest

    interval = binomtest(hits, count).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)
