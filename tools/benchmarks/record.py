"""``tools/bench record``: what the recording costs the loop, the disk and those who read it, and what a kill loses."""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks import options
from benchmarks.rings import Rings, in_new_process

_DESCRIPTION = """\
Times the daemon's own loop at 60 frames/s with its recording off, on, and on with a disk that stands still
(a frozen file system of its own as root, else the stopped recording process), in turns, in one run; counts
bytes an hour by image policy, from half a minute each; writes an hour of recording and times gripmon's
commands on it; kills a daemon and its recording process 50 times (SIGKILL) and looks what the file lacks.
--memory: a day's frames through the recorder, as fast as it takes them, and its memory meanwhile.
Takes some half an hour; --quick, less exact, six minutes. Exit code 1 if a figure is not reached."""

PARTS = ("loop", "bytes", "hour", "killed")


@dataclass(frozen=True)
class Plan:
    """What is measured, and how much of it; the parts' own plans are theirs."""

    parts: tuple[str, ...] = PARTS
    quick: bool = False


def add_parser(commands: Any) -> None:
    """Add the benchmark to ``tools/bench``."""
    parser = options.add_command(
        commands, "record", run, "what recording costs: loop, disk, memory, a kill; and reading an hour of it",
        _DESCRIPTION, quick="a shorter run", as_json="write everything that was measured", markdown=True,
    )  # fmt: skip
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--memory", action="store_true", help="a day's frames, memory over the hours, and nothing else")
    parser.add_argument("--hours", type=float, default=None, metavar="H", help="of --memory (default 24, --quick 3)")


def run(arguments: argparse.Namespace) -> int:
    """Handle ``tools/bench record``."""
    from benchmarks import record_report

    plans = quick_plans() if arguments.quick else full_plans()
    if arguments.hours is not None:
        plans["memory"] = replace(plans["memory"], hours=arguments.hours)
    parts = ("memory",) if arguments.memory else tuple(arguments.only)
    results = measure({part: plans[part] for part in parts})
    options.deliver(arguments, "record", record_report.as_text(results), results)
    return 0 if all(met for _, _, met in record_report.verdicts(results)) else 1


def full_plans() -> dict[str, Any]:
    """The plan of each part."""
    from benchmarks import record_bytes, record_hour, record_killed, record_loop, record_memory

    return {
        "loop": record_loop.Plan(),
        "bytes": record_bytes.Plan(),
        "hour": record_hour.Plan(),
        "killed": record_killed.Plan(),
        "memory": record_memory.Plan(),
    }


def quick_plans() -> dict[str, Any]:
    """The same, with less of everything, but an hour is an hour."""
    plans = full_plans()
    return {
        "loop": replace(plans["loop"], ring=30, block=300, rounds=3),
        "bytes": replace(plans["bytes"], sizes=plans["bytes"].sizes[:1], ring=30, seconds=10.0),
        "hour": replace(plans["hour"], ring=30),
        "killed": replace(plans["killed"], tries=10),
        "memory": replace(plans["memory"], hours=3.0),
    }


def measure(plans: dict[str, Any]) -> dict[str, Any]:
    """The parts that have a plan, in a new process each; plain values by part."""
    from benchmarks import machine, record_bytes, record_hour, record_killed, record_loop, record_memory

    results: dict[str, Any] = {"machine": machine.description()}
    with tempfile.TemporaryDirectory(prefix="gripmon-bench-") as scratch:
        frames = Rings(Path(scratch))
        for part, plan in plans.items():
            print(f"{part} …", file=sys.stderr)
            if part == "loop":
                results[part] = {
                    _name(size): in_new_process(record_loop.measure, frames.of(size, plan.ring), size, plan)
                    for size in plan.sizes
                }
            elif part == "bytes":
                results[part] = {
                    _name(size): in_new_process(record_bytes.measure, frames.of(size, plan.ring, "quiet"), size, plan)
                    for size in plan.sizes
                }
            elif part == "hour":
                quiet, moving = (frames.of(plan.size, plan.ring, kind) for kind in ("quiet", "clutter"))
                results[part] = _hour(record_hour, quiet, moving, plan)
            elif part == "killed":
                results[part] = in_new_process(record_killed.measure, frames.of(plan.size, plan.ring), plan)
            else:
                results[part] = in_new_process(record_memory.measure, frames.of(plan.size, plan.ring, "quiet"), plan)
    results["machine"]["load_after"] = machine.load()
    return results


def _hour(record_hour: Any, quiet: Path, moving: Path, plan: Any) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="gripmon-bench-") as directory:
        written = in_new_process(record_hour.write, quiet, moving, Path(directory), plan)
        return {"written": written, "read": record_hour.read(Path(directory), plan)}


def _name(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"
