"""What a recording holds -> Arrow tables of the exported schemas."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from gripmon.model.records import AlertRecord, ReferenceRecord, StateRecord, Transform
from gripmon.model.records.recorded import RecordedCommand
from gripmon.record.export.schemas import AXES, POSE, SCHEMAS, TIME, TRIANGLE, UPPER
from gripmon.record.read import FrameTable

_Row = dict[str, Any]


def frame_rows(frames: FrameTable, recording_id: str, file_number: int) -> pa.Table:
    """The table ``frames``, a row a frame, in the given order.  NaN, and -1 where a number isn't known, become null."""
    with np.errstate(invalid="ignore"):  # what is no covariance has no deviation
        sigma_m = np.sqrt(np.diagonal(frames.covariance, axis1=1, axis2=2)[:, :3])
    columns: dict[str, Any] = {
        "time": pa.array(frames.stamp_ns, pa.int64()).cast(TIME),
        "stamp_ns": pa.array(frames.stamp_ns),
        "seq": pa.array(frames.seq),
        "verdict": _named(frames.verdict, frames.VERDICTS),
        "state": _named(frames.state, frames.STATES),
        "source": _named(frames.source, frames.ORIGINS),
        **{f"tcp_shift_{axis}_m": _number(frames.tcp_shift_m[:, i]) for i, axis in enumerate(AXES)},
        **{f"sigma_{axis}_m": _number(sigma_m[:, i]) for i, axis in enumerate(AXES)},
        "protection_m": _number(frames.protection_m),
        "protection_rad": _number(frames.protection_rad),
        "integrity_risk": _number(frames.integrity_risk),
        "d_m": _number(frames.d_m),
        "delta_rad": _number(frames.delta_rad),
        **{f"cam_T_grip_{part}": _number(frames.cam_T_grip[:, i]) for i, part in enumerate(POSE)},
        "covariance": _triangle(frames.covariance),
        **{f"smoothed_{part}": _number(frames.smoothed[:, i]) for i, part in enumerate(POSE)},
        "smoothed_covariance": _triangle(frames.smoothed_covariance),
        "reference_id": _named(frames.reference, frames.reference_ids),
        "revision": _count(frames.revision),
        "rms_px": _number(frames.rms_px),
        "jaw_opening_m": _number(frames.jaw_opening_m),
        "latency_ns": _count(frames.latency_ns),
        "corners_used": pa.array(frames.corners_used),
        "corners_total": pa.array(frames.corners_total),
        "refused": pa.array(frames.refused),
        "recording_id": pa.repeat(recording_id, len(frames)),
        "file_number": pa.repeat(pa.scalar(file_number, pa.int32()), len(frames)),
    }
    return pa.table(columns, schema=SCHEMAS["frames"])


def alert_rows(alerts: Sequence[AlertRecord], recording_id: str, file_number: int) -> pa.Table:
    """The table ``alerts``, in order of time."""
    return _dated("alerts", alerts, lambda a: _shift(a.tcp_shift_m), recording_id, file_number)


def state_rows(states: Sequence[StateRecord], recording_id: str, file_number: int) -> pa.Table:
    """The table ``states``, in order of time."""

    def more(state: StateRecord) -> _Row:
        return {**_shift(state.tcp_shift_m), "open_alerts": len(state.open_alerts)}

    return _dated("states", states, more, recording_id, file_number)


def command_rows(commands: Sequence[RecordedCommand], recording_id: str, file_number: int) -> pa.Table:
    """The table ``commands``, in order of time."""
    return _dated("commands", commands, lambda _: {}, recording_id, file_number)


def reference_row(reference: ReferenceRecord) -> pa.Table:
    """The one row of a reference."""
    row = _values(reference)
    inputs = {} if reference.inputs is None else _values(reference.inputs)
    stamp_ns = reference.stamp_ns or None  # 0: configured, at a time that nobody has said
    row |= {"stamp_ns": stamp_ns, "time": stamp_ns, "frames_used": inputs.pop("frames", None), **inputs}
    row |= _pose(reference.cam_T_grip) | {"covariance": [reference.covariance[i] for i in UPPER]}
    return _table("references", [row])


def days_of(stamps_ns: NDArray[np.int64]) -> NDArray[np.datetime64]:
    """The UTC day of each time."""
    return stamps_ns.astype("datetime64[ns]").astype("datetime64[D]")


def _dated(table: str, records: Iterable[Any], more: Any, recording_id: str, file_number: int) -> pa.Table:
    run = {"recording_id": recording_id, "file_number": file_number}
    rows = [
        {**_values(record), "time": record.stamp_ns, **more(record), **run}
        for record in sorted(records, key=lambda record: int(record.stamp_ns))
    ]
    return _table(table, rows)


def _table(table: str, rows: list[_Row]) -> pa.Table:
    schema = SCHEMAS[table]
    columns = []
    for field in schema:
        values = [row.get(field.name) for row in rows]
        array = pa.array(values, pa.int64()).cast(TIME) if field.type == TIME else pa.array(values, field.type)
        columns.append(array)
    return pa.table(columns, schema=schema)


def _values(record: msgspec.Struct) -> _Row:
    values: _Row = msgspec.to_builtins(msgspec.structs.asdict(record))
    return values


def _shift(shift_m: tuple[float, float, float] | None) -> _Row:
    return {f"tcp_shift_{axis}_m": value for axis, value in zip(AXES, shift_m or (None,) * 3, strict=True)}


def _pose(pose: Transform) -> _Row:
    values = (*pose.translation_m, *pose.rotation_xyzw)
    return {f"cam_T_grip_{part}": value for part, value in zip(POSE, values, strict=True)}


def _number(values: NDArray[np.float64]) -> pa.Array:
    return pa.array(np.ascontiguousarray(values), mask=np.isnan(values))


def _count(values: NDArray[np.int64]) -> pa.Array:
    return pa.array(values, mask=values < 0)


def _named(codes: NDArray[Any], names: tuple[str, ...]) -> pa.Array:
    indices = pa.array(codes.astype(np.int32), mask=codes < 0)
    return pa.DictionaryArray.from_arrays(indices, pa.array(names, pa.string())).cast(pa.string())


def _triangle(covariance: NDArray[np.float64]) -> pa.Array:
    upper = covariance.reshape(-1, 36)[:, UPPER]
    return pa.FixedSizeListArray.from_arrays(
        pa.array(upper.reshape(-1)), type=TRIANGLE, mask=pa.array(np.isnan(upper).any(axis=1))
    )
