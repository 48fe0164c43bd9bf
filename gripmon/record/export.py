"""Recordings -> Parquet, for any engine: tables of frames, alerts, states, commands and references.

``<out>/<table>/robot=…/camera=…/date=YYYY-MM-DD/<run>-<number>.parquet``: each file of a recording gives one file per
table and day (UTC), which is replaced when it is exported again.  References, which outlive a day, are not partitioned
by date: each has its own file.  The columns are in :mod:`gripmon.record.parquet`.
"""

from __future__ import annotations

import hashlib
import itertools
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from gripmon.model.atomic import opened_atomically, remove_leftovers
from gripmon.model.errors import NoResultError
from gripmon.model.records import ReferenceRecord
from gripmon.record.parquet import DATED, SCHEMAS, dated_rows, frame_rows, reference_row
from gripmon.record.read import open_recordings, recording_files
from gripmon.record.recordings import Recording, file_number

ROWS_A_GROUP = 1 << 16
"""Frames: 18 minutes at 60 frames/s.  Readers skip whole groups by the times in their statistics."""

_NULL = "__HIVE_DEFAULT_PARTITION__"
_NAME_LIMIT = 120  # characters
_PLAIN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_FAULTS_IN_A_LINE = 5


@dataclass(frozen=True)
class Exported:
    """What was written: rows per table, from how many files; ``faults``, one line each: what could not be used."""

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

    Memory holds one file at a time; files from an earlier export are replaced.  ``progress`` is called with bytes read
    and bytes in total.  Raises :class:`~gripmon.model.errors.InputError` for missing recordings,
    :class:`~gripmon.model.errors.NoResultError` if nothing in them can be used or ``out`` can't be written.
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
    """Writes parts of recordings below ``out``, with at most one of them in memory.

    ``rows`` counts the rows written per table, ``parts`` the files they came from; ``faults``, one line each: what was
    left out.
    """

    def __init__(self, out: Path) -> None:
        self.rows: Counter[str] = Counter()
        self.parts = 0
        self.faults: list[str] = []
        self.out = out
        self._from: dict[tuple[str, str, str], Path] = {}
        self._references: set[Path] = set()

    def add(self, part: Recording, path: Path) -> None:
        """Export the file ``path`` of a recording.  Raises OSError if the result can't be written."""
        recording_id, number = part.recording_id, file_number(part.meta)
        name = f"{_file_name(recording_id)}-{number:04d}.parquet"
        known = self._from.setdefault((part.robot, part.camera, name), path)
        if known != path:
            self.faults.append(f"{path}: the same part of the same run as {known}; left out")
            return
        frames = part.frames.take(np.argsort(part.frames.stamp_ns, kind="stable"))

        where = f"robot={_escaped(part.robot)}/camera={_escaped(part.camera)}"
        tables = {table: dated_rows(table, getattr(part, table), recording_id, number) for table in DATED}
        self._by_day(
            "frames", where, name, frames.stamp_ns, lambda rows: frame_rows(frames.take(rows), recording_id, number)
        )
        for table, made in tables.items():
            self._by_day(table, where, name, made["stamp_ns"].to_numpy(), made.__getitem__)
        for reference in part.references:
            self._reference(where, reference)
        self.parts += 1

    def _by_day(
        self, table: str, where: str, name: str, stamps_ns: NDArray[np.int64], rows: Callable[[slice], pa.Table]
    ) -> None:
        """One file per day; ``stamps_ns`` are sorted, and ``rows`` makes the rows of a slice."""
        days = stamps_ns.astype("datetime64[ns]").astype("datetime64[D]")  # UTC
        starts = np.flatnonzero(np.concatenate([[True], days[1:] != days[:-1]])) if len(days) else np.array([], int)
        for start, stop in itertools.pairwise([*starts.tolist(), len(days)]):
            groups = (slice(i, min(i + ROWS_A_GROUP, stop)) for i in range(start, stop, ROWS_A_GROUP))
            folder = self.out / table / where / f"date={days[start]}"
            _write(folder / name, SCHEMAS[table], map(rows, groups))
            self.rows[table] += stop - start

    def _reference(self, where: str, reference: ReferenceRecord) -> None:
        """One file per reference, which would otherwise be repeated for every recording in which it is in force."""
        name = f"{_file_name(reference.reference_id)}-{reference.revision:04d}.parquet"
        path = self.out / "references" / where / name
        if path not in self._references:
            self._references.add(path)
            _write(path, SCHEMAS["references"], [reference_row(reference)])
            self.rows["references"] += 1


def _write(path: Path, schema: pa.Schema, groups: Iterable[pa.Table]) -> None:
    """Write or replace a Parquet file, one row group per table; the same rows give the same bytes."""
    texts = [field.name for field in schema if field.type == pa.string()]
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_leftovers(path)
    with (
        opened_atomically(path) as file,
        pq.ParquetWriter(file, schema, compression="zstd", use_dictionary=texts) as writer,
    ):
        for group in groups:
            writer.write_table(group, row_group_size=max(1, len(group)))


def _escaped(value: str) -> str:
    """A value in a partition's name, as readers of the Hive layout parse it."""
    return quote(value, safe="") if value else _NULL


def _file_name(value: str) -> str:
    """A name that every file system and object store accepts; a hash keeps changed names distinct."""
    if _PLAIN_NAME.fullmatch(value) and len(value) <= _NAME_LIMIT:
        return value
    plain = re.sub(r"[^A-Za-z0-9._-]", "_", value)[: _NAME_LIMIT - 9].lstrip("._-")
    return f"{plain or 'run'}-{hashlib.sha256(value.encode()).hexdigest()[:8]}"
