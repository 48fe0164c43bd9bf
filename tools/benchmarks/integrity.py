"""``tools/bench integrity``: does ``valid`` keep its promise, in random scenes that are made to mislead?"""

from __future__ import annotations

import argparse
import importlib.util
import json
import multiprocessing
import os
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import options
from gripmon.model.stopping import end_with_parent

_DESCRIPTION = """\
Runs the monitor over random scenes of every condition (free view, clutter, light, grasps, covers, things whose borders
run like the fingers', jumps, wrong models ...) and over the rendered sequences beside the checkout, if they are there.
Counts misleading frames (valid and the error exceeds the alert limit, or the frame's own protection level), and how
often the transform is valid where the gripper shows enough. The worst frames are named so that exactly their scenes
can be run again: --only NAME --seed S --scene N prints each frame of one scene.  The alert limits are data,
fixed beforehand.
A page to compare two revisions: each run with --resume FILE and the same --seed, the second with --against FIRST.
Daily: some scenes of each condition; to judge: --scenes 27 --resume FILE, which may be interrupted."""
SCENES, FRAMES, QUICK_SCENES = 4, 96, 1
JUDGED_SCENES = 27
"""Scenes of each condition from which an integrity is judged: some 2,000 in all."""
_CODE = (
    "gripmon/**/*.py",
    "configs/grippers/*.yaml",
    "tools/benchmarks/data/integrity_limits.json",
    *(f"tools/benchmarks/integrity_{part}.py" for part in ("conditions", "draft", "limits", "misleading", "practice")),
    *(f"tools/benchmarks/{name}.py" for name in ("integrity_runs", "integrity_scenes", "outline_seen", "rendered")),
    *(f"tools/benchmarks/{name}.py" for name in ("padded", "rounded", "scenes")),
)
"""What decides a scene's result."""


@dataclass(frozen=True)
class Plan:
    """What is run: scenes of each condition, frames of each scene; ``scene``: only the one with this number."""

    only: tuple[str, ...] = ()
    scenes: int = SCENES
    frames: int = FRAMES
    seed: int = 1
    jobs: int = 1
    scene: int | None = None
    state: Path | None = None
    code: str = ""
    valid_by: str = ""


def add_parser(commands: Any) -> None:
    """Add the benchmark to ``tools/bench``."""
    from benchmarks.machine import cores

    parser = options.add_command(
        commands,
        "integrity",
        run,
        "whether a valid transform can be relied on, in scenes made to mislead",
        _DESCRIPTION,
        quick=f"{QUICK_SCENES} scenes of each condition",
        seed=True,
    )
    parser.add_argument("--only", nargs="+", metavar="NAME", default=[], help="conditions with these names")
    parser.add_argument("--list", action="store_true", help="print the names of all conditions and end")
    parser.add_argument(
        "--scenes",
        type=options.positive,
        metavar="N",
        help=f"scenes of each condition (default {SCENES}; {JUDGED_SCENES} to judge by)",
    )
    parser.add_argument(
        "--frames", type=options.positive, default=FRAMES, metavar="N", help=f"frames of each scene (default {FRAMES})"
    )
    parser.add_argument(
        "--scene", type=options.count, metavar="N", help="only scene N of each condition, frame by frame"
    )
    parser.add_argument(
        "--jobs",
        type=options.positive,
        default=cores(),
        metavar="J",
        help="scenes at the same time (default: all cores)",
    )
    parser.add_argument(
        "--resume",
        type=Path,
        metavar="FILE",
        help="each finished scene is appended there as a line of JSON; those of the same code that are there are not "
        "run again",
    )
    parser.add_argument(
        "--valid-by",
        choices=("reference", "absolute", "belief"),
        default="",
        help="which bound makes a transform valid (default: the product's); by the reference both are judged; "
        "belief: what the belief says beside the rules",
    )
    parser.add_argument(
        "--against",
        type=Path,
        metavar="FILE",
        help="the same scenes as another revision left them with --resume: a short table of both",
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="write integrity.md, integrity.json and integrity/*.png there"
    )


def run(arguments: argparse.Namespace) -> int:
    """Handle ``tools/bench integrity``."""
    from benchmarks import integrity_compare, integrity_report, integrity_table
    from benchmarks.integrity_runs import names
    from benchmarks.machine import digest_of

    if arguments.list:
        print("\n".join(names()))
        return 0
    unknown = [name for name in arguments.only if name not in names()]
    if unknown:
        print(f"integrity: --only {unknown[0]}: no such condition; one of {', '.join(names())}", file=sys.stderr)
        return 2
    if arguments.out is not None and importlib.util.find_spec("matplotlib") is None:
        print("integrity: --out: matplotlib is not installed; tools/bench, or pip install '.[bench]'", file=sys.stderr)
        return 2
    scenes = arguments.scenes or (QUICK_SCENES if arguments.quick else SCENES)
    plan = Plan(
        tuple(arguments.only),
        scenes,
        arguments.frames,
        arguments.seed,
        arguments.jobs,
        arguments.scene,
        arguments.resume,
        digest_of(*_CODE),
        arguments.valid_by,
    )
    try:
        other = read_lines(arguments.against)
        if arguments.against is not None and not other:
            print(f"integrity: --against {arguments.against}: no finished scenes there", file=sys.stderr)
            return 2
        if arguments.out is not None:
            (arguments.out / integrity_report.PICTURES).mkdir(parents=True, exist_ok=True)
        lines = measure(plan)
    except OSError as error:
        print(f"integrity: {error.filename}: {error.strerror}; a place that can be written to", file=sys.stderr)
        return 2
    results = integrity_report.summarize(lines, plan.seed, plan.scenes, plan.frames)
    if plan.scene is not None:
        print("\n".join(text for line in lines for text in integrity_table.frame_lines(line)))
    if arguments.against is None:
        print(integrity_table.as_text(results))
    print(integrity_compare.as_text(lines, list(other.values())))
    if arguments.out is not None:
        integrity_report.write(results, lines, arguments.out)
    return 0


