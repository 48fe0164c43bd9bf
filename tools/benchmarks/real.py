"""Stills of real grippers, none of which moved in its camera, at limits fixed beforehand.

Stills of real grippers whose camera is screwed on and wasn't knocked: the true motion since the reference is zero in
each of them.  They are replayed a second apart, untaught, and taught from every other still and judged on those
between, at alert limits fixed here: what is measured, valid, how large the bounds are, and what contradicts them.
With --from-images each gripper's file is made of the same images first, by `gripmon gripper from-images`: its words and
exit code, how far its outline lies beside the one drawn by hand, and the same replays with that file.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np

from benchmarks import kit
from benchmarks.kit import Refused, Report
from benchmarks.machine import ROOT, checkout_of, commit, commit_of, environment
from benchmarks.real_figures import Figures, figures_of
from benchmarks.real_runs import BELIEF, CONFIG, Limit, Run, runs_of
from gripmon import InputError
from gripmon.model.records import Array

FOLDER = ROOT.parent / "shared" / "data" / "real"
LIMITS = {"xarm": (5e-3, math.radians(8.0)), "piper": (3e-3, math.radians(6.0))}
"""Alert limits (m, rad) by folder: what tasks of these arms bear; fixed before any bound was looked at."""
LEAST_VALID = {"xarm": 12, "piper": 9}
"""Of the stills that count, by one of the bounds."""
PLAY_M = 0.9e-3
"""Largest play of these fingers: how far a still may really be from where it was."""
PROPOSED = (0.8, 1.5)
"""``check``'s proposal over the smallest limit within which the bounds of nine of ten stills are (no unit)."""
_HEAD = (
    "set", "commit", "bound", "measured", "valid", "median bound, mm, °", "90 % within", "`check` proposes",
    "scatter x y z, mm", "about x y z, °", "χ² scatter", "χ² motion", "beyond it", "alerts",
)  # fmt: skip

Found = Sequence[tuple[Run, Figures]]


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "folder", nargs="*", type=Path, metavar="FOLDER",
        help="with stills and a config.yaml (default: all of ../shared/data/real)",
    )  # fmt: skip
    parser.add_argument("--from-images", action="store_true", help="with gripper files made of these images")
    parser.add_argument("--distance", metavar="M:SIGMA", help="for --from-images, of folders for which none is fixed")
    parser.add_argument("--against", metavar="REV", help="also replay with gripmon of this commit, beside it")
    parser.add_argument(
        "--limit", nargs=2, type=float, metavar=("MM", "DEGREES"), help="of folders for which no alert limit is fixed"
    )


def run(arguments: argparse.Namespace, report: Report) -> None:
    if arguments.from_images:
        _run_from_images(arguments, report)
        return
    runs = dict(_replayed(_sets(arguments), arguments.against))
    found = {revision: [(each, figures_of(each)) for each in made] for revision, made in runs.items()}
    report.values["runs"] = msgspec.to_builtins(runs)
    show(found, missed(found[commit()]), report)


def _run_from_images(arguments: argparse.Namespace, report: Report) -> None:
    """A set that is refused is a row, and doesn't keep the others from theirs."""
    from benchmarks.real_images import Task, made_from_images, missed_from_images, runs_of_made, say_made, tasks

    known = tasks(LIMITS, PLAY_M)
    every, found, faults = [], [], []
    with TemporaryDirectory(prefix="gripmon-real-") as temporary:
        for folder in arguments.folder or sorted(FOLDER / name for name in known if (FOLDER / name).is_dir()):
            name = folder.resolve().name
            given = ("--distance", arguments.distance) if arguments.distance else ()
            task = known.get(name) or Task(given, _limit(name, arguments), 0.0, PLAY_M)
            print(f"real, from images: {name}", file=sys.stderr)
            for of_video in (False, True) if any(folder.glob("*.mp4")) else (False,):
                made = made_from_images(name, folder, Path(temporary, f"{name}_{of_video}"), task, of_video)
                every.append(made)
                runs, play_m, refused = ([], 0.0, None) if of_video else runs_of_made(made, task, runs_of)
                own = [(run, figures_of(run)) for run in runs]
                faults += [f"{name}, from images: {refused}"] if refused else []
                found += own
                faults += missed_from_images(made, task, own, play_m)
    report.values["runs"] = msgspec.to_builtins([run for run, _ in found])
    say_made(every, report)
    show({commit(): found}, faults, report)


def _limit(name: str, arguments: argparse.Namespace) -> Limit:
    """A set's alert limit.  Refused if none is fixed for it and none given."""
    if name in LIMITS:
        return Limit(*LIMITS[name])
    if arguments.limit is None:
        raise Refused(f"{name}: no alert limit is fixed for it; --limit MM DEGREES")
    return Limit(1e-3 * arguments.limit[0], math.radians(arguments.limit[1]))


