"""What all benchmarks share: a report that is printed as it is measured, tables, targets, processes, finished work."""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import msgspec
import numpy as np
from scipy import stats
from tqdm import tqdm

from benchmarks import machine

CONFIDENCE = 0.95
_VERDICTS = {True: "met", False: "MISSED", None: "not judged"}
_T = TypeVar("_T")


class Refused(ValueError):
    """A benchmark can't be run as it was asked for: one line says what, and what would be right."""


class Target(NamedTuple):
    """What is to be reached, what was, and whether; None: there is nothing to judge it by."""

    what: str
    figure: str
    met: bool | None

    @property
    def line(self) -> str:
        return f"{_VERDICTS[self.met]}: {self.what}" + (f": {self.figure}" if self.figure else "")


class Report:
    """What a benchmark says: each part is printed as soon as it is there, all of it may be kept as a file.

    ``values``: what ``--json`` writes, plain values once :func:`plain` has been over them.
    """

    def __init__(self, title: str) -> None:
        self.title, self.targets, self._said = title, list[Target](), list[str]()
        self.values: dict[str, Any] = {"machine": machine.description()}

    def say(self, *parts: str) -> None:
        """Paragraphs and tables; where and on what this runs before the first."""
        about = [] if self._said else [f"`{self.title}`", "\n".join(machine.machine_lines(self.values["machine"]))]
        for part in [*about, *parts]:
            print(part, end="\n\n", flush=True)
            self._said.append(part)

    def reach(self, targets: Iterable[tuple[str, str, bool | None]]) -> None:
        """Say what was to be reached; see :class:`Target`."""
        new = [Target(*target) for target in targets]
        self.targets += new
        self.say("\n".join(f"- {target.line}" for target in new))

    def end(self, json_file: Path | None, markdown_file: Path | None) -> int:
        """Write the files that were asked for; 1 if a target is missed, else 0."""
        self.values["machine"]["load_after"] = machine.load()
        if json_file is not None:
            json_file.write_text(json.dumps(plain(self.values), indent=1) + "\n", encoding="utf-8")
        if markdown_file is not None:
            markdown_file.write_text("\n\n".join([f"# {self.title}", *self._said[1:]]) + "\n", encoding="utf-8")
        return int(any(target.met is False for target in self.targets))


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Markdown whose columns also stand below each other on a terminal, all but the first to the right."""
    lines = [list(head), *([str(cell) for cell in row] for row in rows)]
    lines = [[*line, *[""] * (len(head) - len(line))] for line in lines]
    widths = [max(3, *(len(line[k]) for line in lines)) for k in range(len(head))]
    padded = [
        [cell.ljust(w) if k == 0 else cell.rjust(w) for k, (cell, w) in enumerate(zip(line, widths, strict=True))]
        for line in lines
    ]
    padded.insert(1, ["-" * w for w in widths])
    return "\n".join(f"| {' | '.join(line)} |" for line in padded)


def plain(value: Any) -> Any:
    """As JSON takes it; None for what is infinite or no number."""

    def as_built_in(other: Any) -> Any:
        return other.tolist() if isinstance(other, np.ndarray | np.generic) else str(other)

    return msgspec.json.decode(msgspec.json.encode(value, enc_hook=as_built_in))


def percent(share: float | None, digits: int = 1) -> str:
    return "–" if share is None or math.isnan(share) else f"{100.0 * share:.{digits}f}"


def counts(of: dict[str, int]) -> str:
    """A Counter in words, the most frequent first."""
    return ", ".join(f"{what} {number}" for what, number in sorted(of.items(), key=lambda item: -item[1]))


def share(flags: Any) -> float | None:
    """Of those that are set; None of none."""
    return float(np.mean(flags)) if len(flags) else None


def at_most(events: int, trials: int) -> float:
    """Upper bound of an event's probability, one-sided, exact for independent trials (Clopper and Pearson 1934)."""
    return 1.0 if events >= trials else float(stats.beta.ppf(CONFIDENCE, events + 1, trials - events))


def at_least(events: int, trials: int) -> float:
    """Lower bound, likewise."""
    return 1.0 - at_most(trials - events, trials)


def nees(error: Any, covariance: Any) -> Any:
    """Squared error (..., n) in units of its covariance (..., n, n): n on average if that is true."""
    return (error * np.linalg.solve(covariance, error[..., None])[..., 0]).sum(axis=-1)


def rms(values: Any, axis: Any = None) -> Any:
    """Root mean square of what is known."""
    return np.sqrt(np.nanmean(np.square(values), axis=axis))


