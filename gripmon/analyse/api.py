"""The Python API for recordings: :func:`correct` and :func:`report`, as ``gripmon correct`` and ``gripmon report`` use
them.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gripmon.analyse.build import AnalysedRecording, build
from gripmon.analyse.content import Report
from gripmon.analyse.corrected import CorrectedRun, correct_table, name_of, write
from gripmon.analyse.correction import STAGES
from gripmon.model.csv_rows import csv_rows
from gripmon.model.errors import InputError, NoResultError
from gripmon.model.records import to_json
from gripmon.record.read import Collection, needed_recordings

__all__ = ["Corrected", "CorrectedRun", "Reported", "correct", "report"]

Paths = Sequence[str | PathLike[str]]
Bar = Callable[[int, str], AbstractContextManager[Callable[[], None]]]
"""Number of steps and their unit -> a context manager that gives the function to call after each step."""

_SUFFIXES = (".jsonl", ".parquet", ".rrd")
_STAMPS = "a first line with the columns' names, capture times in Unix ns"


@dataclass(frozen=True)
class Reported:
    """The report as data (SI units), and each recording with its report."""

    report: Report
    analysed: tuple[AnalysedRecording, ...]

    @property
    def faults(self) -> tuple[str, ...]:
        """What could not be used, one line each."""
        return (*self.report.faults, *(fault for each in self.analysed for fault in each.report.faults))

    def json(self) -> bytes:
        """The report as data."""
        return to_json(self.report)

    def html(self, step: Callable[[], None] = lambda: None) -> bytes:
        """The report as one page that needs no network; ``step`` is called after each recording."""
        from gripmon.analyse.page import page

        return page(self.report, self.analysed, step)


def report(
    recordings: Paths,
    *,
    limit_m: float | None = None,
    limit_rad: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Reported:
    """When the cameras moved, how far, why, and which times are affected.

    ``recordings``: files (.rrd, or ``estimates.jsonl``) and folders of them.  Times in which the calibration is off at
    the TCP by more than the limits count as affected; None: the recorded configuration's limits for a warning.
    ``progress`` is called with bytes read and bytes in total.

    Raises :class:`~gripmon.model.errors.InputError` if there is no recording,
    :class:`~gripmon.model.errors.NoResultError` if no frame can be read.
    """
    found = needed_recordings([Path(path) for path in recordings], progress)
    if not any(len(each.frames) for each in found.recordings):
        faults = [*found.faults, *(fault for each in found.recordings for fault in each.faults)]
        raise NoResultError(f"no frame could be read: {'; '.join(faults) or 'the recordings are empty'}")
    return Reported(*build(found.recordings, found.faults, limit_m, limit_rad))


@dataclass(frozen=True)
class Corrected:
    """Runs with their corrections; ``faults``, one line each: what could not be used; ``written``: the files."""

    runs: tuple[CorrectedRun, ...]
    faults: tuple[str, ...]
    written: tuple[Path, ...] = ()


def correct(
    recordings: Paths,
    out: str | PathLike[str] | None = None,
    *,
    stamps: str | PathLike[str] | None = None,
    progress: Bar = lambda _steps, _unit: nullcontext(lambda: None),
) -> Corrected:
    """The best estimate of ``cam_T_grip`` for every frame of recordings, from all frames before and after it.

    ``recordings``: files (.rrd, or ``estimates.jsonl``) and folders of them; each run is corrected separately, since
    anything may have happened between two runs.  ``out``: the file to write, .jsonl, .parquet or .rrd (several runs
    give one .rrd each: ``out-1.rrd``, …).  ``stamps``: a CSV file whose column ``stamp_ns`` has the capture times (Unix
    ns) to write instead of those of the frames.

    Raises :class:`~gripmon.model.errors.InputError` before any work if files are missing or would be replaced,
    :class:`~gripmon.model.errors.NoResultError` if nothing was measured or writing fails.
    """
    paths = [Path(path) for path in recordings]
    target = None if out is None else Path(out)
    if target is not None:
        _check_target(target, paths)
    wanted_ns = None if stamps is None else _stamps(Path(stamps))
    found = needed_recordings(paths)
    if target is not None:
        _targets(target, len(found.recordings))
    runs, faults = _corrected(found, progress)
    if wanted_ns is not None:
        runs, more = _distributed(runs, wanted_ns)
        faults += more
    targets = [] if target is None else _targets(target, len(runs))
    inputs = _inputs(found) if targets else []
    for number, path in enumerate(targets):
        write(path, runs, inputs, number)
    return Corrected(tuple(runs), tuple(faults), tuple(targets))


def _check_target(out: Path, recordings: Sequence[Path]) -> None:
    if out.suffix.lower() not in _SUFFIXES:
        raise InputError(f"{out}: can't be written in this format; one of {', '.join(_SUFFIXES)}", "out")
    if out.exists() and any(path.is_file() and path.samefile(out) for path in recordings):
        raise InputError(f"{out}: is a recording to correct; another file", "out")


def _targets(out: Path, runs: int) -> list[Path]:
    """The files to write: one, or for several runs one track each, none of which may exist."""
    if out.suffix.lower() != ".rrd" or runs < 2:
        return [out]
    targets = [out.with_name(f"{out.stem}-{number}{out.suffix}") for number in range(1, runs + 1)]
    there = next((target for target in targets if target.exists()), None)
    if there is not None:
        raise InputError(
            f"{out}: each of {runs} runs gets a file of its own, and {there} is there already; another name", "out"
        )
    return targets


def _stamps(path: Path) -> NDArray[np.int64]:
    """The column ``stamp_ns`` of a CSV file."""
    stamps = []
    try:
        for place, row in csv_rows(path, _STAMPS, "capture times", ("stamp_ns",)):
            try:
                stamps.append(np.int64(int(row["stamp_ns"])))
            except (ValueError, OverflowError):
                wrong = f"{path}: {place}: '{row['stamp_ns']}' is not a capture time"
                raise InputError(f"{wrong}; a whole number, Unix ns") from None
    except InputError as error:
        raise InputError(str(error), "stamps") from None
    return np.array(stamps, np.int64)


def _corrected(found: Collection, progress: Bar) -> tuple[list[CorrectedRun], list[str]]:
    runs: list[CorrectedRun] = []
    faults = list(found.faults)
    with progress(STAGES * len(found.recordings), "stage") as step:
        for recording in found.recordings:
            faults += recording.faults
            name = name_of(recording)
            try:
                runs.append(CorrectedRun(recording, correct_table(recording.frames, step)))
            except ValueError as error:
                faults.append(f"{name}: {error}; left out")
                continue
            faults += [f"{name}: {fault}" for fault in runs[-1].correction.faults]
    if not runs:
        raise NoResultError(f"nothing was measured in the recordings: {'; '.join(faults)}")
    return runs, faults


def _distributed(runs: Sequence[CorrectedRun], wanted_ns: NDArray[np.int64]) -> tuple[list[CorrectedRun], list[str]]:
    """Assign each instant to the runs that contain it; instants in no run are counted."""
    out, faults, known = [], [], np.zeros(len(wanted_ns), bool)
    for each in runs:
        stamps = each.correction.stamp_ns
        if (np.diff(stamps) < 0).any():
            faults.append(f"{each.name}: time runs backwards: no instants of it")
            continue
        inside = (wanted_ns >= stamps[0]) & (wanted_ns <= stamps[-1])
        known |= inside
        out.append(dataclasses.replace(each, wanted_ns=wanted_ns[inside]))
    if not known.any():
        raise NoResultError("--stamps: none of the capture times lies in the recordings")
    if not known.all():
        faults.append(f"{(~known).sum()} of {len(known)} capture times lie in no recording")
    return out, faults


def _inputs(found: Collection) -> list[tuple[str, str]]:
    """Names and SHA-256 of all files that were used."""
    files = sorted({path for recording in found.recordings for path in recording.files})
    out = []
    for path in files:
        with path.open("rb") as file:
            out.append((path.name, hashlib.file_digest(file, "sha256").hexdigest()))
    return out
