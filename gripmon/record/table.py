"""The frames of a recording as columns, for the report, the correction and the export.

Needs only NumPy and msgspec; of JSON lines only the fields of the columns are decoded.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from gripmon.model.records import (
    Absolute,
    Drift,
    FrameRecord,
    Origin,
    Protection,
    Since,
    SinceReference,
    Smoothed,
    State,
    Transform,
    ValidBy,
    Verdict,
)

IntArray = NDArray[np.int64]
FloatArray = NDArray[np.float64]

OTHER = "other"
"""Replaces a state or origin that only a newer version knows."""
_BLOCK_ROWS = 4096
_Integer = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
_Square = Annotated[tuple[float, ...], Meta(min_length=36, max_length=36)]


class _Corner(msgspec.Struct, frozen=True, gc=False):
    used: bool = False


class Line(msgspec.Struct, frozen=True, gc=False):
    """The fields of a :class:`FrameRecord` that the columns need; those that another version omits are unknown."""

    seq: _Integer
    stamp_ns: _Integer
    schema: str = ""
    verdict: str = Verdict.UNKNOWN.value
    state: str = OTHER
    source: str = OTHER
    cam_T_grip: Transform | None = None
    covariance: _Square | None = None
    smoothed: Smoothed | None = None
    drift: Drift | None = None
    reference_id: str = ""
    revision: _Integer = -1
    rms_px: float | None = None
    jaw_opening_m: float | None = None
    corners: tuple[_Corner, ...] = ()
    alerts: tuple[msgspec.Raw, ...] = ()
    latency_ns: _Integer = -1
    reason: str | None = None
    protection: Protection | None = None
    valid_by: str = ValidBy.ABSOLUTE.value
    since_reference: SinceReference | None = None
    absolute: Absolute | None = None


@dataclass(frozen=True, eq=False)
class FrameTable:
    """One row per frame; NaN where a number is null, -1 where an integer is unknown.

    Codes index the tuples of names: ``VERDICTS[verdict]``, ``STATES[state]``, ``ORIGINS[source]``,
    ``VALID_BY[valid_by]``, ``SINCE[since]``, ``reference_ids[reference]``.  A state or origin that this version doesn't
    know is ``other``; an unknown verdict counts as ``unknown``, on which nothing may rely.
    """

    VERDICTS: ClassVar[tuple[str, ...]] = tuple(v.value for v in Verdict)
    STATES: ClassVar[tuple[str, ...]] = (*(s.value for s in State), OTHER)
    ORIGINS: ClassVar[tuple[str, ...]] = (*(o.value for o in Origin), OTHER)
    VALID_BY: ClassVar[tuple[str, ...]] = tuple(v.value for v in ValidBy)
    SINCE: ClassVar[tuple[str, ...]] = (*(s.value for s in Since), OTHER)

    seq: IntArray
    """(n,) number of the frame."""
    stamp_ns: IntArray
    """(n,) capture time, Unix ns."""
    verdict: NDArray[np.int8]
    state: NDArray[np.int8]
    source: NDArray[np.int8]
    cam_T_grip: FloatArray
    """(n, 7) what ``valid_by`` names: x, y, z of the TCP in camera axes, m; unit quaternion x, y, z, w."""
    covariance: FloatArray
    """(n, 6, 6): position (m), then rotation vector (rad), camera axes."""
    smoothed: FloatArray
    """(n, 7) as ``cam_T_grip``."""
    smoothed_covariance: FloatArray
    protection_m: FloatArray
    """(n,) protection level: bound on the TCP's position error; NaN in recordings from before it was computed, too."""
    protection_rad: FloatArray
    """(n,) bound on the angle of the rotation error."""
    integrity_risk: FloatArray
    """(n,) probability per frame that the error exceeds a bound."""
    valid_by: NDArray[np.int8]
    """(n,) which transform and which error ``cam_T_grip``, ``covariance`` and the protection level are of."""
    since_reference_m: FloatArray
    """(n,) bound on the position error of the motion since the reference; NaN in recordings from before it, too."""
    since_reference_rad: FloatArray
    since: NDArray[np.int8]
    """(n,) what that motion counts from; -1: not known."""
    since_ns: IntArray
    """(n,) and its stamp, Unix ns."""
    absolute_m: FloatArray
    """(n,) bound on the position error of the transform as measured."""
    absolute_rad: FloatArray
    absolute: FloatArray
    """(n, 7) the transform as measured."""
    d_m: FloatArray
    """(n,) length of the camera's displacement from the reference."""
    delta_rad: FloatArray
    """(n,) its turn."""
    tcp_shift_m: FloatArray
    """(n, 3) displacement of the TCP along the camera's axes."""
    reference: NDArray[np.int32]
    """(n,) index into ``reference_ids``."""
    revision: IntArray
    rms_px: FloatArray
    jaw_opening_m: FloatArray
    latency_ns: IntArray
    corners_used: NDArray[np.int32]
    corners_total: NDArray[np.int32]
    refused: NDArray[np.bool_]
    """(n,) nothing was measured in this frame; its transform, if any, is held."""
    reference_ids: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.seq)

    def take(self, rows: NDArray[np.intp] | NDArray[np.bool_] | slice) -> FrameTable:
        """Some rows: indexes, a mask or a slice."""
        return dataclasses.replace(self, **{name: getattr(self, name)[rows] for name in (*_COLUMNS, "reference")})

    def matrices(self) -> FloatArray:
        """(n, 4, 4) of ``cam_T_grip``; NaN where it is null."""
        return pose_matrices(self.cam_T_grip)


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