def writable(*files: Path | None) -> None:
    """Refused before anything is measured: a file that can't be written."""
    for file in files:
        if file is not None and not os.access(file if file.exists() else file.parent, os.W_OK):
            raise Refused(f"{file}: can't be written; a file in a folder of your own")


def count(text: str) -> int:
    """A whole number from 0, as an argument's type."""
    return _from(0, text)


def positive(text: str) -> int:
    """A whole number from 1."""
    return _from(1, text)


def _from(lowest: int, text: str) -> int:
    value = int(text)
    if value < lowest:
        raise argparse.ArgumentTypeError(f"{value}; at least {lowest}")
    return value


def numbers(parser: argparse.ArgumentParser, **options: tuple[int | None, str]) -> None:
    """Options that take a whole number from 1, by name: default, and what it is."""
    for name, (default, what) in options.items():
        text = what if default is None else f"{what} (default {default})"
        parser.add_argument(f"--{name.replace('_', '-')}", type=positive, default=default, metavar="N", help=text)


def chosen(asked: Sequence[str], there: Iterable[str]) -> list[str]:
    """Those of ``there`` that were asked for, in their order; all if none was.  Refused: one that isn't there."""
    names = list(there)
    for name in asked:
        if name not in names:
            raise Refused(f"--only {name}: there is no such row; one of {', '.join(names)}")
    return [name for name in names if name in (asked or names)]


def until(condition: Callable[[], object], otherwise: str, within_s: float = 60.0) -> None:
    """Wait for something in another process or thread.  RuntimeError that says ``otherwise``: it took too long."""
    end_s = time.monotonic() + within_s
    while not condition():
        if time.monotonic() > end_s:
            raise RuntimeError(otherwise)
        time.sleep(0.01)


def progress(items: Iterable[_T], unit: str, total: int | None = None) -> Iterator[_T]:
    """The same, with a bar on standard error."""
    yield from tqdm(items, total=total, unit=unit, file=sys.stderr, disable=None)


def bar(unit: str, total: int | None = None) -> Any:
    """A bar on standard error to be advanced by hand."""
    return tqdm(total=total, unit=unit, unit_scale=total is None, file=sys.stderr, disable=None)


def in_processes(
    function: Callable[..., _T], tasks: Sequence[tuple[Any, ...]], jobs: int, unit: str = "task", *,
    prepare: Callable[[], object] | None = None,
) -> Iterator[tuple[tuple[Any, ...], _T]]:  # fmt: skip
    """Each task's arguments and result, as they are finished; in new processes of one thread each, which end with this
    one.  ``prepare`` is called in each before its first task.
    """
    if not tasks:
        return
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(min(jobs, len(tasks)), context, initializer=_begin, initargs=(prepare,))
    with pool:
        waiting: dict[Future[_T], tuple[Any, ...]] = {pool.submit(function, *task): task for task in tasks}
        for future in progress(as_completed(waiting), unit, len(tasks)):
            yield waiting[future], future.result()


def in_new_process(function: Callable[..., _T], *arguments: Any) -> _T:
    """What a function of a module returns, called where nothing else has run before."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context, initializer=_begin, initargs=(_quiet,)) as pool:
        return pool.submit(function, *arguments).result()


def _begin(prepare: Callable[[], object] | None) -> None:
    import cv2

    threading.Thread(target=_end_with_parent, name="parent", daemon=True).start()
    cv2.setNumThreads(1)
    if prepare is not None:
        prepare()


def _end_with_parent() -> None:
    """A worker would wait for work for ever if its parent was killed."""
    parent = multiprocessing.parent_process()
    assert parent is not None, "only a spawned process has one"
    parent.join()
    os._exit(1)


def _quiet() -> None:
    """Half an hour of creep passes in seconds: its alerts are published, but not also printed."""
    import logging

    logging.getLogger("gripmon").setLevel(logging.CRITICAL)


def kept_lines(file: Path | None) -> Iterator[dict[str, Any]]:
    """What an interrupted run has left, see :func:`keep_line`; a line that was cut off doesn't count."""
    for text in file.read_text(encoding="utf-8").splitlines() if file is not None and file.exists() else ():
        try:
            yield json.loads(text)
        except json.JSONDecodeError:
            continue


def keep_line(file: Path | None, line: dict[str, Any]) -> None:
    """Append what is finished as a line of JSON; one that was cut off before stays by itself."""
    if file is None:
        return
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("a+b") as out:
        torn = out.seek(0, os.SEEK_END) > 0 and out.seek(-1, os.SEEK_END) >= 0 and out.read(1) != b"\n"
        out.write((b"\n" if torn else b"") + json.dumps(line).encode() + b"\n")
