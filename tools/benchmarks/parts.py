"""Benchmarks of several parts, each measured in a process of its own: latency, record, wire.

A part gives rows (a figure, its target) and notes, which are said as soon as they are there; what is measured may be
kept in a file, from which an interrupted run goes on.
"""

from __future__ import annotations

import argparse
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from benchmarks import kit, scene
from benchmarks.kit import Report
from gripmon.model.errors import in_short

SMALL, LARGE = (768, 576), (1920, 1080)
_COUNTED = ("frames",)
"""Units of whole numbers."""
_HEAD = ("", "measured", "to be reached", "", "beside it")


@dataclass(frozen=True)
class Row:
    """``value`` in ``unit`` and what it has to be: ``target`` at most, or ``at_least``; None: nothing is required.

    A row without a value was skipped, or could not be measured: ``note`` says why.
    """

    what: str
    value: float | None
    unit: str
    target: float | None = None
    at_least: bool = False
    note: str = ""

    @property
    def met(self) -> bool | None:
        """None where nothing is required or nothing was measured."""
        if self.value is None or self.target is None:
            return None
        return self.value >= self.target if self.at_least else self.value <= self.target

    @property
    def figure(self) -> str:
        return "skipped" if self.value is None else with_unit(self.value, self.unit)

    @property
    def required(self) -> str:
        if self.target is None:
            return ""
        return f"{'at least' if self.at_least else 'at most'} {with_unit(self.target, self.unit)}"

    @property
    def verdict(self) -> str:
        return {True: "met", False: "missed", None: ""}[self.met]


@dataclass(frozen=True)
class Measured:
    """What a part gave: its rows, paragraphs or tables below them, and everything behind both as plain values."""

    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()
    values: dict[str, Any] = field(default_factory=dict)


def skipped(what: str, why: str) -> Measured:
    return Measured((Row(what, None, "", note=why),))


def with_unit(value: float, unit: str) -> str:
    """Three digits, but counts as they are."""
    if unit in _COUNTED:
        return f"{value:,.0f} {unit}"
    digits = f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}"
    return f"{digits} {unit}".rstrip()


@dataclass(frozen=True)
class Frames:
    """Rendered frames that a part needs: of a kind (:data:`benchmarks.scene.KINDS`), how many, and with --quick."""

    kind: str = "clutter"
    size: tuple[int, int] = SMALL
    count: int = 90
    quick: int = 16


@dataclass(frozen=True)
class Part:
    """``measure(paths, plan)`` is called in a new process with the files of its ``frames``; ``quick``: what differs
    in the ``plan`` with --quick, and of how many of the frames it is then measured.
    """

    what: str
    measure: Callable[[tuple[Path, ...], Any], Measured]
    plan: Any
    frames: tuple[Frames, ...] = ()
    quick: dict[str, Any] = field(default_factory=dict)
    quick_frames: int | None = None


def add_options(parser: argparse.ArgumentParser, quick: str) -> None:
    parser.add_argument("--quick", action="store_true", help=quick)
    parser.add_argument("--only", nargs="+", metavar="PART", default=[], help="parts with these names")
    parser.add_argument("--list", action="store_true", help="print the names of all parts and end")
    parser.add_argument(
        "--resume", type=Path, metavar="FILE",
        help="what is measured is appended there as lines of JSON; parts of the same commit that are there are not "
        "measured again",
    )  # fmt: skip


def run(
    arguments: argparse.Namespace, report: Report, parts: dict[str, Part], unasked: tuple[str, ...] = ()
) -> int | None:
    """Measure the parts that were asked for, all but those ``unasked`` by default."""
    if arguments.list:
        print("\n".join(f"{name:11s} {part.what}" for name, part in parts.items()))
        return 0
    names = kit.chosen(arguments.only or [name for name in parts if name not in unasked], parts)
    report.values["parts"] = {}
    with tempfile.TemporaryDirectory(prefix="gripmon-bench-") as scratch:
        rings = Rings(Path(scratch))
        for name in names:
            part, plan = parts[name], parts[name].plan
            frames = part.frames
            if arguments.quick:
                plan = replace(plan, **part.quick)
                frames = tuple(replace(each, count=each.quick) for each in frames[: part.quick_frames])
            key = {"part": name, "commit": report.values["machine"]["commit"], "plan": repr((plan, frames))}
            done = next((line for line in kit.kept_lines(arguments.resume) if key.items() <= line.items()), None)
            if done is None:
                begin_s = time.monotonic()
                measured, failed = _measured(part, plan, [rings.of(each) for each in frames])
                done = key | kit.plain(asdict(measured)) | {"took_s": round(time.monotonic() - begin_s, 1)}
                if not failed:
                    kit.keep_line(arguments.resume, done)
                done |= {"failed": failed}
            report.values["parts"][name] = done
            say(name, done, report)
    return None


def say(name: str, done: dict[str, Any], report: Report) -> None:
    """A part as it was measured, or kept."""
    rows = [Row(**row) for row in done["rows"]]
    report.say(
        f"### {name}", kit.table(_HEAD, [[row.what, row.figure, row.required, row.verdict, row.note] for row in rows]),
        *done["notes"],
    )  # fmt: skip
    for row in rows:
        if row.met is not None or done.get("failed"):
            report.targets.append(kit.Target(row.what, row.figure, False if done.get("failed") else row.met))


def _measured(part: Part, plan: Any, paths: list[Path]) -> tuple[Measured, bool]:
    """One part in a process of its own; and whether it failed."""
    try:
        return kit.in_new_process(part.measure, tuple(paths), plan), False
    except Exception as error:  # noqa: BLE001  the other parts are measured all the same
        traceback.print_exc()
        return skipped(part.what, f"failed: {in_short(error)}"), True


class Rings:
    """Files with frames of the benchmarks' scene, rendered when they are first asked for."""

    def __init__(self, scratch: Path) -> None:
        self._scratch = scratch

    def of(self, frames: Frames) -> Path:
        width, height = frames.size
        path = self._scratch / f"{width}x{height}-{frames.count}-{frames.kind}.npz"
        if not path.exists():
            with kit.bar("frame", frames.count) as bar:
                scene.render(frames.size, frames.count, bar.update, kind=frames.kind).save(path)
        return path
