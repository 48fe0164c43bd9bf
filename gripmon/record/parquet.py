"""The Parquet tables of a recording: each column said once, by what it is and by its values.

Columns, units and descriptions, in the schemas' metadata, are those of the frame table and of the messages themselves.
Of a covariance (6 x 6, symmetric) the upper triangle is stored, row by row: 21 numbers, ``UPPER`` of the flat 36.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from operator import attrgetter
from typing import Any, NamedTuple

import msgspec
import msgspec.inspect as kinds
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from gripmon import __version__
from gripmon.model.fields import Field, fields_of, plain
from gripmon.model.lerobot_columns import POSE_NAMES
from gripmon.model.records import AlertRecord, RecordedCommand, ReferenceRecord, StateRecord
from gripmon.model.records.references import ReferenceInputs
from gripmon.record.table import COLUMNS, Column, FrameTable

UPPER = np.ravel_multi_index(np.triu_indices(6), (6, 6))
_TRIANGLE, _TRIANGLE_UNIT = pa.list_(pa.float64(), len(UPPER)), "m2, m rad, rad2"
_TIME = pa.timestamp("ns", tz="UTC")
_ARROW = {np.float64: pa.float64(), np.int64: pa.int64(), np.int32: pa.int32(), np.bool_: pa.bool_()}
_PLAIN = {kinds.IntType: pa.int64(), kinds.FloatType: pa.float64(), kinds.BoolType: pa.bool_()}
_MAY_BE_UNKNOWN = ("since_ns", "revision", "latency_ns")  # integers of a frame, -1 then


class _Columns(NamedTuple):
    """Some columns that belong together, and their values: of a message's field, or of a frame table."""

    fields: list[pa.Field]
    values: Callable[[Any], Sequence[Any]]


def _field(name: str, kind: pa.DataType, unit: str, text: str) -> pa.Field:
    return pa.field(name, kind, metadata={"unit": unit, "description": text})


def _pose_fields(name: str, text: str) -> list[pa.Field]:
    units = ("m",) * 3 + ("1",) * 4
    return [_field(f"{name}_{part}", pa.float64(), unit, text) for part, unit in zip(POSE_NAMES, units, strict=True)]


def _axis_fields(name: str, text: str) -> list[pa.Field]:
    stem = name.removesuffix("_m")
    return [_field(f"{stem}_{axis}_m", pa.float64(), "m", f"{text}, along the camera's {axis}") for axis in "xyz"]


def _triangle_field(name: str, text: str) -> pa.Field:
    return _field(name, _TRIANGLE, _TRIANGLE_UNIT, f"upper triangle, row by row: {text}")


_CLOCK = _field("time", _TIME, "UTC", "stamp_ns as a time; null where that is")
_RUN = [
    _field("recording_id", pa.string(), "", "the run of the monitor that this is from"),
    _field("file_number", pa.int32(), "1", "which of the recording's files it is from"),
]


def _of_field(field: Field) -> _Columns:
    """The columns of a message's field; their values are of one that isn't None."""
    name, text, kind = field.name, field.help, field.type
    if name == "open_alerts":
        return _Columns([_field(name, pa.int32(), "1", text)], lambda alerts: [len(alerts)])
    if isinstance(kind, kinds.StructType):
        return _Columns(_pose_fields(name, text), lambda pose: (*pose.translation_m, *pose.rotation_xyzw))
    if isinstance(kind, kinds.TupleType):
        return _Columns(_axis_fields(name, text), lambda values: values)
    if isinstance(kind, kinds.VarTupleType) and not isinstance(kind.item_type, kinds.StructType):
        return _Columns([_triangle_field(name, text)], lambda covariance: [[covariance[i] for i in UPPER]])
    return _Columns([_field(name, _arrow(kind), field.unit, text)], lambda value: [msgspec.to_builtins(value)])