def measure(plan: Plan) -> list[dict[str, Any]]:
    """The lines of all scenes, by condition and number; those that the state file has are not run again."""
    from benchmarks.integrity_runs import names

    wanted = [name for name in names() if not plan.only or name in plan.only]
    tasks = list(_tasks(plan, wanted))
    done = read_lines(plan.state, plan.code)
    lines = {task: done[_key(task, plan)] for task in tasks if _key(task, plan) in done}
    missing = [task for task in tasks if task not in lines]
    print(
        f"integrity: seed {plan.seed}, {len(tasks)} scenes, {len(lines)} of them done, {plan.jobs} at a time",
        file=sys.stderr,
    )
    for task, line in _in_processes(missing, plan):
        line |= {"code": plan.code, "asked_by": plan.valid_by}
        lines[task] = line
        if plan.state is not None:
            append_line(plan.state, line)
    return [lines[task] for task in sorted(tasks, key=lambda task: (wanted.index(task[0]), task[1]))]


def _tasks(plan: Plan, wanted: list[str]) -> Iterator[tuple[str, int]]:
    """Condition and number of each scene, the first of each condition first: so an interrupted run is balanced."""
    from benchmarks.integrity_runs import scene_numbers

    numbers = {name: scene_numbers(name, plan.scenes) for name in wanted}
    if plan.scene is not None:
        numbers = {name: scene_numbers(name, plan.scene + 1)[plan.scene :][:1] for name in wanted}
    for number in sorted({number for each in numbers.values() for number in each}):
        yield from ((name, number) for name in wanted if number in numbers[name])


def _key(task: tuple[str, int], plan: Plan) -> tuple[Any, ...]:
    return (*task, plan.seed, plan.frames, plan.valid_by)


def read_lines(file: Path | None, code: str | None = None) -> dict[tuple[Any, ...], dict[str, Any]]:
    """Finished scenes by condition, number, seed, frames and the bound asked for, of some ``code`` or of any; the last
    of each counts.  A last line that was cut off doesn't count.  Those of before there were two bounds have one error.
    """
    if file is None or not file.exists():
        return {}
    out = {}
    for text in file.read_text(encoding="utf-8").splitlines():
        try:
            line = json.loads(text)
        except json.JSONDecodeError:
            continue
        if "code" in line and code in (None, line["code"]):
            line.setdefault("absolute_error_m", line["error_m"])
            out[line["condition"], line["scene"], line["seed"], line["asked"], line.get("asked_by", "")] = line
    return out


def append_line(file: Path, line: dict[str, Any]) -> None:
    """Add a finished scene; a line that was cut off before stays by itself."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("a+b") as out:
        torn = out.seek(0, os.SEEK_END) > 0 and out.seek(-1, os.SEEK_END) >= 0 and out.read(1) != b"\n"
        out.write((b"\n" if torn else b"") + json.dumps(line).encode() + b"\n")


def _in_processes(tasks: list[tuple[str, int]], plan: Plan) -> Iterator[tuple[tuple[str, int], dict[str, Any]]]:
    """Scenes one by one in new processes of one thread each, as they are finished."""
    from tqdm import tqdm

    if not tasks:
        return
    context = multiprocessing.get_context("spawn")
    jobs = min(plan.jobs, len(tasks))
    with (
        ProcessPoolExecutor(max_workers=jobs, mp_context=context, initializer=_prepare) as pool,
        tqdm(total=len(tasks), desc="integrity", unit="scene", file=sys.stderr, disable=None) as bar,
    ):
        waiting = {pool.submit(_scene, *task, plan.seed, plan.frames, plan.valid_by): task for task in tasks}
        for future in as_completed(waiting):
            yield waiting[future], future.result()
            bar.update()


def _prepare() -> None:
    """One thread for all; import everything now, in case the checkout changes meanwhile."""
    import cv2

    from benchmarks import integrity_runs  # noqa: F401

    end_with_parent()
    cv2.setNumThreads(1)


def _scene(name: str, number: int, seed: int, frames: int, valid_by: str) -> dict[str, Any]:
    from benchmarks.integrity_runs import run_scene

    return run_scene(name, seed, number, frames, valid_by)
