"""``tools/bench accuracy``: errors, honesty and time of the transform in every condition, one table."""

from __future__ import annotations

import argparse
import importlib.util
import multiprocessing
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import options
from gripmon.model.stopping import end_with_parent

_DESCRIPTION = """\
Runs the monitor, by edges and by corners, over simulated scenes of every condition (clutter, occlusion, blur, noise,
light, jaws, bumps …) and over the rendered sequences beside the checkout, if they are there; compares with the truth:
errors of the TCP in camera x, y, z (µm) and of the rotation, how often the transform is given, valid, and
misleading (valid, yet farther off than the alert limit or its own bound), its squared normalised error (NEES, 6 where
the covariance is true) and the time a frame takes."""


@dataclass(frozen=True)
class Plan:
    """What is run, and how much of it; None: as each condition says."""

    only: tuple[str, ...] = ()
    scenes: int | None = None
    frames: int | None = None
    seed: int = 1
    jobs: int = 2
    peers: bool = True
    series: bool = True


def add_parser(commands: Any) -> None:
    """Add the benchmark to ``tools/bench``."""
    parser = options.add_command(
        commands,
        "accuracy",
        run,
        "errors, honesty and time of the transform in every condition; against others",
        _DESCRIPTION,
        quick="three scenes of each condition",
        seed=True,
    )
    parser.add_argument("--only", nargs="+", metavar="NAME", default=[], help="rows whose name starts so")
    parser.add_argument("--list", action="store_true", help="print the names of all rows and end")
    parser.add_argument("--scenes", type=options.positive, metavar="N", help="scenes of each condition")
    parser.add_argument("--frames", type=options.positive, metavar="N", help="frames of each scene")
    parser.add_argument(
        "--jobs", type=options.positive, default=2, metavar="N", help="rows at the same time (default 2)"
    )
    parser.add_argument("--no-peers", action="store_true", help="only our own monitor")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="write accuracy.md, accuracy.json and accuracy/*.png there"
    )


def run(arguments: argparse.Namespace) -> int:
    """Handle ``tools/bench accuracy``."""
    from benchmarks import accuracy_report, accuracy_table
    from benchmarks.rows import row_names

    if arguments.list:
        print("\n".join(row_names()))
        return 0
    unknown = [o for o in arguments.only if not any(name.startswith(o) for name in row_names())]
    if unknown:
        print(f"accuracy: --only {unknown[0]}: there is no such row; one of {', '.join(row_names())}", file=sys.stderr)
        return 2
    plan = Plan(
        tuple(arguments.only),
        3 if arguments.quick and arguments.scenes is None else arguments.scenes,
        arguments.frames,
        arguments.seed,
        arguments.jobs,
        not arguments.no_peers,
        not arguments.only and not arguments.quick,
    )
    if arguments.out is not None:
        if importlib.util.find_spec("matplotlib") is None:
            print(
                "accuracy: --out: matplotlib is not installed; tools/bench, or pip install '.[bench]'", file=sys.stderr
            )
            return 2
        try:
            (arguments.out / accuracy_report.PICTURES).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            print(
                f"accuracy: --out {arguments.out}: {error.strerror}; a folder that can be written to", file=sys.stderr
            )
            return 2
    results, tracks = measure(plan)
    print(accuracy_table.as_text(results))
    if arguments.out is not None:
        accuracy_report.write(results, tracks, arguments.out)
    return 0


def measure(plan: Plan) -> tuple[dict[str, Any], dict[str, Any]]:
    """All rows: plain values, and the tracks of each row."""
    from benchmarks import machine
    from benchmarks.accuracy_runs import WAYS
    from benchmarks.accuracy_stats import together
    from benchmarks.rows import is_simulated, row_names

    names = [name for name in row_names() if not plan.only or name.startswith(plan.only)]
    results: dict[str, Any] = {"machine": machine.description(), "plan": {"seed": plan.seed, "jobs": plan.jobs}}
    tasks = [(_row, name, plan) for name in names] + ([(_series, plan.seed)] if plan.series else [])
    done = list(_in_processes(tasks, plan.jobs))
    rows = dict(zip(names, done, strict=False))
    results["rows"] = {name: figures for name, (figures, _) in rows.items()}
    simulated = [row for name, row in results["rows"].items() if is_simulated(name)]
    results["together"] = {way: together([row["ours"][way] for row in simulated]) for way in WAYS}
    results["series"] = done[-1] if plan.series else None
    results["machine"]["load_after"] = machine.load()
    return results, {name: tracks for name, (_, tracks) in rows.items()}


def _in_processes(tasks: Sequence[tuple[Any, ...]], jobs: int) -> Iterator[Any]:
    """The results of functions with their arguments, in order; new processes, one thread each."""
    from tqdm import tqdm

    context = multiprocessing.get_context("spawn")
    with (
        ProcessPoolExecutor(max_workers=min(jobs, len(tasks)), mp_context=context, initializer=_prepare) as pool,
        tqdm(total=len(tasks), desc="accuracy", unit="row", file=sys.stderr, disable=None) as bar,
    ):
        waiting = [pool.submit(*task) for task in tasks]
        for one in waiting:
            one.add_done_callback(lambda _: bar.update())
        yield from [one.result() for one in waiting]


def _prepare() -> None:
    """One thread for all, and everything imported and run once before anything is timed."""
    import cv2

    from benchmarks import pairs, series  # noqa: F401 - so that a checkout that changes meanwhile does no harm
    from benchmarks.rows import warm_up

    end_with_parent()
    cv2.setNumThreads(1)
    warm_up()


def _series(seed: int) -> dict[str, Any]:
    """The self-viewing paper's tables beside ours (see :mod:`benchmarks.series`)."""
    from benchmarks import series

    rows = series.tables(seed)
    return {"markdown": series.markdown(rows), "verdicts": series.verdicts(rows)}


def _row(name: str, plan: Plan) -> tuple[dict[str, Any], dict[str, Any]]:
    from benchmarks.rows import measure_row

    return measure_row(name, scenes=plan.scenes, frames=plan.frames, seed=plan.seed, peers=plan.peers)