def _arrow(kind: kinds.Type) -> pa.DataType:
    kind = plain(kind)
    if isinstance(kind, kinds.VarTupleType):
        return pa.list_(_arrow(kind.item_type))
    if isinstance(kind, kinds.StructType):
        return pa.struct([(field.name, _arrow(field.type)) for field in kind.fields])
    return _PLAIN.get(type(kind), pa.string())


def _of_column(name: str, column: Column) -> _Columns:
    """The columns of one of the frame table's; their values are Arrow arrays."""
    values: Callable[[FrameTable], Any] = attrgetter(name)
    if column.shape == (7,):
        return _Columns(_pose_fields(name, column.help), lambda frames: _numbers(values(frames)))
    if column.shape == (3,):
        return _Columns(_axis_fields(name, column.help), lambda frames: _numbers(values(frames)))
    if column.shape:
        return _Columns([_triangle_field(name, column.help)], lambda frames: [_triangles(values(frames))])
    if name == "reference":
        found = _field("reference_id", pa.string(), "", column.help)
        return _Columns([found], lambda frames: [_named(frames.reference, frames.reference_ids)])
    if column.names:
        found = _field(name, pa.string(), column.unit, column.help)
        return _Columns([found], lambda frames: [_named(values(frames), column.names)])
    found = _field(name, _ARROW[column.type], column.unit, column.help)
    if column.type is np.float64:
        return _Columns([found], lambda frames: _numbers(values(frames)[:, None]))
    mask = (lambda some: some < 0) if name in _MAY_BE_UNKNOWN else lambda _: None
    return _Columns([found], lambda frames: [pa.array(values(frames), mask=mask(values(frames)))])


def _frame_columns() -> Iterator[_Columns]:
    """Of the frame table, in its order; the shift of the TCP with its standard deviation."""
    yield _Columns([_CLOCK], lambda frames: [pa.array(frames.stamp_ns, pa.int64()).cast(_TIME)])
    for name, column in COLUMNS.items():
        yield _of_column(name, column)
        if column.shape == (3,):
            yield _Columns(_axis_fields("sigma_m", "standard deviation of the TCP"), _sigmas)


def _sigmas(frames: FrameTable) -> list[pa.Array]:
    with np.errstate(invalid="ignore"):  # a negative variance in a recording has no standard deviation
        return _numbers(np.sqrt(np.diagonal(frames.covariance, axis1=1, axis2=2)[:, :3]))


def _numbers(values: NDArray[np.float64]) -> list[pa.Array]:
    """(n, k) as k columns; NaN is unknown."""
    return [pa.array(one, mask=np.isnan(one)) for one in map(np.ascontiguousarray, values.T)]


def _triangles(covariances: NDArray[np.float64]) -> pa.Array:
    upper = covariances.reshape(-1, 36)[:, UPPER]
    unknown = pa.array(np.isnan(upper).any(axis=1))
    return pa.FixedSizeListArray.from_arrays(pa.array(upper.reshape(-1)), type=_TRIANGLE, mask=unknown)


def _named(codes: NDArray[Any], names: tuple[str, ...]) -> pa.Array:
    indices = pa.array(codes.astype(np.int32), mask=codes < 0)
    return pa.DictionaryArray.from_arrays(indices, pa.array(names, pa.string())).cast(pa.string())


def _schema(table: str, fields: Iterable[pa.Field]) -> pa.Schema:
    fields = list(fields)
    about = {
        "gripmon.schema": f"gripmon.export.{table}/1",
        "gripmon.version": __version__,
        "gripmon.units": json.dumps({f.name: unit for f in fields if (unit := f.metadata[b"unit"].decode())}),
    }
    return pa.schema(fields, metadata=about)


