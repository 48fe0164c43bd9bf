"""Does ``valid`` keep its promise, in random scenes that are made to mislead?

Runs the monitor over random scenes of every condition (free view, clutter, light, grasps, covers, things whose borders
run like the fingers', jumps, wrong models ...) and over the rendered sequences beside the checkout, if they are there.
Counts misleading frames (valid and the error exceeds the alert limit, or the frame's own protection level), and how
often the transform is valid where the gripper shows enough. The worst frames are named so that exactly their scenes
can be run again: --only NAME --seed S --scene N prints each frame of one scene.  The alert limits are data,
fixed beforehand.
A page to compare two revisions: each run with --resume FILE and the same --seed, the second with --against FIRST.
Daily: some scenes of each condition; to judge: --scenes 27 --resume FILE, which may be interrupted.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks import integrity_stats, integrity_table, kit
from benchmarks.integrity_runs import about, names, run_scene, scene_numbers
from benchmarks.integrity_stats import by_condition, collect
from benchmarks.integrity_table import BRIEF, COLUMNS
from benchmarks.kit import Report
from benchmarks.machine import cores, digest_of

SCENES, FRAMES = 4, 96
JUDGED_SCENES = 27
"""Scenes of each condition from which an integrity is judged: some 2,000 in all."""
_CODE = (
    "gripmon/**/*.py",
    "configs/grippers/*.yaml",
    "tools/benchmarks/data/integrity_limits.json",
    *(f"tools/benchmarks/integrity_{part}.py" for part in ("conditions", "limits", "misleading", "practice", "runs")),
    *(f"tools/benchmarks/{name}.py" for name in ("integrity_scenes", "outline_seen", "rendered")),
    *(f"tools/benchmarks/{name}.py" for name in ("padded", "rounded", "scenes", "drawn", "fingers")),
)
"""What decides a scene's result."""
_GREY_DN = 0.05
"""By how much the mean grey of the first image may differ where two runs saw the same scene."""

Line = dict[str, Any]
Key = tuple[Any, ...]


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=kit.count, default=1, metavar="N", help="of everything random (default 1)")
    parser.add_argument("--only", nargs="+", metavar="NAME", default=[], help="conditions with these names")
    parser.add_argument("--list", action="store_true", help="print the names of all conditions and end")
    kit.numbers(
        parser,
        scenes=(SCENES, f"scenes of each condition; {JUDGED_SCENES} to judge by"),
        frames=(FRAMES, "frames of each scene"),
        jobs=(cores(), "scenes at the same time"),
    )
    what = "only scene N of each condition, frame by frame"
    parser.add_argument("--scene", type=kit.count, metavar="N", help=what)
    parser.add_argument(
        "--resume", type=Path, metavar="FILE",
        help="each finished scene is appended there as a line of JSON; those of the same code that are there are not "
        "run again",
    )  # fmt: skip
    parser.add_argument(
        "--valid-by", choices=("reference", "absolute", "belief"), default="",
        help="which bound makes a transform valid (default: the product's); by the reference both are judged; "
        "belief: what the belief says beside the rules",
    )  # fmt: skip
    parser.add_argument(
        "--against", type=Path, metavar="FILE",
        help="the same scenes as another revision left them with --resume: a short table of both",
    )  # fmt: skip
    parser.add_argument(
        "--picture", type=Path, metavar="FILE.png", help="draw each frame's error and bound (a Stanford diagram)"
    )


def run(arguments: argparse.Namespace, report: Report) -> int | None:
    if arguments.list:
        print("\n".join(names()))
        return 0
    wanted = kit.chosen(arguments.only, names())
    if arguments.picture is not None and importlib.util.find_spec("matplotlib") is None:
        raise kit.Refused("--picture: matplotlib is not installed; tools/bench, or pip install '.[bench]'")
    scenes = arguments.scenes
    others = list(read_lines(arguments.against).values())
    if arguments.against is not None and not others:
        raise kit.Refused(f"--against {arguments.against}: no finished scenes there")
    lines = measure(arguments, wanted, scenes)
    if arguments.scene is not None:
        for line in lines:
            report.say(*integrity_table.frame_by_frame(line))
    report.values |= {"seed": arguments.seed, "scenes": scenes, "frames": arguments.frames}
    report.values |= integrity_stats.summary(lines)
    for name, row in report.values["rows"].items():
        row["what"] = about(name)
    if others:
        _compare(lines, others, report)
    else:
        integrity_table.show(lines, report.values, report)
    if arguments.picture is not None:
        from benchmarks import integrity_plots

        integrity_plots.draw(lines, arguments.picture)
    return None


