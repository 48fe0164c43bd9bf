"""The results of a dataset: a journal that survives a kill, the table made from it, and the report."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any, Self
from urllib.parse import quote

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from msgspec import Meta
from numpy.typing import NDArray

from gripmon import __version__
from gripmon.analyse.stretches import Stretch, mountings_of
from gripmon.model.errors import InputError
from gripmon.model.lerobot_columns import POSE_NAMES
from gripmon.model.records import Verdict
from gripmon.record.table import pose_matrices

TABLE, REPORT, _JOURNAL = "stretches", "report.html", "journal.jsonl"
_NONE = np.full(36, np.nan)
_GROUP_ROWS, _FILE_ROWS = 1000, 50_000
"""Rows in memory at a time (with pictures about 20 MB), and per file."""


class Measured(msgspec.Struct, frozen=True):
    """The result of one episode and camera: its stretches, or ``fault``: why there are none."""

    episode: str
    camera: str
    key: str
    version: str
    frames: int = 0
    own_reference: Annotated[bool, Meta(description="it was recalibrated from the episode's own images")] = False
    lens: Annotated[str, Meta(description="file or configuration: whose camera calibration")] = "configuration"
    gripper: Annotated[str | None, Meta(description="gripper file by which it was measured")] = None
    stretches: tuple[Stretch, ...] = ()
    fault: str | None = None
    pictures: Annotated[tuple[bytes, ...], Meta(description="JPEGs of the first stretch and the last")] = ()


class _Head(msgspec.Struct, frozen=True):
    journal: str
    fingerprint: str


class _Entry(msgspec.Struct, frozen=True):
    key: str
    version: str


class Journal:
    """A file with one line per measured episode; a line truncated by a kill is ignored.

    Raises :class:`InputError` if another process writes it, or if its results are from another configuration.
    """

    def __init__(self, folder: Path, fingerprint: str) -> None:
        path = folder / _JOURNAL
        self._file = path.open("a+b")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._file.close()
            raise InputError(f"{folder}: another gripmon dataset writes there; wait for it", "out") from None
        self._places: dict[str, tuple[int, str]] = {}
        end = 0
        self._file.seek(0)
        for line in self._file:
            if not line.endswith(b"\n"):
                break
            if end == 0:
                self._check(line, fingerprint, folder)
            else:
                entry = msgspec.json.decode(line, type=_Entry)
                self._places[entry.key] = end, entry.version
            end += len(line)
        self._file.truncate(end)
        if end == 0:
            self._append(_Head("gripmon.dataset/1", fingerprint))

    def _check(self, line: bytes, fingerprint: str, folder: Path) -> None:
        if msgspec.json.decode(line, type=_Head).fingerprint != fingerprint:
            self._file.close()
            wrong = "holds what another configuration, or another version of gripmon, measured"
            raise InputError(f"{folder}: {wrong}; another folder, or delete this one", "out")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._file.close()

    def __contains__(self, key: str) -> bool:
        return key in self._places

    def keep(self, versions: dict[str, str]) -> None:
        """Discard episodes whose files have changed."""
        self._places = {key: place for key, place in self._places.items() if versions.get(key) == place[1]}

    def add(self, measured: Measured) -> None:
        """Add a result, which survives a kill of the process once this has returned."""
        self._places[measured.key] = self._append(measured), measured.version

    def read(self, key: str) -> Measured:
        """The stored result of an episode."""
        self._file.seek(self._places[key][0])
        return msgspec.json.decode(self._file.readline(), type=Measured)

    def _append(self, entry: msgspec.Struct) -> int:
        self._file.seek(0, os.SEEK_END)
        begin = self._file.tell()
        self._file.write(msgspec.json.encode(entry) + b"\n")
        self._file.flush()
        return begin


class Line(msgspec.Struct, frozen=True):
    """What the report needs of a table row: one stretch of an episode, or a failed episode."""

    key: str
    episode: str
    camera: str
    number: int
    stretch: Stretch | None
    fault: str | None


@dataclass(frozen=True)
class Written:
    """The files written, and their content: ``lines`` with their ``mountings`` (-1: none)."""

    table: Path
    report: Path
    lines: tuple[Line, ...]
    mountings: NDArray[np.int64]

    @property
    def failed(self) -> int:
        """Episodes without any transform."""
        usable = {line.key for line in self.lines if line.stretch is not None and line.stretch.cam_T_grip is not None}
        return len({line.key for line in self.lines} - usable)


def write_dataset(
    journal: Journal,
    keys: Sequence[str],
    out: Path,
    level: float,
    tolerance_m: float,
    tolerance_rad: float,
) -> Written:
    """Write the table of the episodes ``keys``, in that order, replacing an earlier one; the report is written by
    :func:`gripmon.analyse.dataset_page.write_page`.
    """
    covariances: list[NDArray[np.float64]] = []
    lines = tuple(line for key in keys for line in _lines(journal.read(key), covariances))
    mountings = _mountings(lines, covariances, level, tolerance_m, tolerance_rad)
    fresh = out / f".{TABLE}"
    shutil.rmtree(fresh, ignore_errors=True)
    written = Written(out / TABLE, out / REPORT, lines, mountings)
    _write_table(Rows(journal, written), keys, fresh)
    shutil.rmtree(out / TABLE, ignore_errors=True)
    fresh.rename(out / TABLE)
    return written


def _lines(measured: Measured, covariances: list[NDArray[np.float64]]) -> list[Line]:
    """An episode's lines; covariances are appended as arrays, which need less memory for hundreds of thousands."""
    plain = measured.key, measured.episode, measured.camera
    if measured.fault is not None:
        covariances.append(_NONE)
        return [Line(*plain, 0, None, measured.fault)]
    covariances += [_NONE if s.covariance is None else np.array(s.covariance) for s in measured.stretches]
    bare = (msgspec.structs.replace(stretch, covariance=None) for stretch in measured.stretches)
    return [Line(*plain, number, stretch, None) for number, stretch in enumerate(bare)]