_DATED: dict[str, tuple[type[msgspec.Struct], str]] = {
    "alerts": (
        AlertRecord,
        """stamp_ns seq event alert_id kind cause part severity text causes tcp_shift_m rotation_rad rate_m_per_min
        time_left_s since_ns acknowledged state reference_id revision""",
    ),
    "states": (
        StateRecord,
        """stamp_ns seq state verdict message reference_id revision frames frames_refused frames_dropped
        recording_dropped recording_images_dropped transforms_unsent malformed frames_per_s uptime_s camera_connected
        tcp_shift_m sigma_m protection_m valid_by alert_limit_m open_alerts version""",
    ),
    "commands": (RecordedCommand, "stamp_ns seq name argument done text"),
}
DATED = tuple(_DATED)
"""The tables of messages, each with its time."""
_REFERENCE = (
    "reference_id revision", "stamp_ns origin cam_T_grip covariance parent restores cause accepted_by"
)  # fmt: skip
"""Before and behind the time."""
_INPUTS = {"first_seq": "first_seq", "last_seq": "last_seq", "frames": "frames_used", "weighted_rms": "weighted_rms",
           "step_m": "step_m", "step_rad": "step_rad"}  # fmt: skip
"""Of what a reference was made from: a column each."""


def _of_message(message: type[msgspec.Struct], names: str) -> dict[str, _Columns]:
    return {name: _of_field(fields_of(message)[name]) for name in names.split()}


def _fields(columns: Iterable[_Columns]) -> list[pa.Field]:
    return [field for some in columns for field in some.fields]


_FRAMES = tuple(_frame_columns())
_MESSAGES = {table: _of_message(*of) for table, of in _DATED.items()}
_OF_REFERENCE = [_of_message(ReferenceRecord, names) for names in _REFERENCE]
_OF_INPUTS = {name: _of_field(fields_of(ReferenceInputs)[name]._replace(name=named)) for name, named in _INPUTS.items()}

SCHEMAS: dict[str, pa.Schema] = {
    "frames": _schema("frames", [*_fields(_FRAMES), *_RUN]),
    **{table: _schema(table, [_CLOCK, *_fields(columns.values()), *_RUN]) for table, columns in _MESSAGES.items()},
    "references": _schema("references", [
        *_fields(_OF_REFERENCE[0].values()), _CLOCK, *_fields(_OF_REFERENCE[1].values()),
        *_fields(_OF_INPUTS.values()),
    ]),
}  # fmt: skip
"""The columns of each table; within a major version columns may be added, not renamed or dropped."""


def frame_rows(frames: FrameTable, recording_id: str, number: int) -> pa.Table:
    """Rows of the table ``frames``."""
    run = pa.repeat(recording_id, len(frames)), pa.repeat(pa.scalar(number, pa.int32()), len(frames))
    arrays = [array for columns in _FRAMES for array in columns.values(frames)]
    return pa.table([*arrays, *run], schema=SCHEMAS["frames"])


def dated_rows(table: str, records: Iterable[Any], recording_id: str, number: int) -> pa.Table:
    """The table of some messages, in order of time."""
    run = {"recording_id": recording_id, "file_number": number}
    ordered = sorted(records, key=attrgetter("stamp_ns"))
    rows = [{**_row(_MESSAGES[table], record), "time": record.stamp_ns, **run} for record in ordered]
    return pa.Table.from_pylist(rows, SCHEMAS[table])


def reference_row(reference: ReferenceRecord) -> pa.Table:
    """The one row of a reference."""
    row = _row(_OF_REFERENCE[0] | _OF_REFERENCE[1], reference)
    row["stamp_ns"] = row["time"] = reference.stamp_ns or None  # 0: configured, at an unknown time
    if reference.inputs is not None:
        row |= _row(_OF_INPUTS, reference.inputs)
    return pa.Table.from_pylist([row], SCHEMAS["references"])


def _row(columns: dict[str, _Columns], record: msgspec.Struct) -> dict[str, Any]:
    """A message's values by column, without those that are unknown."""
    row: dict[str, Any] = {}
    for name, some in columns.items():
        if (value := getattr(record, name)) is not None:
            row |= zip((field.name for field in some.fields), some.values(value), strict=True)
    return row