def measure(arguments: argparse.Namespace, wanted: list[str], scenes: int) -> list[Line]:
    """The lines of all scenes, by condition and number; those that the state file has are not run again."""
    code = digest_of(*_CODE)
    done = read_lines(arguments.resume, code)
    keys = [
        (name, arguments.seed, number, arguments.frames, arguments.valid_by)
        for name, number in _scenes(wanted, scenes, arguments.scene)
    ]
    lines = {key: done[key] for key in keys if key in done}
    missing = [key for key in keys if key not in lines]
    for key, line in kit.in_processes(run_scene, missing, arguments.jobs, "scene"):
        lines[key] = line | {"code": code, "asked_by": arguments.valid_by}
        kit.keep_line(arguments.resume, lines[key])
    return [lines[key] for key in sorted(keys, key=lambda key: (wanted.index(key[0]), key[2]))]


def _scenes(wanted: list[str], scenes: int, only: int | None) -> Iterator[tuple[str, int]]:
    """Condition and number of each scene, the first of each condition first: so an interrupted run is balanced."""
    numbers = {name: scene_numbers(name, scenes) for name in wanted}
    if only is not None:
        numbers = {name: scene_numbers(name, only + 1)[only:][:1] for name in wanted}
    for number in sorted({number for each in numbers.values() for number in each}):
        yield from ((name, number) for name in wanted if number in numbers[name])


def read_lines(file: Path | None, code: str | None = None) -> dict[Key, Line]:
    """Finished scenes by condition, seed, number, frames and the bound asked for, of some ``code`` or of any; the last
    of each counts.
    """
    out = {}
    for line in kit.kept_lines(file):
        if "code" in line and code in (None, line["code"]):
            out[*_key(line), line.get("asked_by", "")] = line
    return out


def _key(line: Line) -> Key:
    return line["condition"], line["seed"], line["scene"], line["asked"]


def _compare(lines: list[Line], others: list[Line], report: Report) -> None:
    """A row a condition; where the cells differ theirs, an arrow, and ours, of the scenes that both have."""
    there = {_key(line): line for line in others}
    ours = [line for line in lines if _key(line) in there]
    theirs = [there[_key(line)] for line in ours]
    if not ours:
        report.say("no scene of the other file is among these: the same --seed, --frames and conditions")
        return
    rows = []
    for (name, before), (_, after) in zip(by_condition(theirs), by_condition(ours), strict=True):
        cells = ([COLUMNS[head](integrity_stats.figures(own)) for head in BRIEF] for own in (before, after))
        rows.append([name, *(b if b == a else f"{b} → {a}" for b, a in zip(*cells, strict=True))])
    revisions = [", ".join(sorted({line["commit"] for line in of})) for of in (theirs, ours)]
    here, before = collect(ours).valid, collect(theirs).valid
    counts = [int(which.sum()) for which in (here & before, before & ~here, here & ~before, ~here & ~before)]
    report.say(
        f"{revisions[0]} → {revisions[1]}, seed {ours[0]['seed']}, {len(ours)} scenes of both",
        kit.table(("condition", *BRIEF), rows),
        integrity_table.LEGEND,
        "valid in both {}, only before {}, only after {}, in neither {}".format(*counts),
    )
    strange = [one for one, other in zip(ours, theirs, strict=True) if not _same_scene(one, other)]
    if strange:
        report.say(f"NOT THE SAME images or limits in {len(strange)} scenes, the first: {strange[0]['condition']}")
    if len(lines) > len(ours):
        report.say(f"{len(lines) - len(ours)} scenes only here")


def _same_scene(one: Line, other: Line) -> bool:
    limits = all(math.isclose(one[key], other[key], rel_tol=1e-6) for key in ("limit_m", "limit_rad"))
    return limits and abs(one["grey_dn"] - other["grey_dn"]) <= _GREY_DN
