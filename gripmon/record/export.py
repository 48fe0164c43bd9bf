"""Recordings -> Parquet, for any engine: tables of frames, alerts, states, commands and references.

``<out>/<table>/robot=…/camera=…/date=YYYY-MM-DD/<run>-<number>.parquet``: each file of a recording gives one file per
table and day (UTC), which is replaced when it is exported again.  References, which outlive a day, are not partitioned
by date: each has its own file.  Columns, units and descriptions, in the schemas' metadata, are those of the frame table
and of the messages themselves.  Of a covariance (6 x 6, symmetric) the upper triangle is stored, row by row: 21
numbers, ``UPPER`` of the flat 36.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any
from urllib.parse import quote

import msgspec
import msgspec.inspect as kinds
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from gripmon import __version__
from gripmon.model.atomic import opened_atomically, remove_leftovers
from gripmon.model.errors import NoResultError
from gripmon.model.lerobot_columns import POSE_NAMES
from gripmon.model.records import AlertRecord, RecordedCommand, ReferenceRecord, StateRecord, Transform
from gripmon.model.records.references import ReferenceInputs
from gripmon.record.read import open_recordings, recording_files
from gripmon.record.recordings import Recording, file_number
from gripmon.record.table import COLUMNS, FrameTable

UPPER = np.ravel_multi_index(np.triu_indices(6), (6, 6))
_TRIANGLE = pa.list_(pa.float64(), len(UPPER))
_TIME = pa.timestamp("ns", tz="UTC")
_ARROW = {np.float64: pa.float64(), np.int64: pa.int64(), np.int32: pa.int32(), np.bool_: pa.bool_()}
_UNITS = (("_m_per_min", "m/min"), ("_per_s", "1/s"), ("_rad", "rad"), ("_px", "px"), ("_ns", "ns"), ("_m", "m"),
          ("_s", "s"))  # fmt: skip


def _field(name: str, kind: pa.DataType, unit: str, text: str) -> pa.Field:
    return pa.field(name, kind, metadata={"unit": unit, "description": text})


def _pose_names(name: str) -> list[str]:
    return [f"{name}_{part}" for part in POSE_NAMES]


def _axis_names(name: str) -> list[str]:
    return [f"{name.removesuffix('_m')}_{axis}_m" for axis in "xyz"]


def _pose_fields(name: str, text: str) -> list[pa.Field]:
    units = ("m",) * 3 + ("1",) * 4
    return [_field(one, pa.float64(), unit, text) for one, unit in zip(_pose_names(name), units, strict=True)]


def _axis_fields(name: str, text: str) -> list[pa.Field]:
    return [_field(one, pa.float64(), "m", f"{text}, along the camera's {one[-3]}") for one in _axis_names(name)]


def _triangle_field(name: str, text: str) -> pa.Field:
    return _field(name, _TRIANGLE, "m2, m rad, rad2", f"upper triangle, row by row: {text}")


_CLOCK = _field("time", _TIME, "UTC", "stamp_ns as a time; null where that is")
_RUN = [
    _field("recording_id", pa.string(), "", "the run of the monitor that this is from"),
    _field("file_number", pa.int32(), "1", "which of the recording's files it is from"),
]


def _frame_fields() -> Iterator[pa.Field]:
    """Of the frame table's columns, in their order."""
    yield _CLOCK
    for name, column in COLUMNS.items():
        if column.shape == (7,):
            yield from _pose_fields(name, column.help)
        elif column.shape == (3,):
            yield from _axis_fields(name, column.help)
            yield from _axis_fields("sigma_m", "standard deviation of the TCP")
        elif column.shape:
            yield _triangle_field(name, column.help)
        elif name == "reference":
            yield _field("reference_id", pa.string(), "", column.help)
        else:
            yield _field(name, pa.string() if column.names else _ARROW[column.type], column.unit, column.help)
    yield from _RUN


