"""The frames of a recording as columns: what a report, a correction and an export reckon with.

NumPy and msgspec only; JSON lines are decoded with just what the columns take.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from gripmon.model.records import FrameRecord, Origin, State, Verdict

IntArray = NDArray[np.int64]
FloatArray = NDArray[np.float64]

OTHER = "other"
"""Stands for a state or origin that a newer version may have."""
_BLOCK_ROWS = 4096
_Integer = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
_Vector = tuple[float, float, float]
_Square = Annotated[tuple[float, ...], Meta(min_length=36, max_length=36)]


class _Transform(msgspec.Struct, frozen=True, gc=False):
    translation_m: _Vector
    rotation_xyzw: tuple[float, float, float, float]


class _Smoothed(msgspec.Struct, frozen=True, gc=False):
    translation_m: _Vector
    rotation_xyzw: tuple[float, float, float, float]
    covariance: _Square


class _Drift(msgspec.Struct, frozen=True, gc=False):
    translation_m: float
    rotation_rad: float
    tcp_shift_m: _Vector


class _Protection(msgspec.Struct, frozen=True, gc=False):
    position_m: float
    rotation_rad: float
    risk: float


class _Corner(msgspec.Struct, frozen=True, gc=False):
    used: bool = False


class Line(msgspec.Struct, frozen=True, gc=False):
    """What the columns take of a :class:`FrameRecord`; what an older or newer version leaves out is unknown."""

    seq: _Integer
    stamp_ns: _Integer
    schema: str = ""
    verdict: str = Verdict.UNKNOWN.value
    state: str = OTHER
    source: str = OTHER
    cam_T_grip: _Transform | None = None
    covariance: _Square | None = None
    smoothed: _Smoothed | None = None
    drift: _Drift | None = None
    reference_id: str = ""
    revision: _Integer = -1
    rms_px: float | None = None
    jaw_opening_m: float | None = None
    corners: tuple[_Corner, ...] = ()
    alerts: tuple[msgspec.Raw, ...] = ()
    latency_ns: _Integer = -1
    reason: str | None = None
    protection: _Protection | None = None


@dataclass(frozen=True, eq=False)
class FrameTable:
    """One row a frame; NaN where a number is null, -1 where an integer is unknown.

    Codes index the tuples of names: ``VERDICTS[verdict]``, ``STATES[state]``, ``ORIGINS[source]``,
    ``reference_ids[reference]``.  A state or origin that this version doesn't know is ``other``; a verdict it doesn't
    know counts as unknown, which nothing may rely on.
    """

    VERDICTS: ClassVar[tuple[str, ...]] = tuple(v.value for v in Verdict)
    STATES: ClassVar[tuple[str, ...]] = (*(s.value for s in State), OTHER)
    ORIGINS: ClassVar[tuple[str, ...]] = (*(o.value for o in Origin), OTHER)

    seq: IntArray
    """(n,) number of the frame."""
    stamp_ns: IntArray
    """(n,) capture time, Unix ns."""
    verdict: NDArray[np.int8]
    state: NDArray[np.int8]
    source: NDArray[np.int8]
    cam_T_grip: FloatArray
    """(n, 7): x, y, z of the TCP in camera axes, m; unit quaternion x, y, z, w."""
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
    """(n,) probability a frame that the error exceeds a bound."""
    d_m: FloatArray
    """(n,) length of the camera's displacement against the reference."""
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
    """(n,) nothing was measured in this frame: its transform, if there is one, is held."""
    reference_ids: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.seq)

    @staticmethod
    def from_records(records: Iterable[FrameRecord | Line]) -> FrameTable:
        """A row a record, in their order."""
        builder = TableBuilder()
        for record in records:
            builder.add(record)
        return TableBuilder.join([builder])

    @staticmethod
    def from_jsonl(path: Path, faults: list[str] | None = None) -> FrameTable:
        """Lines as ``replay`` and the daemon write them (``estimates.jsonl``), in their order.

        A line that is no record goes to ``faults``, one line of text for all of them; without ``faults`` it raises
        ValueError.  Raises OSError when the file can't be read.
        """
        said: list[str] = [] if faults is None else faults
        before = len(said)
        table = FrameTable.from_records(_lines(path, said))
        if faults is None and len(said) > before:
            raise ValueError(said[before])
        return table

    @staticmethod
    def concatenate(tables: Sequence[FrameTable]) -> FrameTable:
        """One after the other, in the given order."""
        if len(tables) == 1:
            return tables[0]
        places: dict[str, int] = {}
        references = []
        for table in tables:
            new = [places.setdefault(name, len(places)) for name in table.reference_ids]
            references.append(np.array([*new, -1], np.int32)[table.reference])
        joined: dict[str, Any] = {
            name: np.concatenate([getattr(t, name) for t in tables]) if tables else _empty(name, shape)
            for name, shape in _COLUMNS.items()
            if name != "reference"
        }
        reference = np.concatenate(references) if references else _empty("reference", ())
        return FrameTable(**joined, reference=reference, reference_ids=tuple(places))

    def take(self, rows: NDArray[np.intp] | NDArray[np.bool_] | slice) -> FrameTable:
        """Some rows: indexes, a mask or a slice."""
        return dataclasses.replace(self, **{name: getattr(self, name)[rows] for name in _COLUMNS})

    def matrices(self, smoothed: bool = False) -> FloatArray:
        """(n, 4, 4) of ``cam_T_grip``, or of ``smoothed``; NaN where it is null."""
        pose = self.smoothed if smoothed else self.cam_T_grip
        x, y, z, w = (pose[:, 3:] / np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)).T
        out = np.zeros((len(pose), 4, 4))
        out[:, 0, :3] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], axis=1)
        out[:, 1, :3] = np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], axis=1)
        out[:, 2, :3] = np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], axis=1)
        out[:, :3, 3] = pose[:, :3]
        out[:, 3, 3] = 1.0
        return out