def _sets(arguments: argparse.Namespace) -> dict[str, tuple[Path, Limit]]:
    """Folder and alert limit of each set.  Refused is one that can't be used."""
    folders = arguments.folder
    if not folders:
        if not FOLDER.is_dir():
            raise Refused(f"{FOLDER} is not there; name a folder with stills and a {CONFIG}")
        every = sorted(path for path in FOLDER.iterdir() if path.is_dir())
        folders = [path for path in every if (path / CONFIG).is_file()]
        for path in every:
            if path not in folders:
                print(f"{path.name}: skipped, it has no {CONFIG}", file=sys.stderr)
    out = {}
    for folder in folders:
        name = folder.resolve().name
        if not (folder / CONFIG).is_file():
            raise Refused(f"{folder}: has no {CONFIG}; a folder with stills and a configuration")
        if name in out:
            raise Refused(f"{folder}: another folder is called {name}; each under its own name")
        out[name] = folder, _limit(name, arguments)
    return out


def _replayed(sets: dict[str, tuple[Path, Limit]], against: str | None) -> Iterator[tuple[str, list[Run]]]:
    """Revision, and its runs: the other one's first."""
    if against is not None:
        try:
            yield commit_of(against)[: len(commit().rstrip("+"))], _elsewhere(sets, against)
        except ValueError as error:
            raise Refused(str(error)) from None
    made: list[Run] = []
    for name, (folder, limit) in sets.items():
        print(f"real: {name}", file=sys.stderr)
        try:
            made += runs_of(name, folder, limit)
        except InputError as error:
            raise Refused(str(error)) from None
    yield commit(), made


def _elsewhere(sets: dict[str, tuple[Path, Limit]], against: str) -> list[Run]:
    print(f"real: with {against}", file=sys.stderr)
    named = [f"{name}={m!r},{rad!r}={folder.resolve()}" for name, (folder, (m, rad)) in sets.items()]
    made = subprocess.run(
        [sys.executable, "-P", "-m", "benchmarks.real_runs", *named],
        env=environment(checkout_of(against)), stdout=subprocess.PIPE, check=False,
    )  # fmt: skip
    if made.returncode != 0:
        raise Refused(f"gripmon of {against} failed (exit code {made.returncode}), see above")
    return [msgspec.json.decode(line, type=Run) for line in made.stdout.splitlines()]


def missed(found: Found) -> list[str]:
    """What was to be reached and isn't, in words."""
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
        out.append(f"alerts that the mount moved: {kit.counts(figures.alerts)}")
    return out


def show(found: dict[str, Found], faults: list[str], report: Report) -> None:
    """The table, a row for each set, way, bound and commit; what makes the bounds as large; what is missed."""
    every = [(revision, run, figures) for revision, own in found.items() for run, figures in own]
    ways = list(dict.fromkeys((run.name, run.taught) for _, run, _ in every))
    every.sort(key=lambda each: ways.index((each[1].name, each[1].taught)))  # a commit's beside the other's
    report.say(kit.table(_HEAD, [_cells(run, figures, revision) for revision, run, figures in every]))
    why = [f"- {line}" for revision, run, figures in every for line in _why(run, figures, revision)]
    if why:
        report.say("\n".join(why))
    report.reach([(fault, "", False) for fault in faults] or [("every target is reached", "", True)])


def _cells(run: Run, figures: Figures, revision: str) -> list[str]:
    beyond = str(len(figures.beyond))
    if figures.beyond:
        beyond += f" (by {1e3 * max(m for m, _ in figures.beyond):.2f} mm at most)"
    if run.bound == "reference":
        beyond += f", {len(figures.moved_beyond)} from the reference"
    return [
        f"{run.name}, {way(run)}",
        revision,
        run.bound,
        f"{figures.measured} of {figures.stills}",
        str(figures.valid),
        *(_both(bounds) for bounds in (figures.bound, figures.least, figures.proposed)),
        " ".join(f"{1e3 * v:.2f}" for v in figures.scatter[:3]),
        " ".join(f"{math.degrees(v):.2f}" for v in figures.scatter[3:]),
        f"{figures.chi2_scatter:.3g}",
        f"{figures.chi2_motion:.3g}",
        beyond,
        kit.counts(figures.alerts) or "0",
    ]


def _why(run: Run, figures: Figures, revision: str) -> list[str]:
    what = f"{run.name}, {way(run)}, {run.bound}, {revision}"
    out = []
    if figures.hypotheses:
        why = kit.counts(figures.hypotheses)
        out.append(f"{what}: the bound is as large since it can't be excluded: {why}")
    if figures.reasons:
        out.append(f"{what}: not measured: {kit.counts(figures.reasons)}")
    return out + [f"{what}: {each}" for each in figures.teaching]


def way(run: Run) -> str:
    """In words."""
    return "taught" if run.taught else "untaught"


def _both(bounds: Array) -> str:
    return f"{1e3 * bounds[0]:.3g}, {math.degrees(bounds[1]):.3g}" if np.isfinite(bounds).all() else "none"
