"""The frames of a recording as columns, for the report, the correction and the export.

:class:`FrameTable` says once, for each column, where in a record it stands, its unit and its meaning: what is built
from records here, and what is written as Parquet, follow from it.
"""

# ruff: noqa: RUF009 - what describes a column makes a ``dataclasses.field`` of its own

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Absolute, FrameRecord, Origin, Since, Smoothed, State, Transform, ValidBy, Verdict

IntArray = NDArray[np.int64]
FloatArray = NDArray[np.float64]
CodeArray = NDArray[np.int8]

OTHER = "other"
"""Replaces a state or origin that only a newer version knows."""
_BLOCK_ROWS = 4096


@dataclass(frozen=True)
class Column:
    """``of`` gives a record's value, of this ``type`` and ``shape``; None becomes NaN.  ``names``: it is a code, an
    index into them.  ``curve``: the path of its curve in a recording, without the unit, and the curve's name.
    """

    of: Callable[[FrameRecord], Any]
    unit: str
    help: str
    type: type[np.generic] = np.float64
    shape: tuple[int, ...] = ()
    names: tuple[str, ...] = ()
    curve: tuple[str, str] | None = dataclasses.field(default=None, kw_only=True)


def _column(
    unit: str, help_: str, of: Callable[[FrameRecord], Any], *more: Any, curve: tuple[str, str] | None = None
) -> Any:
    return dataclasses.field(metadata={"column": Column(of, unit, help_, *more, curve=curve)})


def _whole(unit: str, help_: str, of: Callable[[FrameRecord], Any], curve: tuple[str, str] | None = None) -> Any:
    return _column(unit, help_, of, np.int64, curve=curve)


def _pose(help_: str, of: Callable[[FrameRecord], Transform | Smoothed | Absolute | None]) -> Any:
    def numbers(record: FrameRecord) -> tuple[float, ...]:
        pose = of(record)
        return _NAN_7 if pose is None else pose.translation_m + pose.rotation_xyzw

    axes = "position of the TCP in camera axes, unit quaternion x, y, z, w"
    return _column("m", f"{help_}: {axes}", numbers, np.float64, (7,))


def _covariance(whose: str, of: Callable[[FrameRecord], tuple[float, ...] | None]) -> Any:
    axes = "the TCP's position in camera axes, then the rotation vector"
    return _column("m2, m rad, rad2", f"of {whose}: {axes}", lambda r: of(r) or _NAN_36, np.float64, (6, 6))


def _code(help_: str, of: Callable[[FrameRecord], Any], names: tuple[str, ...], unknown: str) -> Any:
    codes = {name: code for code, name in enumerate(names)}

    def code(record: FrameRecord) -> int:
        name = of(record)
        return -1 if name is None else codes.get(name, codes[unknown])

    return _column("", help_, code, np.int8, (), names)


_NAN_3, _NAN_7, _NAN_36 = (np.nan,) * 3, (np.nan,) * 7, (np.nan,) * 36
_VERDICTS = tuple(v.value for v in Verdict)
_STATES = (*(s.value for s in State), OTHER)
_ORIGINS = (*(o.value for o in Origin), OTHER)
_VALID_BY = tuple(v.value for v in ValidBy)
_SINCE = (*(s.value for s in Since), OTHER)
_LEVEL = ("protection/level", "protection level")
_SINCE_REFERENCE, _ABSOLUTE = ("protection/since_reference", "since the reference"), ("protection/absolute", "absolute")
_POSITION, _ANGLE = "bound on the TCP's position error", "bound on the angle of the rotation error"