_VERDICT_CODES = {name: code for code, name in enumerate(FrameTable.VERDICTS)}
_STATE_CODES = {name: code for code, name in enumerate(FrameTable.STATES)}
_ORIGIN_CODES = {name: code for code, name in enumerate(FrameTable.ORIGINS)}
_VALID_BY_CODES = {name: code for code, name in enumerate(FrameTable.VALID_BY)}
_SINCE_CODES = {name: code for code, name in enumerate(FrameTable.SINCE)}
_NAN_3, _NAN_7, _NAN_36 = (np.nan,) * 3, (np.nan,) * 7, (np.nan,) * 36


class _Column(NamedTuple):
    """``of`` returns a record's value, of this ``type`` and ``shape``."""

    of: Callable[[Any], Any]
    type: type[np.generic] = np.float64
    shape: tuple[int, ...] = ()


def _pose(pose: Transform | Smoothed | Absolute | None) -> tuple[float, ...]:
    return _NAN_7 if pose is None else pose.translation_m + pose.rotation_xyzw


def _since(row: FrameRecord | Line) -> int:
    return -1 if row.since_reference is None else _SINCE_CODES.get(row.since_reference.since, _SINCE_CODES[OTHER])


def _bound_of(row: FrameRecord | Line) -> Absolute | Protection | None:
    """Of the transform as measured; a record of schema 1 has no other."""
    return row.absolute or (row.protection if row.valid_by == ValidBy.ABSOLUTE else None)


def _as_measured(row: FrameRecord | Line) -> Transform | Absolute | None:
    return row.absolute or (row.cam_T_grip if row.valid_by == ValidBy.ABSOLUTE else None)


