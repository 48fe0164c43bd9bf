"""The results of a dataset: a Parquet file for each measured episode, and the table made of all of them."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import typing
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq
from numpy.typing import NDArray
from scipy.special import chdtrc

from gripmon import __version__
from gripmon.analyse.stretches import POSE_COLUMNS, Numbers, Runs, Stretch
from gripmon.analyse.vectors import to_vectors
from gripmon.io.sources.episodes import Episode, hash_of
from gripmon.model.errors import InputError, one_line
from gripmon.model.records import Array, Verdict
from gripmon.record.table import pose_matrices

TABLE, REPORT = "stretches", "report.html"
_GROUP_ROWS, _FILE_ROWS = 1000, 50_000
"""Rows in memory at a time (with pictures about 20 MB), and per file."""
_SMALL = ("stretch", "mounting", "frames")
_TYPES: dict[Any, pa.DataType] = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}
_TYPES |= {bytes: pa.binary()}
_TYPES |= {kind | None: type_ for kind, type_ in _TYPES.items()}
_TYPES |= {Numbers: pa.list_(pa.float64()), Runs: pa.list_(pa.list_(pa.int64()))}


def _fields() -> Iterator[tuple[str, tuple[str, ...], pa.Field]]:
    """Name in :class:`Stretch`, the columns that it is spread over, and one column's field."""
    for name, hint in typing.get_type_hints(Stretch, include_extras=True).items():
        kind, about = typing.get_args(hint)
        spread = about.extra["columns"]
        for column in spread or (name,):
            type_ = pa.float64() if spread else pa.int32() if name in _SMALL else _TYPES[kind]
            yield name, spread, pa.field(column, type_, metadata={"description": about.description})


SCHEMA = pa.schema(
    [field for _, _, field in _fields()],
    metadata={"gripmon.schema": "gripmon.dataset/1", "gripmon.version": __version__},
)
_SPREAD = {name: columns for name, columns, _ in _fields() if columns}


def table_of(rows: Sequence[Stretch]) -> pa.Table:
    """The rows as a table of :data:`SCHEMA`."""
    plain = []
    for row in rows:
        values = msgspec.structs.asdict(row)
        for name, columns in _SPREAD.items():
            values |= zip(columns, values.pop(name) or [None] * len(columns), strict=True)
        plain.append(values)
    return pa.Table.from_pylist(plain, SCHEMA)


