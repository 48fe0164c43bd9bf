"""``tools/bench real``: stills of real grippers, none of which moved in its camera, at limits fixed beforehand."""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks import options
from benchmarks.machine import ROOT, commit

if TYPE_CHECKING:
    from benchmarks.real_figures import Figures
    from benchmarks.real_runs import Limit, Run

_DESCRIPTION = """\
Stills of real grippers whose camera is screwed on and wasn't knocked: the true motion since the reference is zero in
each of them.  They are replayed a second apart, untaught, and taught from every other still and judged on those
between, at alert limits fixed here: what is measured, valid, how large the bounds are, and what contradicts them.
With --from-images each gripper's file is made of the same images first, by `gripmon gripper from-images`: its words and
exit code, how far its outline lies beside the one drawn by hand, and the same replays with that file.
Exit code 1 if a target is missed."""

FOLDER = ROOT.parent / "shared" / "data" / "real"
LIMITS = {"xarm": (5e-3, math.radians(8.0)), "piper": (3e-3, math.radians(6.0))}
"""Alert limits (m, rad) by folder: what tasks of these arms bear; fixed before any bound was looked at."""
LEAST_VALID = {"xarm": 12, "piper": 9}
"""Of the stills that count, by one of the bounds."""
PLAY_M = 0.9e-3
"""Largest play of these fingers: how far a still may really be from where it was."""
PROPOSED = (0.8, 1.5)
"""``check``'s proposal over the smallest limit within which the bounds of nine of ten stills are (no unit)."""


def add_parser(commands: Any) -> None:
    """Add the benchmark to ``tools/bench``."""
    parser = options.add_command(
        commands,
        "real",
        run,
        "stills of real grippers, at fixed limits",
        _DESCRIPTION,
        as_json="also write every still's pose and bounds",
        markdown=True,
    )
    parser.add_argument(
        "folder",
        nargs="*",
        type=Path,
        metavar="FOLDER",
        help="with stills and a config.yaml (default: all of ../shared/data/real)",
    )
    parser.add_argument("--from-images", action="store_true", help="with gripper files made of these images")
    parser.add_argument("--distance", metavar="M:SIGMA", help="for --from-images, of folders for which none is fixed")
    parser.add_argument("--against", metavar="REV", help="also replay with gripmon of this commit, beside it")
    parser.add_argument(
        "--limit", nargs=2, type=float, metavar=("MM", "DEGREES"), help="of folders for which no alert limit is fixed"
    )


def run(arguments: argparse.Namespace) -> int:
    """Handle ``tools/bench real``."""
    if arguments.from_images:
        return _run_from_images(arguments)
    try:
        sets = _sets(arguments)
        runs = dict(_replayed(sets, arguments.against))
    except ValueError as error:
        print(f"tools/bench real: {error}", file=sys.stderr)
        return 2
    import msgspec

    from benchmarks.real_figures import figures_of

    found = {revision: [(each, figures_of(each)) for each in made] for revision, made in runs.items()}
    faults = missed(found[commit()])
    text = report(found, faults)
    options.deliver(arguments, "real", text, msgspec.to_builtins(runs))
    return 1 if faults else 0


def _run_from_images(arguments: argparse.Namespace) -> int:
    """A set that is refused is a row, and doesn't keep the others from theirs."""
    from tempfile import TemporaryDirectory

    import msgspec

    from benchmarks.real_figures import figures_of
    from benchmarks.real_images import Task, made_from_images, missed_from_images, runs_of_made, table, tasks
    from benchmarks.real_runs import runs_of

    known = tasks(LIMITS, PLAY_M)
    every, found, faults = [], [], []
    with TemporaryDirectory(prefix="gripmon-real-") as temporary:
        for folder in arguments.folder or sorted(FOLDER / name for name in known if (FOLDER / name).is_dir()):
            name = folder.resolve().name
            task = known.get(name)
            if task is None:
                try:
                    limit = _limit(name, arguments)
                except ValueError as error:
                    print(f"tools/bench real: {error}", file=sys.stderr)
                    return 2
                options_given = ("--distance", arguments.distance) if arguments.distance else ()
                task = Task(options_given, limit, 0.0, PLAY_M)
            print(f"real, from images: {name}", file=sys.stderr)
            for of_video in (False, True) if any(folder.glob("*.mp4")) else (False,):
                made = made_from_images(name, folder, Path(temporary, f"{name}_{of_video}"), task, of_video)
                every.append(made)
                runs, play_m, refused = ([], 0.0, None) if of_video else runs_of_made(made, task, runs_of)
                own = [(run, figures_of(run)) for run in runs]
                faults += [f"{name}, from images: {refused}"] if refused else []
                found += own
                faults += missed_from_images(made, task, own, play_m)
    text = "\n".join([*table(every), "", report({commit(): found}, faults)])
    options.deliver(arguments, "real --from-images", text, msgspec.to_builtins([run for run, _ in found]))
    return 1 if faults else 0