def _mountings(
    lines: Sequence[Line],
    covariances: Sequence[NDArray[np.float64]],
    level: float,
    tolerance_m: float,
    tolerance_rad: float,
) -> NDArray[np.int64]:
    """The mounting of each line, per camera; -1 without a valid transform."""
    out = np.full(len(lines), -1, np.int64)
    by_camera: dict[str, list[int]] = {}
    for place, line in enumerate(lines):
        if line.stretch is not None and line.stretch.verdict == Verdict.VALID.value:
            by_camera.setdefault(line.camera, []).append(place)
    for places in by_camera.values():
        stretches = [lines[place].stretch for place in places]
        poses = pose_matrices([one.cam_T_grip for one in stretches if one is not None and one.cam_T_grip is not None])
        covariance = np.stack([covariances[place] for place in places]).reshape(-1, 6, 6)
        out[places] = mountings_of(poses, covariance, level, tolerance_m, tolerance_rad)
    return out


def _field(name: str, kind: pa.DataType, text: str) -> pa.Field:
    return pa.field(name, kind, metadata={"description": text})


_F, _I, _S = pa.float64(), pa.int64(), pa.string()
_RUNS = pa.list_(pa.list_(_I))
SCHEMA = pa.schema(
    [
        _field("episode", _S, "path below the dataset; of LeRobot with # and its number"),
        _field("stretch", pa.int32(), "0, 1, … in order of time; each motion begins another"),
        _field("verdict", _S, "valid: use the transform; suspect, unknown: don't"),
        _field("mounting", pa.int32(), "what has the same number (and camera) shares a mounting; null: not known"),
        _field("start_ns", _I, "first frame's stamp (ns; of LeRobot from the episode's beginning)"),
        _field("end_ns", _I, "last frame's stamp (ns)"),
        _field("frames", pa.int32(), "in the stretch"),
        _field("measured_share", _F, "of its frames with a transform of their own, 0 to 1"),
        _field("valid_share", _F, "of its frames whose transform was valid, 0 to 1"),
        *(
            _field(f"cam_T_grip_{name}", _F, "maps gripper to camera coordinates; null: not measured")
            for name in POSE_NAMES
        ),
        _field("covariance", pa.list_(_F), "6 x 6 by rows, position (m) then rotation (rad), camera axes"),
        _field("protection_m", _F, "bound on the position error in each valid frame of the stretch; null: none"),
        _field("protection_rad", _F, "bound on the rotation error"),
        _field("integrity_risk", _F, "probability per frame that the error exceeds a bound"),
        _field("moved", pa.bool_(), "the camera moved within this episode, at once or slowly"),
        _field("crept_m", _F, "from the stretch's first half to its second, on average; null: not beyond chance"),
        _field("not_valid_ns", _RUNS, "first and last stamp of each run of frames in which it isn't valid"),
        _field("motion_ns", _I, "when the camera moved, before this stretch; null: it is the first"),
        _field("motion_earliest_ns", _I, "it had not moved by then, in 95 of 100 cases"),
        _field("motion_latest_ns", _I, "it had moved by then"),
        _field("motion_m", _F, "how far the TCP moved"),
        _field("motion_x_m", _F, "along the camera's x"),
        _field("motion_y_m", _F, "along the camera's y"),
        _field("motion_z_m", _F, "along the camera's z"),
        _field("motion_rad", _F, "its turn"),
        _field("motion_p_value", _F, "probability of as large a difference by chance"),
        _field("motion_cause", _S, "most probable cause by the alerts; unknown: none is probable enough"),
        _field("own_reference", pa.bool_(), "recalibrated from this episode; false: against the configuration's"),
        _field("lens", _S, "whose camera calibration: file or configuration"),
        _field("gripper", _S, "gripper file by which it was measured; null: none"),
        _field("reason", _S, "why there is no transform, or why frames weren't valid"),
        _field("picture", pa.binary(), "JPEG with what was measured; null: none"),
    ],
    metadata={"gripmon.schema": "gripmon.dataset/1", "gripmon.version": __version__},
)