@dataclass(frozen=True, eq=False)
class FrameTable:
    """One row per frame; NaN where a number is null, -1 where an integer or a code is unknown.

    (n,) each, but poses (n, 7), covariances (n, 6, 6), position (m) before rotation vector (rad), and ``tcp_shift_m``
    (n, 3).  Codes index the tuples of names: ``VERDICTS[verdict]``, ``STATES[state]``, ``ORIGINS[source]``,
    ``VALID_BY[valid_by]``, ``SINCE[since]``, ``reference_ids[reference]``.  A state or origin that this version doesn't
    know is ``other``.  Metadata of each field: its :class:`Column`.
    """

    VERDICTS: ClassVar[tuple[str, ...]] = _VERDICTS
    STATES: ClassVar[tuple[str, ...]] = _STATES
    ORIGINS: ClassVar[tuple[str, ...]] = _ORIGINS
    VALID_BY: ClassVar[tuple[str, ...]] = _VALID_BY
    SINCE: ClassVar[tuple[str, ...]] = _SINCE

    stamp_ns: IntArray = _whole("ns", "capture time: Unix", lambda r: r.stamp_ns)
    seq: IntArray = _whole("1", "number of the frame", lambda r: r.seq)
    verdict: CodeArray = _code("valid, suspect or unknown", lambda r: r.verdict, _VERDICTS, Verdict.UNKNOWN)
    state: CodeArray = _code("what the monitor was doing", lambda r: r.state, _STATES, OTHER)
    source: CodeArray = _code("update, recalibration or held", lambda r: r.source, _ORIGINS, OTHER)
    tcp_shift_m: FloatArray = _column(
        "m", "displacement of the TCP against the reference",
        lambda r: _NAN_3 if r.drift is None else r.drift.tcp_shift_m, np.float64, (3,),
    )  # fmt: skip
    protection_m: FloatArray = _column(
        "m", f"protection level: {_POSITION}", lambda r: r.protection and r.protection.position_m, curve=_LEVEL
    )
    protection_rad: FloatArray = _column(
        "rad", _ANGLE, lambda r: r.protection and r.protection.rotation_rad, curve=_LEVEL
    )
    integrity_risk: FloatArray = _column(
        "1", "probability per frame that the error exceeds a bound", lambda r: r.protection and r.protection.risk
    )
    valid_by: CodeArray = _code(
        "which error that is: reference, of the motion since the reference; absolute", lambda r: r.valid_by,
        _VALID_BY, ValidBy.REFERENCE,
    )  # fmt: skip
    since_reference_m: FloatArray = _column(
        "m", f"{_POSITION} of the motion since the reference",
        lambda r: r.since_reference and r.since_reference.position_m, curve=_SINCE_REFERENCE,
    )  # fmt: skip
    since_reference_rad: FloatArray = _column(
        "rad", "bound on the angle of its rotation error",
        lambda r: r.since_reference and r.since_reference.rotation_rad, curve=_SINCE_REFERENCE,
    )  # fmt: skip
    since: CodeArray = _code(
        "what that motion counts from: reference or first_proved",
        lambda r: r.since_reference and r.since_reference.since, _SINCE, OTHER,
    )  # fmt: skip
    since_ns: IntArray = _whole(
        "ns", "stamp of the frames that it counts from: Unix",
        lambda r: -1 if r.since_reference is None else r.since_reference.since_ns,
    )  # fmt: skip
    absolute_m: FloatArray = _column(
        "m", f"{_POSITION} of the transform as measured", lambda r: r.absolute and r.absolute.position_m,
        curve=_ABSOLUTE,
    )  # fmt: skip
    absolute_rad: FloatArray = _column(
        "rad", "bound on the angle of its rotation error", lambda r: r.absolute and r.absolute.rotation_rad,
        curve=_ABSOLUTE,
    )  # fmt: skip
    absolute: FloatArray = _pose("the transform as measured", lambda r: r.absolute)
    d_m: FloatArray = _column(
        "m", "length of the camera's displacement against the reference", lambda r: r.drift and r.drift.translation_m,
        curve=("drift/d", "d"),
    )  # fmt: skip
    delta_rad: FloatArray = _column(
        "rad", "turn of the camera against the reference", lambda r: r.drift and r.drift.rotation_rad,
        curve=("drift/delta", "δ"),
    )  # fmt: skip
    cam_T_grip: FloatArray = _pose("maps gripper to camera coordinates; what valid_by names", lambda r: r.cam_T_grip)
    covariance: FloatArray = _covariance("cam_T_grip", lambda r: r.covariance)
    smoothed: FloatArray = _pose("cam_T_grip averaged over time", lambda r: r.smoothed)
    smoothed_covariance: FloatArray = _covariance(
        "smoothed", lambda r: None if r.smoothed is None else r.smoothed.covariance
    )
    reference: NDArray[np.int32] = _column(
        "", "the reference in force, which drift is measured against", lambda r: r.reference_id, np.int32
    )
    revision: IntArray = _whole("1", "of the reference", lambda r: r.revision)
    rms_px: FloatArray = _column("px", "root mean square of the corners' residuals", lambda r: r.rms_px)
    jaw_opening_m: FloatArray = _column("m", "as the image shows it", lambda r: r.jaw_opening_m)
    latency_ns: IntArray = _whole(
        "ns", "from when the frame came to the monitor's machine to judged", lambda r: r.latency_ns,
        curve=("timing/latency", "latency"),
    )  # fmt: skip
    corners_used: NDArray[np.int32] = _column(
        "1", "corners that the transform rests on", lambda r: sum([c.used for c in r.corners]), np.int32,
        curve=("quality/corners_used", "corners used"),
    )  # fmt: skip
    corners_total: NDArray[np.int32] = _column("1", "corners of the gripper file", lambda r: len(r.corners), np.int32)
    refused: NDArray[np.bool_] = _column("", "nothing was measured in this frame", lambda r: not r.measured, np.bool_)
    searched_seq: IntArray = _whole(
        "1", "number of the frame whose image the search used that counts from this one on; -1: none",
        lambda r: -1 if r.beside is None or r.beside.searched_seq is None else r.beside.searched_seq,
    )  # fmt: skip
    reference_ids: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.seq)

    @property
    def measured(self) -> NDArray[np.bool_]:
        """(n,) frames with a transform of their own: not refused, nor held, nor by a quaternion that turns nothing."""
        known = np.isfinite(self.cam_T_grip).all(axis=1)
        return ~self.refused & known & (np.linalg.norm(self.cam_T_grip[:, 3:], axis=1) > 0.0)

    def take(self, rows: NDArray[np.intp] | NDArray[np.bool_] | slice) -> FrameTable:
        """Some rows: indexes, a mask or a slice."""
        return dataclasses.replace(self, **{name: getattr(self, name)[rows] for name in COLUMNS})

    def matrices(self) -> FloatArray:
        """(n, 4, 4) of ``cam_T_grip``; NaN where it is null."""
        return pose_matrices(self.cam_T_grip)


