"""``tools/bench latency``: what a frame costs, from handed over to published, and how long the program takes."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks import options
from benchmarks.latency_rows import skipped
from benchmarks.rings import Rings, in_new_process
from gripmon.model.errors import in_short

_DESCRIPTION = """\
Times the daemon's own loop (gripmon.daemon.running.run with a Zenoh publisher and a subscriber in another process) on
simulator frames that were rendered beforehand, beside it, in the same run and on one core, AprilTags on the
fingertips of the same images (cv2.aruco with sub-pixel corners, solvePnP) and ViSP's edge tracker where that is
installed; the whole daemon on a live camera, its demo, replay, starts. Each row is printed as soon as it is measured,
its target beside it. On two quiet cores, which it needs, it takes some eight minutes; --quick, less exact, one and a
half. Exit code 1 if a row is missed."""

SMALL, LARGE = (768, 576), (1920, 1080)
Size = tuple[int, int]


@dataclass(frozen=True)
class Plan:
    """How much of everything: frames that are rendered of each kind, and the plans of the two kinds of parts."""

    loop: Any
    program: Any
    ring: int = 90
    ring_large: int = 45
    ring_gone: int = 150
    small: Size = SMALL
    large: Size = LARGE


def full_plan() -> Plan:
    from benchmarks import latency_loop, latency_program

    return Plan(latency_loop.Plan(), latency_program.Plan())


def quick_plan() -> Plan:
    """Everything, but less of it."""
    from benchmarks import latency_loop, latency_program

    loop = latency_loop.Plan(
        settle=60, frames=2500, compared=1000, block=100, beside=5, turns=2, turn=150, gone=180, staged=600
    )
    program = latency_program.Plan(daemon_s=4.0, demo_s=4.0, replayed=200, starts=1, calls=3)
    return Plan(loop, program, ring=16, ring_large=6, ring_gone=54)


@dataclass(frozen=True)
class Part:
    """``frames``: kinds of rendered frames, and whether large ones; ``measure`` is called in a new process with the
    paths of their files and its plan.
    """

    what: str
    measure: str
    frames: tuple[tuple[str, bool], ...] = ()


_CLUTTER = (("clutter", False),)
PARTS = {
    "frame": Part("768 x 576, handed over -> published: median, 99 %, longest; memory", "loop.frame", _CLUTTER),
    "size": Part("1920 x 1080 against 768 x 576", "loop.size", (*_CLUTTER, ("clutter", True))),
    "clutter": Part("tags on the fingers in a cluttered scene", "loop.against_tags clutter", _CLUTTER),
    "plain": Part("tags on the fingers in a plain scene", "loop.against_tags plain", (("plain", False),)),
    "visp": Part("ViSP's edge tracker on the same frames", "loop.against_visp", _CLUTTER),
    "unreported": Part("jaw opening unreported against reported", "loop.unreported", _CLUTTER),
    "hidden": Part("a hand covers the gripper", "loop.gone hidden", (("hidden", False),)),
    "lost": Part("the gripper has left the view", "loop.gone lost", (("lost", False),)),
    "daemon": Part("a live camera at 60 frames/s, with recording", "program.daemon", (("quiet", False),)),
    "demo": Part("gripmon demo", "program.demo"),
    "replay": Part("replay of a folder, decoding aside", "program.replay", (("quiet", False), *_CLUTTER)),
    "start": Part("from the start of gripmon run to its first transform", "program.start", _CLUTTER),
    "memory": Part("gripmon run above its libraries alone", "program.memory", _CLUTTER),
    "commands": Part("gripmon --help, import gripmon", "program.commands"),
    "profile": Part("time of each stage of a frame", "loop.profile", (*_CLUTTER, ("hidden", False))),
}


def add_parser(commands: Any) -> None:
    """Add the benchmark to ``tools/bench``."""
    parser = options.add_command(
        commands,
        "latency",
        run,
        "time from frame to published transform, and of the rest of the program; against tags and ViSP",
        _DESCRIPTION,
        quick="a shorter run",
        as_json="write all rows",
    )
    parser.add_argument("--only", nargs="+", metavar="ROW", default=[], help="rows with these names")
    parser.add_argument("--list", action="store_true", help="print the names of all rows and end")
    parser.add_argument(
        "--daemon-s", type=options.positive, metavar="S", help="length of the daemon's run, s (default 60, --quick 4)"
    )
    parser.add_argument(
        "--resume",
        type=Path,
        metavar="FILE",
        help="what is measured is appended there as lines of JSON; rows of the same commit that are there are not "
        "measured again",
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="write speed.md there")
    parser.add_argument(
        "--against",
        metavar="REV",
        help="only this: the frame and its stages beside another revision's, in alternating blocks of one run; exit "
        "code 1 if a frame takes longer",
    )


def run(arguments: argparse.Namespace) -> int:
    """Handle ``tools/bench latency``."""
    from dataclasses import replace

    if arguments.list:
        print("\n".join(f"{name:11s} {part.what}" for name, part in PARTS.items()))
        return 0
    if arguments.against is not None:
        return _against(arguments)
    unknown = [name for name in arguments.only if name not in PARTS]
    if unknown:
        print(f"latency: --only {unknown[0]}: no such row; one of {', '.join(PARTS)}", file=sys.stderr)
        return 2
    plan = quick_plan() if arguments.quick else full_plan()
    if arguments.daemon_s is not None:
        plan = replace(plan, program=replace(plan.program, daemon_s=float(arguments.daemon_s)))
    try:
        for folder in (arguments.out, arguments.resume and arguments.resume.parent):
            if folder is not None:
                folder.mkdir(parents=True, exist_ok=True)
        results = measure(plan, [name for name in PARTS if name in (arguments.only or PARTS)], arguments.resume)
        if arguments.json is not None:
            arguments.json.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
        if arguments.out is not None:
            from benchmarks import latency_page

            given = " --quick" * arguments.quick
            given += "" if arguments.daemon_s is None else f" --daemon-s {arguments.daemon_s}"
            (arguments.out / "speed.md").write_text(latency_page.as_markdown(results, given), encoding="utf-8")
    except OSError as error:
        print(f"latency: {error.filename}: {error.strerror}; a place that can be written to", file=sys.stderr)
        return 2
    missed = [row for part in results["parts"].values() for row in part["missed"]]
    left_out = sum(row["value"] is None for part in results["parts"].values() for row in part["rows"])
    print((f"{len(missed)} missed" if missed else "none missed") + (f", {left_out} skipped" if left_out else ""))
    return 1 if missed else 0


def _against(arguments: argparse.Namespace) -> int:
    """Two revisions in one run."""
    from dataclasses import asdict

    from benchmarks import latency_against, machine

    try:
        plan = latency_against.QUICK if arguments.quick else latency_against.Plan()
        rows, about = latency_against.run(arguments.against, plan)
        if arguments.json is not None:
            results = {"machine": machine.description(), **about, "rows": [asdict(row) for row in rows]}
            arguments.json.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
    except (ValueError, OSError) as error:
        print(f"latency: --against {error}", file=sys.stderr)
        return 2
    print("\n".join(latency_against.as_lines(rows, about)))
    return 1 if rows[0].slower else 0


def measure(plan: Plan, names: list[str], resume: Path | None = None) -> dict[str, Any]:
    """The rows of these parts, each printed as soon as it is there; plain values."""
    from benchmarks import latency_rows, machine

    about = machine.description()
    print("\n".join(machine.machine_lines(about)), end="\n\n", flush=True)
    key = {"commit": about["commit"], "plan": repr(plan)}
    done = _finished(resume, key)
    results: dict[str, Any] = {"machine": about, "parts": {}}
    with tempfile.TemporaryDirectory(prefix="gripmon-bench-") as scratch:
        rings = Rings(Path(scratch))
        for number, name in enumerate(names, 1):
            if name not in done:
                print(f"latency: {number} of {len(names)}: {name} …", file=sys.stderr, flush=True)
                begin_s = time.monotonic()
                measured = _measured(PARTS[name], rings, plan)
                done[name] = measured | {"took_s": round(time.monotonic() - begin_s, 1)}
                if not measured.get("failed"):
                    _keep(resume, {"part": name, **key, **done[name]})
            part = latency_rows.of_plain(done[name])
            print("\n".join(latency_rows.as_lines(name, part)), flush=True)
            missed = [row.what for row in part.rows if row.met is False or done[name].get("failed")]
            results["parts"][name] = {k: done[name][k] for k in ("rows", "notes", "took_s")} | {"missed": missed}
    about["load_after"] = machine.load()
    return results


def _measured(part: Part, rings: Rings, plan: Plan) -> dict[str, Any]:
    """One part in a process of its own."""
    paths = []
    for kind, large in part.frames:
        count = plan.ring_large if large else plan.ring_gone if kind in ("hidden", "lost") else plan.ring
        paths.append(rings.of(plan.large if large else plan.small, count, kind))
    own = plan.loop if part.measure.startswith("loop.") else plan.program
    try:
        measured: dict[str, Any] = in_new_process(_call, part.measure, tuple(paths), own)
    except Exception as error:  # noqa: BLE001  the other rows are measured all the same
        traceback.print_exc()
        return skipped(part.what, f"failed: {in_short(error)}").plain() | {"failed": True}
    return measured


def _call(what: str, paths: tuple[Path, ...], plan: Any) -> dict[str, Any]:
    from benchmarks import latency_loop, latency_program

    name, *arguments = what.split()
    room, _, function = name.partition(".")
    call: Callable[..., Any] = getattr({"loop": latency_loop, "program": latency_program}[room], function)
    plain: dict[str, Any] = partial(call, paths, plan)(*arguments).plain()
    return plain


def _finished(file: Path | None, key: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """What an earlier run of the same commit and plan has left, by part; a line that was cut off doesn't count."""
    done = {}
    for text in file.read_text(encoding="utf-8").splitlines() if file is not None and file.exists() else ():
        try:
            line = json.loads(text)
        except json.JSONDecodeError:
            continue
        if all(line.get(name) == value for name, value in key.items()):
            done[line["part"]] = line
    return done


def _keep(file: Path | None, line: dict[str, Any]) -> None:
    if file is not None:
        from benchmarks.integrity import append_line

        append_line(file, line)