def _message_fields(message: type[msgspec.Struct], names: str) -> Iterator[pa.Field]:
    """Of some of a message's fields."""
    told = {field.name: field.type for field in _struct(message).fields}
    for name in names.split():
        kind: Any = told[name]
        text = ""
        if isinstance(kind, kinds.Metadata):
            kind, text = kind.type, (kind.extra_json_schema or {}).get("description", "")
        if isinstance(kind, kinds.UnionType):
            kind = next(one for one in kind.types if not isinstance(one, kinds.NoneType))
        text = text or _described(kind)
        if name == "open_alerts":
            yield _field(name, pa.int32(), "1", text)
        elif isinstance(kind, kinds.StructType):
            yield from _pose_fields(name, text)
        elif isinstance(kind, kinds.TupleType):
            yield from _axis_fields(name, text)
        elif isinstance(kind, kinds.VarTupleType) and not isinstance(kind.item_type, kinds.StructType):
            yield _triangle_field(name, text)
        else:
            arrow = _arrow(kind)
            counted = pa.types.is_integer(arrow) or pa.types.is_floating(arrow) or pa.types.is_list(arrow)
            unit = next((unit for suffix, unit in _UNITS if name.endswith(suffix)), "1" if counted else "")
            yield _field(name, arrow, unit, text)


def _struct(message: type[msgspec.Struct]) -> kinds.StructType:
    found = kinds.type_info(message)
    assert isinstance(found, kinds.StructType)
    return found


def _arrow(kind: kinds.Type) -> pa.DataType:
    if isinstance(kind, kinds.Metadata):
        return _arrow(kind.type)
    if isinstance(kind, kinds.UnionType):
        return next(_arrow(one) for one in kind.types if not isinstance(one, kinds.NoneType))
    if isinstance(kind, kinds.VarTupleType):
        return pa.list_(_arrow(kind.item_type))
    if isinstance(kind, kinds.StructType):
        return pa.struct([(field.name, _arrow(field.type)) for field in kind.fields])
    simple = {kinds.IntType: pa.int64(), kinds.FloatType: pa.float64(), kinds.BoolType: pa.bool_()}
    return simple.get(type(kind), pa.string())


def _described(kind: kinds.Type) -> str:
    """What a type says of itself, in its first line."""
    text: str = getattr(kind, "cls", type(kind)).__doc__ or ""
    return text.partition("\n")[0].replace("``", "")


def _schema(table: str, fields: Iterable[pa.Field]) -> pa.Schema:
    fields = list(fields)
    about = {
        "gripmon.schema": f"gripmon.export.{table}/1",
        "gripmon.version": __version__,
        "gripmon.units": json.dumps({f.name: unit for f in fields if (unit := f.metadata[b"unit"].decode())}),
    }
    return pa.schema(fields, metadata=about)


def _dated_schema(table: str, message: type[msgspec.Struct], names: str) -> pa.Schema:
    return _schema(table, [_CLOCK, *_message_fields(message, f"stamp_ns seq {names}"), *_RUN])


_INPUTS = {
    "first_seq": "first_seq", "last_seq": "last_seq", "frames": "frames_used", "weighted_rms": "weighted_rms",
    "step_m": "step_m", "step_rad": "step_rad",
}  # fmt: skip
"""Of what a reference was made from: a column each."""