_COLUMNS: dict[str, tuple[int, ...]] = {
    "seq": (), "stamp_ns": (), "verdict": (), "state": (), "source": (), "cam_T_grip": (7,), "covariance": (6, 6),
    "smoothed": (7,), "smoothed_covariance": (6, 6), "protection_m": (), "protection_rad": (),
    "integrity_risk": (), "d_m": (), "delta_rad": (), "tcp_shift_m": (3,), "reference": (),
    "revision": (), "rms_px": (), "jaw_opening_m": (), "latency_ns": (), "corners_used": (), "corners_total": (),
    "refused": (),
}  # fmt: skip
"""Every column with the shape of one row."""
_TYPES: dict[str, type[np.generic]] = {
    "verdict": np.int8, "state": np.int8, "source": np.int8, "seq": np.int64, "stamp_ns": np.int64,
    "revision": np.int64, "latency_ns": np.int64, "reference": np.int32, "corners_used": np.int32,
    "corners_total": np.int32, "refused": np.bool_,
}  # fmt: skip


def _empty(name: str, shape: tuple[int, ...]) -> NDArray[Any]:
    return np.empty((0, *shape), _TYPES.get(name, np.float64))


_VERDICT_CODES = {name: code for code, name in enumerate(FrameTable.VERDICTS)}
_STATE_CODES = {name: code for code, name in enumerate(FrameTable.STATES)}
_ORIGIN_CODES = {name: code for code, name in enumerate(FrameTable.ORIGINS)}
_NAN_3 = (np.nan,) * 3
_NAN_7 = (np.nan,) * 7
_NAN_36 = (np.nan,) * 36