COLUMNS: dict[str, Column] = {
    field.name: field.metadata["column"] for field in dataclasses.fields(FrameTable) if field.metadata
}


def pose_matrices(poses: Any) -> FloatArray:
    """(n, 4, 4) of positions and quaternions x, y, z, w (n, 7), which need not be unit; NaN where one is NaN."""
    pose = np.reshape(np.asarray(poses, np.float64), (-1, 7))
    x, y, z, w = (pose[:, 3:] / np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)).T
    out = np.zeros((len(pose), 4, 4))
    out[:, 0, :3] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], axis=1)
    out[:, 1, :3] = np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], axis=1)
    out[:, 2, :3] = np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], axis=1)
    out[:, :3, 3] = pose[:, :3]
    out[:, 3, 3] = 1.0
    return out


class TableBuilder:
    """Collects records into columns block by block, so that memory never holds a long list of objects."""

    def __init__(self) -> None:
        self._rows: list[FrameRecord] = []
        self._blocks: dict[str, list[NDArray[Any]]] = {name: [] for name in COLUMNS}
        self._references: dict[str, int] = {}
        self._count = 0
        self.first_seq = np.iinfo(np.int64).max
        self.last_seq = np.iinfo(np.int64).min

    def __len__(self) -> int:
        return self._count

    def add(self, record: FrameRecord) -> None:
        """One more row."""
        self._rows.append(record)
        self._count += 1
        self.first_seq, self.last_seq = min(self.first_seq, record.seq), max(self.last_seq, record.seq)
        if len(self._rows) >= _BLOCK_ROWS:
            self._close_block()

    @staticmethod
    def join(builders: Sequence[TableBuilder]) -> FrameTable:
        """All rows of all builders, one after another.  Columns are moved out of the builders one by one, so that
        memory doesn't hold them twice; the builders can't be used afterwards.
        """
        places: dict[str, int] = {}
        for builder in builders:
            builder._close_block()
            new = np.array([places.setdefault(name, len(places)) for name in builder._references], np.int32)
            builder._blocks["reference"] = [new[block] for block in builder._blocks["reference"]]
        columns: dict[str, Any] = {}
        for name, column in COLUMNS.items():
            blocks = [block for builder in builders for block in builder._blocks.pop(name)]
            columns[name] = np.concatenate(blocks) if blocks else np.empty((0, *column.shape), column.type)
        return FrameTable(**columns, reference_ids=tuple(places))

    def _close_block(self) -> None:
        rows, self._rows = self._rows, []
        places = self._references
        for name, column in COLUMNS.items() if rows else ():
            values = [column.of(row) for row in rows]
            if name == "reference":
                values = [places.setdefault(value, len(places)) for value in values]
            self._blocks[name].append(np.array(values, column.type).reshape(-1, *column.shape))