SCHEMAS: dict[str, pa.Schema] = {
    "frames": _schema("frames", _frame_fields()),
    "alerts": _dated_schema(
        "alerts", AlertRecord,
        "event alert_id kind cause part severity text causes tcp_shift_m rotation_rad rate_m_per_min time_left_s "
        "since_ns acknowledged state reference_id revision",
    ),
    "states": _dated_schema(
        "states", StateRecord,
        "state verdict message reference_id revision frames frames_refused frames_dropped recording_dropped "
        "recording_images_dropped transforms_unsent malformed frames_per_s uptime_s camera_connected tcp_shift_m "
        "sigma_m protection_m valid_by alert_limit_m open_alerts version",
    ),
    "commands": _dated_schema("commands", RecordedCommand, "name argument done text"),
    "references": _schema(
        "references",
        [
            *_message_fields(ReferenceRecord, "reference_id revision"),
            _CLOCK,
            *_message_fields(
                ReferenceRecord, "stamp_ns origin cam_T_grip covariance parent restores cause accepted_by"
            ),
            *(f.with_name(_INPUTS.get(f.name, f.name)) for f in _message_fields(ReferenceInputs, " ".join(_INPUTS))),
        ],
    ),
}  # fmt: skip
"""The columns of each table; within a major version columns may be added, not renamed or dropped."""
_DATED = ("alerts", "states", "commands")


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
        tables = {table: _dated_rows(table, getattr(part, table), recording_id, number) for table in _DATED}
        self._by_day(
            "frames", where, name, frames.stamp_ns, lambda rows: _frame_rows(frames.take(rows), recording_id, number)
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
            _write(path, SCHEMAS["references"], [_reference_row(reference)])
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


def _frame_rows(frames: FrameTable, recording_id: str, number: int) -> pa.Table:
    """The table ``frames``, one row per frame, in the given order.  NaN and -1 (unknown) become null."""
    with np.errstate(invalid="ignore"):  # a value that is not a covariance has no standard deviation
        sigma_m = np.sqrt(np.diagonal(frames.covariance, axis1=1, axis2=2)[:, :3])
    arrays: dict[str, Any] = {
        "time": pa.array(frames.stamp_ns, pa.int64()).cast(_TIME),
        "reference_id": _named(frames.reference, frames.reference_ids),
        "recording_id": pa.repeat(recording_id, len(frames)),
        "file_number": pa.repeat(pa.scalar(number, pa.int32()), len(frames)),
        **_numbers(_axis_names("sigma_m"), sigma_m),
    }
    for name, column in COLUMNS.items():
        values = getattr(frames, name)
        if column.shape == (6, 6):
            upper = values.reshape(-1, 36)[:, UPPER]
            known = pa.array(np.isnan(upper).any(axis=1))
            arrays[name] = pa.FixedSizeListArray.from_arrays(pa.array(upper.reshape(-1)), type=_TRIANGLE, mask=known)
        elif column.shape:
            arrays |= _numbers(_pose_names(name) if column.shape == (7,) else _axis_names(name), values)
        elif column.names:
            arrays[name] = _named(values, column.names)
        elif column.type is np.float64:
            arrays |= _numbers([name], values[:, None])
        else:
            arrays[name] = pa.array(values, mask=values < 0 if name in _MAY_BE_UNKNOWN else None)
    return pa.table([arrays[name] for name in SCHEMAS["frames"].names], schema=SCHEMAS["frames"])


_MAY_BE_UNKNOWN = ("since_ns", "revision", "latency_ns")


def _numbers(names: Sequence[str], values: NDArray[np.float64]) -> dict[str, pa.Array]:
    columns = map(np.ascontiguousarray, values.T)
    return {name: pa.array(one, mask=np.isnan(one)) for name, one in zip(names, columns, strict=True)}


def _named(codes: NDArray[Any], names: tuple[str, ...]) -> pa.Array:
    indices = pa.array(codes.astype(np.int32), mask=codes < 0)
    return pa.DictionaryArray.from_arrays(indices, pa.array(names, pa.string())).cast(pa.string())


def _dated_rows(table: str, records: Iterable[Any], recording_id: str, number: int) -> pa.Table:
    """The table ``alerts``, ``states`` or ``commands``, in order of time."""
    run = {"recording_id": recording_id, "file_number": number}
    ordered = sorted(records, key=lambda record: int(record.stamp_ns))
    rows = [{**_row(record), "time": record.stamp_ns, **run} for record in ordered]
    return pa.Table.from_pylist(rows, SCHEMAS[table])


def _reference_row(reference: ReferenceRecord) -> pa.Table:
    """The one row of a reference."""
    row = _row(reference)
    inputs = row["inputs"] or {}
    stamp_ns = reference.stamp_ns or None  # 0: configured, at an unknown time
    row |= {"stamp_ns": stamp_ns, "time": stamp_ns, **{name: inputs.get(of) for of, name in _INPUTS.items()}}
    return pa.Table.from_pylist([row], SCHEMAS["references"])


def _row(record: msgspec.Struct) -> dict[str, Any]:
    """A message's values by column."""
    row: dict[str, Any] = {}
    for name, value in msgspec.structs.asdict(record).items():
        if isinstance(value, Transform):
            row |= zip(_pose_names(name), (*value.translation_m, *value.rotation_xyzw), strict=True)
        elif name == "tcp_shift_m" and value is not None:
            row |= zip(_axis_names(name), value, strict=True)
        elif name == "covariance":
            row[name] = [value[i] for i in UPPER]
        else:
            row[name] = len(value) if name == "open_alerts" else msgspec.to_builtins(value)
    return row