class TableBuilder:
    """Gathers records into columns block by block, so that no long list of objects ever stands in memory.

    ``unknown_names`` gathers verdicts, states and origins that this version doesn't know.
    """

    def __init__(self) -> None:
        self._rows: list[FrameRecord | Line] = []
        self._blocks: dict[str, list[NDArray[Any]]] = {name: [] for name in _COLUMNS}
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
        """There are no more rows for the time being: all names are known."""
        if self._rows:
            self._close_block()

    @staticmethod
    def join(builders: Sequence[TableBuilder]) -> FrameTable:
        """All rows of all, one builder's after the other's.  A builder gives its columns away one by one, so that what
        is joined doesn't stand in memory twice; afterwards it is good for nothing.
        """
        places: dict[str, int] = {}
        for builder in builders:
            builder.close()
            new = np.array([places.setdefault(name, len(places)) for name in builder._references], np.int32)
            builder._blocks["reference"] = [new[block] for block in builder._blocks["reference"]]
        columns: dict[str, Any] = {}
        for name, shape in _COLUMNS.items():
            blocks = [block for builder in builders for block in builder._blocks.pop(name)]
            columns[name] = np.concatenate(blocks) if blocks else _empty(name, shape)
        return FrameTable(**columns, reference_ids=tuple(places))

    def _close_block(self) -> None:
        rows, self._rows = self._rows, []
        poses, smoothed, drifts = [r.cam_T_grip for r in rows], [r.smoothed for r in rows], [r.drift for r in rows]
        covariances = [r.covariance or _NAN_36 for r in rows]
        smoothed_covariances = [_NAN_36 if s is None else s.covariance for s in smoothed]
        protections = [(np.nan,) * 3 if (p := r.protection) is None else msgspec.structs.astuple(p)[:3] for r in rows]
        bounds = np.array(protections, np.float64)
        places = self._references
        values: dict[str, Any] = {
            "seq": [r.seq for r in rows],
            "stamp_ns": [r.stamp_ns for r in rows],
            "verdict": [self._code(_VERDICT_CODES, r.verdict, Verdict.UNKNOWN.value) for r in rows],
            "state": [self._code(_STATE_CODES, r.state, OTHER) for r in rows],
            "source": [self._code(_ORIGIN_CODES, r.source, OTHER) for r in rows],
            "cam_T_grip": [_NAN_7 if p is None else p.translation_m + p.rotation_xyzw for p in poses],
            "covariance": np.array(covariances, np.float64).reshape(-1, 6, 6),
            "smoothed": [_NAN_7 if s is None else s.translation_m + s.rotation_xyzw for s in smoothed],
            "smoothed_covariance": np.array(smoothed_covariances, np.float64).reshape(-1, 6, 6),
            "protection_m": bounds[:, 0],
            "protection_rad": bounds[:, 1],
            "integrity_risk": bounds[:, 2],
            "d_m": [np.nan if d is None else d.translation_m for d in drifts],
            "delta_rad": [np.nan if d is None else d.rotation_rad for d in drifts],
            "tcp_shift_m": [_NAN_3 if d is None else d.tcp_shift_m for d in drifts],
            "reference": [places.setdefault(r.reference_id, len(places)) for r in rows],
            "revision": [r.revision for r in rows],
            "rms_px": [np.nan if r.rms_px is None else r.rms_px for r in rows],
            "jaw_opening_m": [np.nan if r.jaw_opening_m is None else r.jaw_opening_m for r in rows],
            "latency_ns": [r.latency_ns for r in rows],
            "corners_used": [sum([c.used for c in r.corners]) for r in rows],
            "corners_total": [len(r.corners) for r in rows],
            "refused": [r.source == Origin.HELD.value or r.cam_T_grip is None for r in rows],
        }
        for name, v in values.items():
            self._blocks[name].append(np.asarray(v, _TYPES.get(name, np.float64)))

    def _code(self, codes: dict[str, int], name: str, otherwise: str) -> int:
        code = codes.get(name)
        if code is not None:
            return code
        self.unknown_names.add(str(name))
        return codes[otherwise]


def _lines(path: Path, faults: list[str]) -> Iterator[Line]:
    decode = msgspec.json.Decoder(Line).decode
    broken, first = 0, ""
    with path.open("rb") as file:
        for number, text in enumerate(file, 1):
            if not text.strip():
                continue
            try:
                yield decode(text)
            except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
                broken += 1
                first = first or f"line {number}: {error}"
    if broken:
        faults.append(f"{path}: {broken} lines are no frame records ({first}); the others are used")
