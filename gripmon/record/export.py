"""Recordings -> Parquet, for any engine: tables of frames, alerts, states, commands and references.

``<out>/<table>/robot=…/camera=…/date=YYYY-MM-DD/<run>-<number>.parquet``: each file of a recording gives one file per
table and day (UTC), which is replaced when it is exported again.  References, which outlive a day, are not partitioned
by date: each has its own file.  Units and descriptions are in the schemas' metadata.  Of a covariance (6 x 6,
symmetric) the upper triangle is stored, row by row: 21 numbers, ``UPPER`` of the flat 36.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any
from urllib.parse import quote

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from gripmon import __version__
from gripmon.model.atomic import opened_atomically, remove_leftovers
from gripmon.model.errors import NoResultError
from gripmon.model.lerobot_columns import POSE_NAMES
from gripmon.model.records import ReferenceRecord
from gripmon.record.read import open_recordings, recording_files
from gripmon.record.recordings import Recording, file_number
from gripmon.record.table import FrameTable

UPPER = np.ravel_multi_index(np.triu_indices(6), (6, 6))
_TRIANGLE = pa.list_(pa.float64(), len(UPPER))
_TIME = pa.timestamp("ns", tz="UTC")
_CAUSES = pa.list_(pa.struct([("cause", pa.string()), ("probability", pa.float64()), ("part", pa.string())]))

_Column = tuple[str, pa.DataType, str, str]
_DOUBLE, _INTEGER, _TEXT, _TRUTH = pa.float64(), pa.int64(), pa.string(), pa.bool_()

_AXES = ("x", "y", "z")


def _pose_columns(name: str, what: str) -> list[_Column]:
    units = ("m",) * 3 + ("1",) * 4
    return [
        (f"{name}_{part}", _DOUBLE, unit, f"{what}: position of the TCP in camera axes, unit quaternion x, y, z, w")
        for part, unit in zip(POSE_NAMES, units, strict=True)
    ]


def _shift_columns(what: str) -> list[_Column]:
    return [(f"tcp_shift_{axis}_m", _DOUBLE, "m", f"{what} along the camera's {axis}") for axis in _AXES]


_TRIANGLE_WORDS = "upper triangle, row by row, of 6 x 6: the TCP's position in camera axes, then the rotation vector"
_WHEN: list[_Column] = [
    ("time", _TIME, "UTC", "stamp_ns as a time"),
    ("stamp_ns", _INTEGER, "ns", "capture time, or when it was published: Unix"),
    ("seq", _INTEGER, "1", "number of the frame, or of the last one before it"),
]
_RUN: list[_Column] = [
    ("recording_id", _TEXT, "", "the run of the monitor that this is from"),
    ("file_number", pa.int32(), "1", "which of the recording's files it is from"),
]
_REFERENCE: list[_Column] = [
    ("reference_id", _TEXT, "", "the reference in force, which drift is measured against"),
    ("revision", _INTEGER, "1", "of the reference"),
]

_FRAMES: list[_Column] = [
    *_WHEN,
    ("verdict", _TEXT, "", "valid, suspect or unknown"),
    ("state", _TEXT, "", "what the monitor was doing"),
    ("source", _TEXT, "", "update, recalibration or held"),
    *_shift_columns("displacement of the TCP against the reference"),
    *[(f"sigma_{axis}_m", _DOUBLE, "m", f"standard deviation of the TCP along the camera's {axis}") for axis in _AXES],
    ("protection_m", _DOUBLE, "m", "protection level: bound on the TCP's position error"),
    ("protection_rad", _DOUBLE, "rad", "bound on the angle of the rotation error"),
    ("integrity_risk", _DOUBLE, "1", "probability per frame that the error exceeds a bound"),
    ("valid_by", _TEXT, "", "which error that is: reference, of the motion since the reference; absolute"),
    ("since_reference_m", _DOUBLE, "m", "bound on the TCP's position error of the motion since the reference"),
    ("since_reference_rad", _DOUBLE, "rad", "bound on the angle of its rotation error"),
    ("since", _TEXT, "", "what that motion counts from: reference or first_proved"),
    ("since_ns", _INTEGER, "ns", "stamp of the frames that it counts from: Unix"),
    ("absolute_m", _DOUBLE, "m", "bound on the TCP's position error of the transform as measured"),
    ("absolute_rad", _DOUBLE, "rad", "bound on the angle of its rotation error"),
    *_pose_columns("absolute", "the transform as measured"),
    ("d_m", _DOUBLE, "m", "length of the camera's displacement against the reference"),
    ("delta_rad", _DOUBLE, "rad", "turn of the camera against the reference"),
    *_pose_columns("cam_T_grip", "maps gripper to camera coordinates; what valid_by names"),
    ("covariance", _TRIANGLE, "m2, m rad, rad2", f"of cam_T_grip: {_TRIANGLE_WORDS}"),
    *_pose_columns("smoothed", "cam_T_grip averaged over time"),
    ("smoothed_covariance", _TRIANGLE, "m2, m rad, rad2", f"of smoothed: {_TRIANGLE_WORDS}"),
    *_REFERENCE,
    ("rms_px", _DOUBLE, "px", "root mean square of the corners' residuals"),
    ("jaw_opening_m", _DOUBLE, "m", "as the image shows it"),
    ("latency_ns", _INTEGER, "ns", "from when the frame came to the monitor's machine to judged"),
    ("corners_used", pa.int32(), "1", "corners that the transform rests on"),
    ("corners_total", pa.int32(), "1", "corners of the gripper file"),
    ("refused", _TRUTH, "", "nothing was measured in this frame"),
    *_RUN,
]

_ALERTS: list[_Column] = [
    *_WHEN,
    ("event", _TEXT, "", "raised, updated, cleared or noted"),
    ("alert_id", _TEXT, "", "the same from raised to cleared; empty for what is only noted"),
    ("kind", _TEXT, "", "what it is about"),
    ("cause", _TEXT, "", "the most probable one"),
    ("part", _TEXT, "", "the finger that the cause is about"),
    ("severity", _TEXT, "", "info, warning or error"),
    ("text", _TEXT, "", "one line for a person"),
    ("causes", _CAUSES, "1", "all that were weighed, with their probabilities"),
    *_shift_columns("of the TCP against the reference"),
    ("rotation_rad", _DOUBLE, "rad", "turn against the reference"),
    ("rate_m_per_min", _DOUBLE, "m/min", "speed of a creep"),
    ("time_left_s", _DOUBLE, "s", "until a creep reaches the limit"),
    ("since_ns", _INTEGER, "ns", "when it was raised: Unix"),
    ("acknowledged", _TRUTH, "", "an operator has taken note of it"),
    ("state", _TEXT, "", "what the monitor was doing"),
    *_REFERENCE,
    *_RUN,
]

_STATES: list[_Column] = [
    *_WHEN,
    ("state", _TEXT, "", "what the monitor was doing"),
    ("verdict", _TEXT, "", "of the last transform"),
    ("message", _TEXT, "", "what is wrong, in words; empty when all is well"),
    *_REFERENCE,
    ("frames", _INTEGER, "1", "handled since the start"),
    ("frames_refused", _INTEGER, "1", "of these, those that couldn't be measured at all"),
    ("frames_dropped", _INTEGER, "1", "that came while another one was worked on"),
    ("recording_dropped", _INTEGER, "1", "frames that the recording had no time for"),
    ("recording_images_dropped", _INTEGER, "1", "images that the recording had no time for, of frames that it has"),
    ("transforms_unsent", _INTEGER, "1", "before there was a Zenoh session"),
    ("malformed", _INTEGER, "1", "messages received that were none"),
    ("frames_per_s", _DOUBLE, "1/s", "rate of the last frames"),
    ("uptime_s", _DOUBLE, "s", "since the start"),
    ("camera_connected", _TRUTH, "", "the source is open"),
    *_shift_columns("of the TCP against the reference"),
    ("sigma_m", _DOUBLE, "m", "largest standard deviation of the TCP along a camera axis"),
    ("protection_m", _DOUBLE, "m", "bound on the TCP's position error, of the last transform"),
    ("valid_by", _TEXT, "", "which error that bounds: reference or absolute"),
    ("alert_limit_m", _DOUBLE, "m", "position error of the TCP that the task tolerates, as configured"),
    ("open_alerts", pa.int32(), "1", "alerts raised and not cleared"),
    ("version", _TEXT, "", "of gripmon"),
    *_RUN,
]

_COMMANDS: list[_Column] = [
    *_WHEN,
    ("name", _TEXT, "", "of the command"),
    ("argument", _TEXT, "", "as it was given"),
    ("done", _TRUTH, "", "false: refused"),
    ("text", _TEXT, "", "what was done, or why not"),
    *_RUN,
]

_REFERENCES: list[_Column] = [
    ("reference_id", _TEXT, "", "its name, which no other reference has"),
    ("revision", _INTEGER, "1", "grows by one with every change"),
    ("time", _TIME, "UTC", "stamp_ns as a time; null for a configured one"),
    ("stamp_ns", _INTEGER, "ns", "of the newest frame behind it or of the command: Unix; null for a configured one"),
    ("origin", _TEXT, "", "configuration, recalibration, undo or reset"),
    *_pose_columns("cam_T_grip", "maps gripper to camera coordinates"),
    ("covariance", _TRIANGLE, "m2, m rad, rad2", f"of cam_T_grip: {_TRIANGLE_WORDS}"),
    ("parent", _TEXT, "", "the reference in force before"),
    ("restores", _TEXT, "", "the earlier one that an undo or reset brought back"),
    ("cause", _TEXT, "", "what made it necessary"),
    ("accepted_by", _TEXT, "", "configuration, monitor or operator"),
    ("first_seq", _INTEGER, "1", "the first frame that was averaged"),
    ("last_seq", _INTEGER, "1", "the last one"),
    ("frames_used", _INTEGER, "1", "how many of them were used"),
    ("weighted_rms", _DOUBLE, "1", "of the residuals over their deviations"),
    ("step_m", _DOUBLE, "m", "by how much it moved the reference before it"),
    ("step_rad", _DOUBLE, "rad", "by how much it turned it"),
]


def _schema(table: str, columns: list[_Column]) -> pa.Schema:
    fields = [pa.field(name, kind, metadata={"unit": unit, "description": text}) for name, kind, unit, text in columns]
    units = {name: unit for name, _, unit, _ in columns if unit}
    about = {
        "gripmon.schema": f"gripmon.export.{table}/1",
        "gripmon.version": __version__,
        "gripmon.units": json.dumps(units),
    }
    return pa.schema(fields, metadata=about)


SCHEMAS: dict[str, pa.Schema] = {
    "frames": _schema("frames", _FRAMES),
    "alerts": _schema("alerts", _ALERTS),
    "states": _schema("states", _STATES),
    "commands": _schema("commands", _COMMANDS),
    "references": _schema("references", _REFERENCES),
}
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
        recording_id, number = part.recording_id, file_number(part.meta, path) or 0
        name = f"{_file_name(recording_id)}-{number:04d}.parquet"
        known = self._from.setdefault((part.robot, part.camera, name), path)
        if known != path:
            self.faults.append(f"{path}: the same part of the same run as {known}; left out")
            return
        frames = part.frames.take(np.argsort(part.frames.stamp_ns, kind="stable"))

        where = f"robot={_escaped(part.robot)}/camera={_escaped(part.camera)}"
        tables = {table: _dated(table, getattr(part, table), recording_id, number) for table in _DATED}
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


def frame_rows(frames: FrameTable, recording_id: str, file_number: int) -> pa.Table:
    """The table ``frames``, one row per frame, in the given order.  NaN and -1 (unknown) become null."""
    with np.errstate(invalid="ignore"):  # a value that is not a covariance has no standard deviation
        sigma_m = np.sqrt(np.diagonal(frames.covariance, axis1=1, axis2=2)[:, :3])
    axes = [f"{axis}_m" for axis in _AXES]
    poses = (("cam_T_grip", frames.cam_T_grip, POSE_NAMES), ("smoothed", frames.smoothed, POSE_NAMES),
             ("absolute", frames.absolute, POSE_NAMES),
             ("tcp_shift", frames.tcp_shift_m, axes), ("sigma", sigma_m, axes))  # fmt: skip
    columns: dict[str, Any] = {
        "time": pa.array(frames.stamp_ns, pa.int64()).cast(_TIME),
        "verdict": _named(frames.verdict, frames.VERDICTS),
        "state": _named(frames.state, frames.STATES),
        "source": _named(frames.source, frames.ORIGINS),
        "valid_by": _named(frames.valid_by, frames.VALID_BY),
        "since": _named(frames.since, frames.SINCE),
        "since_ns": pa.array(frames.since_ns, mask=frames.since_ns < 0),
        **{f"{name}_{part}": _number(values[:, i]) for name, values, parts in poses for i, part in enumerate(parts)},
        "covariance": _triangle(frames.covariance),
        "smoothed_covariance": _triangle(frames.smoothed_covariance),
        "reference_id": _named(frames.reference, frames.reference_ids),
        "revision": pa.array(frames.revision, mask=frames.revision < 0),
        "latency_ns": pa.array(frames.latency_ns, mask=frames.latency_ns < 0),
        "recording_id": pa.repeat(recording_id, len(frames)),
        "file_number": pa.repeat(pa.scalar(file_number, pa.int32()), len(frames)),
    }
    for field in SCHEMAS["frames"]:
        if field.name not in columns:
            values = getattr(frames, field.name)
            columns[field.name] = _number(values) if values.dtype == np.float64 else pa.array(values)
    return pa.table([columns[field.name] for field in SCHEMAS["frames"]], schema=SCHEMAS["frames"])


def _dated(table: str, records: Iterable[Any], recording_id: str, file_number: int) -> pa.Table:
    """The table ``alerts``, ``states`` or ``commands``, in order of time."""
    rows = []
    for record in sorted(records, key=lambda record: int(record.stamp_ns)):
        row = _values(record)
        row |= {f"tcp_shift_{axis}_m": v for axis, v in zip(_AXES, row.get("tcp_shift_m") or (), strict=False)}
        if "open_alerts" in row:
            row["open_alerts"] = len(row["open_alerts"])
        rows.append(row | {"time": record.stamp_ns, "recording_id": recording_id, "file_number": file_number})
    return pa.Table.from_pylist(rows, SCHEMAS[table])


def reference_row(reference: ReferenceRecord) -> pa.Table:
    """The one row of a reference."""
    row = _values(reference)
    inputs = {} if reference.inputs is None else _values(reference.inputs)
    stamp_ns = reference.stamp_ns or None  # 0: configured, at an unknown time
    row |= {"stamp_ns": stamp_ns, "time": stamp_ns, "frames_used": inputs.pop("frames", None), **inputs}
    pose = reference.cam_T_grip
    values = (*pose.translation_m, *pose.rotation_xyzw)
    row |= {f"cam_T_grip_{part}": value for part, value in zip(POSE_NAMES, values, strict=True)}
    row |= {"covariance": [reference.covariance[i] for i in UPPER]}
    return pa.Table.from_pylist([row], SCHEMAS["references"])


def _values(record: msgspec.Struct) -> dict[str, Any]:
    given = {name: value for name, value in msgspec.structs.asdict(record).items() if value is not msgspec.UNSET}
    values: dict[str, Any] = msgspec.to_builtins(given)
    return values


def _number(values: NDArray[np.float64]) -> pa.Array:
    return pa.array(np.ascontiguousarray(values), mask=np.isnan(values))


def _named(codes: NDArray[Any], names: tuple[str, ...]) -> pa.Array:
    indices = pa.array(codes.astype(np.int32), mask=codes < 0)
    return pa.DictionaryArray.from_arrays(indices, pa.array(names, pa.string())).cast(pa.string())


def _triangle(covariance: NDArray[np.float64]) -> pa.Array:
    upper = covariance.reshape(-1, 36)[:, UPPER]
    return pa.FixedSizeListArray.from_arrays(
        pa.array(upper.reshape(-1)), type=_TRIANGLE, mask=pa.array(np.isnan(upper).any(axis=1))
    )
