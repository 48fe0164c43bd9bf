"""Partitions and files: where each row goes, written whole or not at all."""

from __future__ import annotations

import hashlib
import itertools
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from gripmon.model.atomic import opened_atomically, remove_leftovers
from gripmon.model.errors import NoResultError
from gripmon.model.records import ReferenceRecord
from gripmon.record.export.schemas import SCHEMAS
from gripmon.record.export.tables import alert_rows, command_rows, days_of, frame_rows, reference_row, state_rows
from gripmon.record.read import Recording, open_recordings, recording_files

ROWS_A_GROUP = 1 << 16
"""Of frames: 18 minutes at 60 frames/s.  Readers skip whole groups by the times in their statistics."""

_NULL = "__HIVE_DEFAULT_PARTITION__"
_LONGEST_NAME = 120
_NUMBERED = re.compile(r"-(\d{4,9})$")
_PLAIN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_FAULTS_IN_A_LINE = 5


@dataclass(frozen=True)
class Exported:
    """What was written: rows by table, from how many files; ``faults`` is what could not be used, one line each."""

    rows: dict[str, int]
    files: int
    faults: tuple[str, ...]


def export(
    recordings: Sequence[str | PathLike[str]],
    out: str | PathLike[str],
    *,
    progress: Callable[[int, int], None] = lambda _done, _all: None,
) -> Exported:
    """Write recordings (.rrd, ``estimates.jsonl``, folders of recordings) as Parquet below the folder ``out``.

    Memory holds one file at a time; files that were exported before are replaced.  ``progress`` is called with bytes
    read and bytes in all.  Raises :class:`~gripmon.model.errors.InputError` for recordings that are not there,
    :class:`~gripmon.model.errors.NoResultError` where nothing in them can be used or ``out`` can't be written.
    """
    files = recording_files([Path(path) for path in recordings])
    exporter = Exporter(Path(out))
    faults: list[str] = []
    sizes = [file.stat().st_size for file in files]
    for number, file in enumerate(files):

        def reached(done: int, _: int, behind: int = sum(sizes[:number])) -> None:
            progress(behind + done, sum(sizes))

        found = open_recordings([file], reached)
        faults += found.faults
        for recording in found.recordings:
            faults += recording.file_faults
            try:
                exporter.add(recording, file)
            except OSError as error:
                wrong = f"can't be written ({error.strerror or error})"
                raise NoResultError(f"{out}: {wrong}, at {file}; what stands there is whole") from None
    faults += exporter.faults
    if not exporter.parts:
        more = f"; and {len(faults) - _FAULTS_IN_A_LINE} more" if len(faults) > _FAULTS_IN_A_LINE else ""
        raise NoResultError(f"export: {'; '.join(faults[:_FAULTS_IN_A_LINE]) or 'nothing was recorded'}{more}")
    return Exported({table: exporter.rows[table] for table in SCHEMAS}, exporter.parts, tuple(faults))


class Exporter:
    """Writes parts of recordings below ``out``, each in turn: no more than one is in memory.

    ``rows`` counts what was written by table, ``parts`` from how many files; ``faults`` says what was left out, one
    line each.
    """

    def __init__(self, out: Path) -> None:
        self.rows: Counter[str] = Counter()
        self.parts = 0
        self.faults: list[str] = []
        self.out = out
        self._from: dict[tuple[str, str, str], Path] = {}
        self._references: set[Path] = set()

    def add(self, part: Recording, path: Path) -> None:
        """Export what the file ``path`` of a recording holds.  Raises OSError if it can't be written."""
        recording_id, number = part.recording_id, _number(part, path)
        name = f"{_file_name(recording_id)}-{number:04d}.parquet"
        known = self._from.setdefault((part.robot, part.camera, name), path)
        if known != path:
            self.faults.append(f"{path}: the same part of the same run as {known}; left out")
            return
        frames = part.frames.take(np.argsort(part.frames.stamp_ns, kind="stable"))

        target = _Target(f"robot={_escaped(part.robot)}/camera={_escaped(part.camera)}", name)
        self._by_day(
            "frames", target, frames.stamp_ns, lambda rows: frame_rows(frames.take(rows), recording_id, number)
        )
        for table, made in (
            ("alerts", alert_rows(part.alerts, recording_id, number)),
            ("states", state_rows(part.states, recording_id, number)),
            ("commands", command_rows(part.commands, recording_id, number)),
        ):
            self._by_day(table, target, made["stamp_ns"].to_numpy(), made.__getitem__)
        for reference in part.references:
            self._reference(target, reference)
        self.parts += 1

    def _by_day(
        self, table: str, target: _Target, stamps_ns: NDArray[np.int64], rows: Callable[[slice], pa.Table]
    ) -> None:
        """One file for each day; ``stamps_ns`` are sorted, and ``rows`` makes the rows of a slice."""
        days = days_of(stamps_ns)
        starts = np.flatnonzero(np.concatenate([[True], days[1:] != days[:-1]])) if len(days) else np.array([], int)
        for start, stop in itertools.pairwise([*starts.tolist(), len(days)]):
            groups = (slice(i, min(i + ROWS_A_GROUP, stop)) for i in range(start, stop, ROWS_A_GROUP))
            folder = self.out / table / target.partition / f"date={days[start]}"
            _write(folder / target.name, SCHEMAS[table], map(rows, groups))
            self.rows[table] += stop - start

    def _reference(self, target: _Target, reference: ReferenceRecord) -> None:
        """A file for each reference: it is in force in many recordings, and would be there as often otherwise."""
        name = f"{_file_name(reference.reference_id)}-{reference.revision:04d}.parquet"
        path = self.out / "references" / target.partition / name
        if path not in self._references:
            self._references.add(path)
            _write(path, SCHEMAS["references"], [reference_row(reference)])
            self.rows["references"] += 1


class _Target(NamedTuple):
    partition: str
    name: str


def _write(path: Path, schema: pa.Schema, groups: Iterable[pa.Table]) -> None:
    """A Parquet file, a row group each, in place of the one that was there; the same rows give the same bytes."""
    texts = [field.name for field in schema if field.type == pa.string()]
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_leftovers(path)
    with (
        opened_atomically(path) as file,
        pq.ParquetWriter(file, schema, compression="zstd", use_dictionary=texts) as writer,
    ):
        for group in groups:
            writer.write_table(group, row_group_size=max(1, len(group)))


def _number(part: Recording, path: Path) -> int:
    """Of a file in its run; older ones say it in their names alone."""
    if part.meta is not None:
        return part.meta.file_number
    found = _NUMBERED.search(path.stem)
    return int(found[1]) if found else 0


def _escaped(value: str) -> str:
    """A value in the name of a partition, as readers of the Hive layout take it apart."""
    return quote(value, safe="") if value else _NULL


def _file_name(value: str) -> str:
    """A name that every file system and object store takes; others get what keeps them apart."""
    if _PLAIN_NAME.fullmatch(value) and len(value) <= _LONGEST_NAME:
        return value
    plain = re.sub(r"[^A-Za-z0-9._-]", "_", value)[: _LONGEST_NAME - 9].lstrip("._-")
    return f"{plain or 'run'}-{hashlib.sha256(value.encode()).hexdigest()[:8]}"