def _row(measured: Measured, number: int, stretch: Stretch | None, mounting: int) -> dict[str, Any]:
    row: dict[str, Any] = dict.fromkeys(SCHEMA.names) | {
        "episode": measured.episode, "stretch": number, "verdict": Verdict.UNKNOWN.value, "frames": measured.frames,
        "own_reference": measured.own_reference, "lens": measured.lens, "gripper": measured.gripper,
        "reason": measured.fault, "moved": None,
    }  # fmt: skip
    if stretch is None:
        return row
    count = max(stretch.frames, 1)
    pictures = {0: 0, len(measured.stretches) - 1: len(measured.pictures) - 1}
    shown = pictures.get(number, -1)
    row |= {
        "verdict": stretch.verdict, "mounting": mounting if mounting >= 0 else None, "start_ns": stretch.start_ns,
        "end_ns": stretch.end_ns, "frames": stretch.frames, "measured_share": stretch.measured / count,
        "valid_share": stretch.valid / count, "covariance": stretch.covariance, "crept_m": stretch.crept_m,
        "not_valid_ns": stretch.not_valid_ns,
        "protection_m": stretch.protection_m, "protection_rad": stretch.protection_rad,
        "integrity_risk": stretch.integrity_risk, "reason": stretch.reasons or None, "moved": moved(measured.stretches),
        "picture": measured.pictures[shown] if 0 <= shown < len(measured.pictures) else None,
    }  # fmt: skip
    if stretch.cam_T_grip is not None:
        row |= {f"cam_T_grip_{name}": value for name, value in zip(POSE_NAMES, stretch.cam_T_grip, strict=True)}
    if (motion := stretch.motion) is not None:
        row |= {
            "motion_ns": motion.stamp_ns, "motion_earliest_ns": motion.earliest_ns,
            "motion_latest_ns": motion.latest_ns, "motion_m": motion.size_m, "motion_rad": motion.rotation_rad,
            "motion_p_value": motion.p_value, "motion_cause": motion.cause,
        }  # fmt: skip
        row |= {f"motion_{axis}_m": value for axis, value in zip("xyz", motion.shift_m, strict=True)}
    return row


def moved(stretches: Sequence[Stretch]) -> bool:
    """Whether the camera moved within an episode."""
    return len(stretches) > 1 or any(stretch.crept_m is not None for stretch in stretches)


class Rows:
    """The table's rows, made from the journal one episode at a time."""

    def __init__(self, journal: Journal, written: Written) -> None:
        self._journal = journal
        numbered = zip(written.lines, written.mountings, strict=True)
        self._mountings = {(line.key, line.number): int(number) for line, number in numbered}

    def of(self, key: str) -> tuple[Measured, list[dict[str, Any]]]:
        """An episode and its rows: one per stretch, or a single one if there are none."""
        measured = self._journal.read(key)
        stretches = measured.stretches or (None,)
        return measured, [_row(measured, n, stretch, self._mountings[key, n]) for n, stretch in enumerate(stretches)]


def _write_table(rows: Rows, keys: Sequence[str], folder: Path) -> None:
    """``camera=NAME/part-N.parquet``, in the layout of Hive; a file's rows are in the order of ``keys``."""
    waiting: dict[str, list[dict[str, Any]]] = {}
    files: dict[str, tuple[pq.ParquetWriter, int, int]] = {}

    def put(camera: str) -> None:
        some = waiting.pop(camera)
        writer, number, count = files.get(camera, (None, -1, _FILE_ROWS))
        if count >= _FILE_ROWS:
            if writer is not None:
                writer.close()
            number, count = number + 1, 0
            where = folder / f"camera={quote(camera, safe='')}"
            where.mkdir(parents=True, exist_ok=True)
            writer = pq.ParquetWriter(where / f"part-{number:05d}.parquet", SCHEMA, compression="zstd")
        writer.write_table(pa.Table.from_pylist(some, SCHEMA))
        files[camera] = writer, number, count + len(some)

    for key in keys:
        measured, made = rows.of(key)
        waiting.setdefault(measured.camera, []).extend(made)
        if len(waiting[measured.camera]) >= _GROUP_ROWS:
            put(measured.camera)
    for camera in list(waiting):
        put(camera)
    for writer, _, _ in files.values():
        writer.close()