def _limit(name: str, arguments: argparse.Namespace) -> Limit:
    """A set's alert limit.  Raises ValueError if none is fixed for it and none given."""
    from benchmarks.real_runs import Limit

    if name in LIMITS:
        return Limit(*LIMITS[name])
    if arguments.limit is None:
        raise ValueError(f"{name}: no alert limit is fixed for it; --limit MM DEGREES")
    return Limit(1e-3 * arguments.limit[0], math.radians(arguments.limit[1]))


def _sets(arguments: argparse.Namespace) -> dict[str, tuple[Path, Limit]]:
    """Folder and alert limit of each set.  Raises ValueError for one that can't be used."""
    from benchmarks.real_runs import CONFIG

    folders = arguments.folder
    if not folders:
        if not FOLDER.is_dir():
            raise ValueError(f"{FOLDER} is not there; name a folder with stills and a {CONFIG}")
        every = sorted(path for path in FOLDER.iterdir() if path.is_dir())
        folders = [path for path in every if (path / CONFIG).is_file()]
        for path in every:
            if path not in folders:
                print(f"{path.name}: skipped, it has no {CONFIG}", file=sys.stderr)
    out = {}
    for folder in folders:
        name = folder.resolve().name
        if not (folder / CONFIG).is_file():
            raise ValueError(f"{folder}: has no {CONFIG}; a folder with stills and a configuration")
        if name in out:
            raise ValueError(f"{folder}: another folder is called {name}; each under its own name")
        out[name] = folder, _limit(name, arguments)
    return out


def _replayed(sets: dict[str, tuple[Path, Limit]], against: str | None) -> Iterator[tuple[str, list[Run]]]:
    """Revision, and its runs: the other one's first."""
    from benchmarks.real_runs import runs_of
    from gripmon import InputError

    if against is not None:
        from benchmarks.revision import commit_of

        other = commit_of(against)[: len(commit().rstrip("+"))]
        yield other, _elsewhere(sets, against)
    made: list[Run] = []
    for name, (folder, limit) in sets.items():
        print(f"real: {name}", file=sys.stderr)
        try:
            made += runs_of(name, folder, limit)
        except InputError as error:
            raise ValueError(str(error)) from None
    yield commit(), made


def _elsewhere(sets: dict[str, tuple[Path, Limit]], against: str) -> list[Run]:
    import msgspec

    from benchmarks.real_runs import Run
    from benchmarks.revision import checkout_of, environment

    print(f"real: with {against}", file=sys.stderr)
    named = [f"{name}={m!r},{rad!r}={folder.resolve()}" for name, (folder, (m, rad)) in sets.items()]
    made = subprocess.run(
        [sys.executable, "-P", "-m", "benchmarks.real_runs", *named],
        env=environment(checkout_of(against)), stdout=subprocess.PIPE, check=False,
    )  # fmt: skip
    if made.returncode != 0:
        raise ValueError(f"gripmon of {against} failed (exit code {made.returncode}), see above")
    return [msgspec.json.decode(line, type=Run) for line in made.stdout.splitlines()]