class Results:
    """The measured episodes below ``out``: a Parquet file for each, which is there whole or not at all, so that a call
    that was killed goes on where it was.  A file is named after its episode, the camera and the version of the files.

    Raises :class:`InputError` if another process writes there, or if results of another configuration are there.
    """

    def __init__(self, out: Path, fingerprint: str) -> None:
        self._folder = out / f"episodes-{fingerprint}"
        if any(other != self._folder for other in out.glob("episodes-*")):
            wrong = "holds what another configuration, or another version of gripmon, measured"
            raise InputError(f"{out}: {wrong}; another folder, or delete this one", "out")
        with writing(out):
            self._folder.mkdir(exist_ok=True)
            self._lock = (self._folder / ".lock").open("ab")
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._lock.close()
            raise InputError(f"{out}: another gripmon dataset writes there; wait for it", "out") from None
        for leftover in self._folder.glob("*.tmp"):
            leftover.unlink()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._lock.close()

    def path(self, episode: Episode) -> Path:
        """Where the result of an episode is, or will be."""
        return self._folder / f"{hash_of([episode.key, episode.version])}.parquet"

    def __contains__(self, episode: Episode) -> bool:
        try:
            with self.path(episode).open("rb") as file:
                file.seek(-4, os.SEEK_END)
                return file.read() == b"PAR1"
        except OSError:
            return False  # absent, or of no length after a power cut: measured again

    def add(self, episode: Episode, rows: Sequence[Stretch]) -> None:
        """Store a result, which survives a kill of the process once this has returned.  It isn't flushed to the disk:
        that took 25 ms of the driver on a busy one, and what a power cut truncates is measured again.
        """
        path = self.path(episode)
        fresh = path.with_suffix(".tmp")
        with writing(self._folder):
            try:
                # Of a single row, dictionaries, statistics and compression cost more than they save.
                pq.write_table(table_of(rows), fresh, use_dictionary=False, write_statistics=False, compression="none")
                fresh.rename(path)
            except OSError:
                fresh.unlink(missing_ok=True)
                raise

    def read(self, episode: Episode, columns: list[str] | None = None) -> pa.Table:
        """The stored rows of an episode.  Raises :class:`InputError` if its file is damaged."""
        path = self.path(episode)
        try:
            with pq.ParquetFile(path) as file:
                return file.read(columns, use_threads=False)
        except (OSError, ValueError) as error:
            right = "delete it, and the next call measures its episode again"
            raise InputError(f"{path} can't be read ({one_line(error):.200}); {right}", "out") from None

    def blocks(self, episodes: Sequence[Episode], columns: list[str] | None = None) -> Iterator[pa.Table]:
        """The rows of all ``episodes``, in that order, so many at a time as memory is to hold with pictures."""
        for first in range(0, len(episodes), _GROUP_ROWS):
            some = episodes[first : first + _GROUP_ROWS]
            yield pa.concat_tables([self.read(episode, columns) for episode in some]).combine_chunks()


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Raises :class:`InputError` instead of OSError."""
    try:
        yield
    except OSError as error:
        why = error.strerror or one_line(error)
        right = "what was measured is kept; make room there, then call again"
        raise InputError(f"{path} can't be written ({why:.200}); {right}", "out") from None


def write_table(
    results: Results,
    episodes: Sequence[Episode],
    out: Path,
    level: float,
    tolerance_m: float,
    tolerance_rad: float,
) -> pa.Table:
    """Write the table of the ``episodes`` as ``camera=NAME/part-N.parquet``, in the layout of Hive and their order,
    replacing an earlier one.  Returns it without pictures, the last column.  Raises :class:`InputError` if it can't be
    written.
    """
    rows = pa.concat_tables(list(results.blocks(episodes, SCHEMA.names[:-1])))
    numbers = _mountings(rows, level, tolerance_m, tolerance_rad)
    field = SCHEMA.field("mounting")
    place = SCHEMA.get_field_index(field.name)
    rows = rows.set_column(place, field, pa.array(numbers, field.type, mask=numbers < 0))

    def batches() -> Iterator[pa.RecordBatch]:
        begin = 0
        for block in results.blocks(episodes, SCHEMA.names[-1:]):
            whole = rows.slice(begin, len(block)).append_column(SCHEMA.field(-1), block.column(0))
            yield from whole.combine_chunks().to_batches()
            begin += len(block)

    fresh = out / f".{TABLE}"
    with writing(out / TABLE):
        shutil.rmtree(fresh, ignore_errors=True)
        try:
            ds.write_dataset(
                batches(), fresh, schema=SCHEMA, format="parquet", basename_template="part-{i}.parquet",
                partitioning=ds.partitioning(pa.schema([SCHEMA.field("camera")]), flavor="hive"),
                file_options=ds.ParquetFileFormat().make_write_options(compression="zstd"), use_threads=False,
                max_rows_per_file=_FILE_ROWS, min_rows_per_group=_GROUP_ROWS, max_rows_per_group=_GROUP_ROWS,
            )  # fmt: skip
            shutil.rmtree(out / TABLE, ignore_errors=True)
            fresh.rename(out / TABLE)
        finally:
            shutil.rmtree(fresh, ignore_errors=True)
    return rows


def _mountings(rows: pa.Table, level: float, tolerance_m: float, tolerance_rad: float) -> NDArray[np.int64]:
    """The mounting of each row, counted for each camera; -1 without a valid transform."""
    out = np.full(len(rows), -1, np.int64)
    cameras, valid = np.array(rows["camera"].to_pylist()), np.array(rows["verdict"].to_pylist()) == Verdict.VALID.value
    for camera in np.unique(cameras[valid]):
        places = np.flatnonzero(valid & (cameras == camera))
        mine = rows.select([*POSE_COLUMNS, "covariance"]).take(places)
        poses = pose_matrices(np.column_stack([mine[name].to_numpy() for name in POSE_COLUMNS]))
        covariance = mine["covariance"].combine_chunks().flatten().to_numpy().reshape(-1, 6, 6)
        out[places] = mountings_of(poses, covariance, level, tolerance_m, tolerance_rad)
    return out


def mountings_of(
    cam_T_grip: Array,
    covariance: Array,
    level: float = 0.01,
    tolerance_m: float = 0.0,
    tolerance_rad: float = 0.0,
) -> NDArray[np.int64]:
    """The mounting (n,) of each transform (n, 4, 4) with covariances (n, 6, 6): numbers from 0, in the order of their
    first occurrence.

    The most certain transform represents its mounting: all others belong to it that ``verify``'s test can't distinguish
    from it, or that are within both tolerances; this is repeated for the rest.  A transform that agrees with several
    belongs to the first.  ``level`` is the probability that any of the n is wrongly separated from its mounting, so
    that each test has ``level / n``.
    """
    count = len(cam_T_grip)
    out = np.full(count, -1, np.int64)
    certain = np.argsort(np.linalg.slogdet(covariance)[1] if count else np.empty(0), kind="stable")
    leaders = 0
    for leader in certain.tolist():
        if out[leader] >= 0:
            continue
        left = np.flatnonzero(out < 0)
        xi = to_vectors(cam_T_grip[leader], cam_T_grip[left])
        chi2 = np.einsum(
            "ni,ni->n", xi, np.linalg.solve(covariance[leader] + covariance[left], xi[:, :, None])[:, :, 0]
        )
        near = (np.linalg.norm(xi[:, :3], axis=1) <= tolerance_m) & (np.linalg.norm(xi[:, 3:], axis=1) <= tolerance_rad)
        same = (chdtrc(6, chi2) >= level / count) | near
        out[left[same]] = leaders
        out[leader] = leaders
        leaders += 1
    _, first, inverse = np.unique(out, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[inverse] if count else out