_COLUMNS: dict[str, _Column] = {
    "seq": _Column(lambda r: r.seq, np.int64),
    "stamp_ns": _Column(lambda r: r.stamp_ns, np.int64),
    "verdict": _Column(lambda r: _VERDICT_CODES.get(r.verdict, _VERDICT_CODES[Verdict.UNKNOWN]), np.int8),
    "state": _Column(lambda r: _STATE_CODES.get(r.state, _STATE_CODES[OTHER]), np.int8),
    "source": _Column(lambda r: _ORIGIN_CODES.get(r.source, _ORIGIN_CODES[OTHER]), np.int8),
    "cam_T_grip": _Column(lambda r: _pose(r.cam_T_grip), shape=(7,)),
    "covariance": _Column(lambda r: r.covariance or _NAN_36, shape=(6, 6)),
    "smoothed": _Column(lambda r: _pose(r.smoothed), shape=(7,)),
    "smoothed_covariance": _Column(lambda r: _NAN_36 if r.smoothed is None else r.smoothed.covariance, shape=(6, 6)),
    "protection_m": _Column(lambda r: np.nan if r.protection is None else r.protection.position_m),
    "protection_rad": _Column(lambda r: np.nan if r.protection is None else r.protection.rotation_rad),
    "integrity_risk": _Column(lambda r: np.nan if r.protection is None else r.protection.risk),
    # A name that this version doesn't know counts as the bound that promises less.
    "valid_by": _Column(lambda r: _VALID_BY_CODES.get(r.valid_by, _VALID_BY_CODES[ValidBy.REFERENCE]), np.int8),
    "since_reference_m": _Column(lambda r: np.nan if r.since_reference is None else r.since_reference.position_m),
    "since_reference_rad": _Column(lambda r: np.nan if r.since_reference is None else r.since_reference.rotation_rad),
    "since": _Column(_since, np.int8),
    "since_ns": _Column(lambda r: -1 if r.since_reference is None else r.since_reference.since_ns, np.int64),
    "absolute_m": _Column(lambda r: np.nan if (b := _bound_of(r)) is None else b.position_m),
    "absolute_rad": _Column(lambda r: np.nan if (b := _bound_of(r)) is None else b.rotation_rad),
    "absolute": _Column(lambda r: _pose(_as_measured(r)), shape=(7,)),
    "d_m": _Column(lambda r: np.nan if r.drift is None else r.drift.translation_m),
    "delta_rad": _Column(lambda r: np.nan if r.drift is None else r.drift.rotation_rad),
    "tcp_shift_m": _Column(lambda r: _NAN_3 if r.drift is None else r.drift.tcp_shift_m, shape=(3,)),
    "revision": _Column(lambda r: r.revision, np.int64),
    "rms_px": _Column(lambda r: r.rms_px),
    "jaw_opening_m": _Column(lambda r: r.jaw_opening_m),
    "latency_ns": _Column(lambda r: r.latency_ns, np.int64),
    "corners_used": _Column(lambda r: sum([c.used for c in r.corners]), np.int32),
    "corners_total": _Column(lambda r: len(r.corners), np.int32),
    "refused": _Column(lambda r: r.source == Origin.HELD.value or r.cam_T_grip is None, np.bool_),
}
"""Every column but ``reference``; None becomes NaN."""
_REFERENCE = _Column(lambda r: r.reference_id, np.int32)


class TableBuilder:
    """Collects records into columns block by block, so that memory never holds a long list of objects.

    ``unknown_names``: verdicts, states and origins that this version doesn't know.
    """

    def __init__(self) -> None:
        self._rows: list[FrameRecord | Line] = []
        self._blocks: dict[str, list[NDArray[Any]]] = {name: [] for name in (*_COLUMNS, "reference")}
        self._references: dict[str, int] = {}
        self._count = 0
        self.unknown_names: set[str] = set()
        self.first_seq = np.iinfo(np.int64).max
        self.last_seq = np.iinfo(np.int64).min

    def __len__(self) -> int:
        return self._count

    def add(self, record: FrameRecord | Line) -> None:
        """One more row."""
        self._rows.append(record)
        self._count += 1
        self.first_seq, self.last_seq = min(self.first_seq, record.seq), max(self.last_seq, record.seq)
        if len(self._rows) >= _BLOCK_ROWS:
            self._close_block()

    def close(self) -> None:
        """Convert the rows so far, so that ``unknown_names`` is complete."""
        if self._rows:
            self._close_block()

    @staticmethod
    def join(builders: Sequence[TableBuilder]) -> FrameTable:
        """All rows of all builders, one after another.  Columns are moved out of the builders one by one, so that
        memory doesn't hold them twice; the builders can't be used afterwards.
        """
        places: dict[str, int] = {}
        for builder in builders:
            builder.close()
            new = np.array([places.setdefault(name, len(places)) for name in builder._references], np.int32)
            builder._blocks["reference"] = [new[block] for block in builder._blocks["reference"]]
        columns: dict[str, Any] = {}
        for name, column in (*_COLUMNS.items(), ("reference", _REFERENCE)):
            blocks = [block for builder in builders for block in builder._blocks.pop(name)]
            columns[name] = np.concatenate(blocks) if blocks else np.empty((0, *column.shape), column.type)
        return FrameTable(**columns, reference_ids=tuple(places))

    def _close_block(self) -> None:
        rows, self._rows = self._rows, []
        for name, column in _COLUMNS.items():
            values = np.array([column.of(row) for row in rows], column.type)
            self._blocks[name].append(values.reshape(-1, *column.shape))
        places = self._references
        self._blocks["reference"].append(
            np.array([places.setdefault(row.reference_id, len(places)) for row in rows], np.int32)
        )
        for row in rows:
            names = (row.verdict, _VERDICT_CODES), (row.state, _STATE_CODES), (row.source, _ORIGIN_CODES)
            self.unknown_names.update(str(name) for name, codes in names if name not in codes)