def missed(found: list[tuple[Run, Figures]]) -> list[str]:
    """What was to be reached and isn't, in words."""
    from benchmarks.real_runs import BELIEF

    out = []
    for name in dict.fromkeys(run.name for run, _ in found):
        own = [(run, figures) for run, figures in found if run.name == name]
        most = max(figures.valid for run, figures in own if run.bound != BELIEF)  # that one isn't said by anything yet
        if most < LEAST_VALID.get(name, 0):
            out.append(f"{name}: at most {most} of {own[0][1].stills} stills valid; at least {LEAST_VALID[name]}")
        for run, figures in own:
            what = f"{name}, {way(run)}, {run.bound} bound"
            out += [f"{what}: {each}" for each in untrue(figures, PLAY_M)]
            ratios = figures.proposed / figures.least
            if run.bound != BELIEF and not all(PROPOSED[0] <= ratio <= PROPOSED[1] for ratio in ratios):
                proposal = f"{ratios[0]:.2g} (position) and {ratios[1]:.2g} (rotation) of the limits that are needed"
                out.append(f"{what}: check proposes {proposal}; {PROPOSED[0]:g} to {PROPOSED[1]:g}")
    return out


def untrue(figures: Figures, play_m: float) -> list[str]:
    """What contradicts a true motion of at most the play (m)."""
    out = []
    far = [m for m, rad in figures.beyond if m > play_m or rad > 0.0]
    if far:
        out.append(f"{len(far)} stills beyond their bound by more than play")
    if figures.alerts:
        out.append(f"alerts that the mount moved: {_counts(figures.alerts)}")
    return out


_HEAD = (
    "| set | commit | bound | measured | valid | median bound, mm, ° | 90 % within | `check` proposes "
    "| scatter x y z, mm | about x y z, ° | χ² scatter | χ² motion | beyond it | alerts |\n"
    "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |"
)


def report(found: dict[str, list[tuple[Run, Figures]]], faults: list[str]) -> str:
    """The table, a row for each set, way, bound and commit; what makes the bounds as large; what is missed."""
    lines, why = [_HEAD], []
    every = [(revision, run, figures) for revision, own in found.items() for run, figures in own]
    ways = dict.fromkeys((run.name, run.taught) for _, run, _ in every)
    for way in ways:  # a commit's rows of one set beside the other's
        for revision, run, figures in every:
            if (run.name, run.taught) == way:
                lines.append(_row(run, figures, revision))
                why += _why(run, figures, revision)
    targets = [f"MISSED: {fault}" for fault in faults] or ["every target is reached"]
    return "\n".join([*lines, "", *why, "", *targets])


def _row(run: Run, figures: Figures, revision: str) -> str:
    turned = [f"{v:.2f}" for v in map(math.degrees, figures.scatter[3:])]
    beyond = str(len(figures.beyond))
    if figures.beyond:
        beyond += f" (by {1e3 * max(m for m, _ in figures.beyond):.2f} mm at most)"
    if run.bound == "reference":
        beyond += f", {len(figures.moved_beyond)} from the reference"
    cells = [
        f"{run.name}, {way(run)}",
        revision,
        run.bound,
        f"{figures.measured} of {figures.stills}",
        str(figures.valid),
        _both(figures.bound),
        _both(figures.least),
        _both(figures.proposed),
        " ".join(f"{1e3 * v:.2f}" for v in figures.scatter[:3]),
        " ".join(turned),
        f"{figures.chi2_scatter:.3g}",
        f"{figures.chi2_motion:.3g}",
        beyond,
        _counts(figures.alerts) or "0",
    ]
    return f"| {' | '.join(cells)} |"


def _why(run: Run, figures: Figures, revision: str) -> list[str]:
    what = f"{run.name}, {way(run)}, {run.bound}, {revision}"
    out = []
    if figures.hypotheses:
        out.append(f"{what}: the bound is as large since it can't be excluded: {_counts(figures.hypotheses)}")
    if figures.reasons:
        out.append(f"{what}: not measured: {_counts(figures.reasons)}")
    return out + [f"{what}: {each}" for each in figures.teaching]


def way(run: Run) -> str:
    """In words."""
    return "taught" if run.taught else "untaught"


def _both(bounds: Any) -> str:
    import numpy as np

    if not np.isfinite(bounds).all():
        return "none"
    return f"{1e3 * bounds[0]:.3g}, {math.degrees(bounds[1]):.3g}"


def _counts(counts: Counter[str]) -> str:
    return ", ".join(f"{what} {number}" for what, number in counts.most_common())
