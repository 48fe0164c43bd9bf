"""One run of one monitor, assembled from all its files: frames in order, each once, and a description of what is
missing or contradictory.
"""

from __future__ import annotations

import contextlib
import functools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from gripmon.model.images import JPEG
from gripmon.model.jpeg import jpeg_fault
from gripmon.model.records import (
    AlertRecord,
    CornerRecord,
    FrameRecord,
    Image,
    Meta,
    RecordedCommand,
    RecordedConfiguration,
    ReferenceRecord,
    StateRecord,
)
from gripmon.record import contents as entities
from gripmon.record.container import Span
from gripmon.record.contents import Contents, decoded, frame_numbers
from gripmon.record.table import FrameTable, IntArray, TableBuilder

UNKNOWN = "unknown"
_SPANS_KEPT = 16
_NUMBERED = re.compile(r"-(\d{4,9})$")
Pixels = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Picture:
    """An image with what was measured in it; positions in the distorted image, px, first pixel's centre at 0.

    ``image`` is (height, width) or (height, width, 3) BGR, uint8 or uint16.  Edge points are (n, 2); ``edges_used``
    are those that the fit used.  ``predicted_edges``: one polyline (k, 2) per visible edge; ``predicted_corners`` (c,
    2): the visible corners.  All are empty for a refused frame.
    """

    seq: int
    stamp_ns: int
    image: Image
    media_type: str
    edges_used: Pixels
    edges_refused: Pixels
    predicted_edges: tuple[Pixels, ...]
    predicted_corners: Pixels
    corners: tuple[CornerRecord, ...]


@dataclass(frozen=True, slots=True)
class Shot:
    """A recorded image as stored in the file, with the jaw opening that came with the frame.

    ``blob``: bytes of a JPEG or PNG; ``jaw_reported_m``: None if no opening was reported.
    """

    seq: int
    stamp_ns: int
    blob: bytes
    media_type: str
    jaw_reported_m: float | None


class _Row(NamedTuple):
    batch: Any
    number: int

    def scalar(self, component: str) -> Any:
        """The Arrow scalar; None if the component is missing."""
        return self.batch.column(component)[self.number] if component in self.batch.schema.names else None

    def value(self, component: str) -> Any:
        """The Python value; None if the component is missing or empty in this row."""
        found = self.scalar(component)
        return None if found is None else found.as_py()


class Recording:
    """One run of one monitor: all given files of it, joined in the order of frame numbers.

    ``frames`` has each number once.  ``meta`` is None for files that are older than it; ``robot`` and ``camera`` are
    ``unknown`` if the files don't name them.  ``alerts`` are those of the frame records and the daemon's own.
    ``faults``, one line each: what is wrong, in which file, and what was used.  Of these, ``file_faults`` concern one
    file regardless of the rest of its run, and ``gaps`` are about missing frame numbers.
    """

    def __init__(self, contents: Sequence[Contents]) -> None:
        """All parts of one recording, at least one."""
        self._parts = parts = tuple(sorted(contents, key=_place_in_run))
        faults = [f"{part.path}: {fault}" for part in parts for fault in part.faults]
        self.file_faults: tuple[str, ...] = tuple(faults)
        # If the last file of a run was begun and got no frames, nothing is lost.
        empty = [part for part in parts if not len(part.frames) and (part is not parts[-1] or len(parts) == 1)]
        faults += [f"{part.path}: holds no frames" for part in empty]
        faults += _missing_files(parts)
        self._batches = functools.lru_cache(_SPANS_KEPT)(functools.partial(_batches, parts))
        self.recording_id: str = parts[0].recording_id
        self.meta: Meta | None = next((part.meta for part in parts if part.meta is not None), None)
        self.files: tuple[Path, ...] = tuple(part.path for part in parts)
        self.references: tuple[ReferenceRecord, ...] = _events(parts, entities.REFERENCE, "revision")
        self.commands: tuple[RecordedCommand, ...] = _events(parts, entities.COMMAND, "seq")
        self.states: tuple[StateRecord, ...] = _events(parts, entities.STATE, "seq")
        self.configuration: RecordedConfiguration | None = next(
            (found for part in parts for found in part.events.get(entities.CONFIGURATION, ())), None
        )
        self.robot, self.camera = _names(parts, self.meta, self.states)
        self.alerts: tuple[AlertRecord, ...] = _alerts(parts, self.robot, self.camera)
        self.image_seqs: IntArray = np.unique(np.concatenate([part.image_seqs for part in parts]))
        # In which messages (a part's number and a span of its file) each row of ``frames`` lies.
        self._spans = [(number, span) for number, part in enumerate(parts) for span in part.record_spans]
        self.frames, self._rows_span, repeated = _frames(parts)
        faults += repeated
        self.gaps: tuple[str, ...] = self._gaps()
        self.faults: tuple[str, ...] = (*faults, *self.gaps, *self._backwards())

    def __repr__(self) -> str:
        return f"Recording({self.recording_id}: {len(self.frames)} frames, {len(self.image_seqs)} images)"

    def records(self, seqs: IntArray | None = None) -> Iterator[FrameRecord]:
        """Frame records, decoded again, in the order of their numbers; of all frames, or of ``seqs`` (ascending).

        Records of another version have the fields that this one knows; a record that can't be understood, or whose file
        can no longer be read, is skipped.
        """
        rows = np.arange(len(self.frames))
        if seqs is not None:
            rows = np.flatnonzero(np.isin(self.frames.seq, seqs))
        breaks = np.flatnonzero(np.diff(self._rows_span[rows])) + 1
        for run in np.split(rows, breaks) if len(rows) else []:
            wanted = self.frames.seq[run].tolist()
            part, span = self._spans[int(self._rows_span[run[0]])]
            found = self._records_of(part, span, set(wanted))
            yield from (found[seq] for seq in wanted if seq in found)

    def picture(self, seq: int) -> Picture | None:
        """The image of a frame with its overlay; None if there is none, it is damaged, or its file is gone."""
        shot = self.shot(seq)
        image = None if shot is None else decode_image(shot.blob)
        if shot is None or image is None:
            return None
        record = next(self.records(np.array([seq])), None)
        return Picture(
            seq=seq,
            stamp_ns=shot.stamp_ns,
            image=image,
            media_type=shot.media_type,
            edges_used=self._points(entities.EDGES_USED, seq),
            edges_refused=self._points(entities.EDGES_REFUSED, seq),
            predicted_edges=self._strips(entities.PREDICTED_EDGES, seq),
            predicted_corners=self._points(entities.PREDICTED_CORNERS, seq),
            corners=() if record is None else record.corners,
        )

    def shot(self, seq: int) -> Shot | None:
        """The recorded image of a frame; None if there is none, or its file is gone."""
        row = self._row(entities.IMAGE, seq)
        if row is None:
            return None
        stamp, kinds = row.scalar("capture_time"), row.value("EncodedImage:media_type")
        stamp_ns = 0 if stamp is None else stamp.value or 0
        return Shot(seq, stamp_ns, _blob(row), kinds[0] if kinds else "", self.jaw_reported_m(seq))

    def jaw_reported_m(self, seq: int) -> float | None:
        """The jaw opening that was reported with a frame, m; None if there was none."""
        row = self._row(entities.JAW_REPORTED, seq)
        openings_m = None if row is None else row.value("Scalars:scalars")
        return openings_m[0] if openings_m else None

    def _gaps(self) -> tuple[str, ...]:
        missing = np.diff(self.frames.seq) - 1
        places = np.flatnonzero(missing > 0)
        if not len(places):
            return ()
        largest = places[np.argmax(missing[places])]
        total, where = int(missing[places].sum()), "one place" if len(places) == 1 else f"{len(places)} places"
        most = "" if len(places) == 1 else f", most of them ({missing[largest]})"
        lost = f"{total} frames of the run are missing in {where}{most} after frame {self.frames.seq[largest]}"
        return (f"{self._file_of(largest)}: {lost}; the {len(self.frames)} that are there were used",)

    def _backwards(self) -> tuple[str, ...]:
        steps_ns = np.diff(self.frames.stamp_ns)
        places = np.flatnonzero(steps_ns < 0)
        if not len(places):
            return ()
        row = places[0] + 1
        often = "" if len(places) == 1 else f" ({len(places)} times in all)"
        back = f"time runs backwards by {-1e-9 * steps_ns[row - 1]:.3g} s at frame {self.frames.seq[row]}{often}"
        return (f"{self._file_of(row)}: {back}; frames were taken in the order of their numbers",)

    def _file_of(self, row: int) -> Path:
        return self._parts[self._spans[self._rows_span[row]][0]].path

    def _records_of(self, part: int, span: Span, wanted: set[int]) -> dict[int, FrameRecord]:
        contents = self._parts[part]
        try:
            texts = contents.source.record_texts(contents.store, span)
        except OSError:
            return {}
        found: dict[int, FrameRecord] = {}
        for text in texts:
            try:
                record, _ = decoded(text, FrameRecord)
            except ValueError:
                continue
            if record.seq in wanted:
                found.setdefault(record.seq, record)
        return found

    def _row(self, entity: str, seq: int) -> _Row | None:
        """The row of a frame in an entity, from the first file that has it."""
        for number, contents in enumerate(self._parts):
            for span in contents.places[entity].find(seq) if entity in contents.places else ():
                for batch in self._batches(number, span).get(entity, ()):
                    rows = np.flatnonzero(frame_numbers(batch) == seq)
                    if len(rows):
                        return _Row(batch, int(rows[0]))
        return None

    def _points(self, entity: str, seq: int) -> Pixels:
        row = self._row(entity, seq)
        points = None if row is None else row.value("Points2D:positions")
        return np.array(points or [], np.float32).reshape(-1, 2)

    def _strips(self, entity: str, seq: int) -> tuple[Pixels, ...]:
        row = self._row(entity, seq)
        strips = None if row is None else row.value("LineStrips2D:strips")
        return tuple(np.array(strip, np.float32).reshape(-1, 2) for strip in strips or () if strip)


def _batches(parts: Sequence[Contents], part: int, span: Span) -> dict[str, list[Any]]:
    """A message's rows by entity."""
    found: dict[str, list[Any]] = {}
    with contextlib.suppress(OSError):
        for chunk in parts[part].source.decode(parts[part].store, span, entities.ON_DEMAND):
            found.setdefault(chunk.entity, []).append(chunk.batch)
    return found


def decode_image(blob: bytes) -> Image | None:
    """The pixels of a recorded image, unchanged; None if it is damaged."""
    import cv2

    if not blob or (blob.startswith(JPEG) and jpeg_fault(blob) is not None):
        return None
    try:
        image: Image | None = cv2.imdecode(np.frombuffer(blob, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    return image


def _blob(row: _Row) -> bytes:
    value = row.scalar("EncodedImage:blob")
    if value is None or not value.is_valid or not len(value.values):
        return b""
    first = value.values[0]
    return bytes(first.values.to_numpy().tobytes()) if hasattr(first, "values") else bytes(first.as_py() or b"")


def file_number(meta: Meta | None, path: Path) -> int | None:
    """The number of a file in its run; older files have it only in their names."""
    if meta is not None:
        return meta.file_number
    found = _NUMBERED.search(path.stem)
    return int(found[1]) if found else None


def _place_in_run(part: Contents) -> tuple[int, int, str]:
    return file_number(part.meta, part.path) or 0, part.frames.first_seq, str(part.path)


def _missing_files(parts: Sequence[Contents]) -> list[str]:
    """Missing file numbers, where frames are missing there, too: files may have been merged."""
    numbered = [
        (number, part)
        for part in parts
        if (number := file_number(part.meta, part.path)) is not None and len(part.frames)
    ]
    faults = []
    before, last = 0, -1
    for number, part in numbered:
        if number > before + 1 and part.frames.first_seq > last + 1:
            which = f"number {number - 1} is" if number == before + 2 else f"numbers {before + 1} to {number - 1} are"
            faults.append(f"{part.path}: is file {number} of its run, and {which} not there; the others were used")
        before, last = number, part.frames.last_seq
    return faults


def _events(parts: Sequence[Contents], entity: str, order: str) -> tuple[Any, ...]:
    """The events of an entity, each once, in the given order."""
    found = dict.fromkeys(event for part in parts for event in part.events.get(entity, ()))
    return tuple(sorted(found, key=attrgetter(order)))


def _names(parts: Sequence[Contents], meta: Meta | None, states: Sequence[StateRecord]) -> tuple[str, str]:
    """Robot and camera."""
    if meta is not None:
        return meta.robot, meta.camera
    for event in (*states, *_events(parts, entities.ALERT, "seq")):
        return event.robot, event.camera
    return next((part.about for part in parts if part.about is not None), (UNKNOWN, UNKNOWN))


def _alerts(parts: Sequence[Contents], robot: str, camera: str) -> tuple[AlertRecord, ...]:
    """Alerts of the frame records and the daemon's own, in frame order."""
    records: dict[int, FrameRecord] = {}
    for part in parts:
        for record in part.alerting:
            records.setdefault(record.seq, record)
    found = [
        AlertRecord(
            robot=robot,
            camera=camera,
            seq=record.seq,
            stamp_ns=record.stamp_ns,
            state=record.state,
            reference_id=record.reference_id,
            revision=record.revision,
            **msgspec.structs.asdict(alert),
        )
        for record in records.values()
        for alert in record.alerts
    ]
    own = (alert for part in parts for alert in part.events.get(entities.ALERT, ()))
    return tuple(sorted(dict.fromkeys((*found, *own)), key=attrgetter("seq")))


def _frames(parts: Sequence[Contents]) -> tuple[FrameTable, IntArray, list[str]]:
    """The frames of all parts in the order of their numbers, each once (from the first file that has it); the index of
    each one's span, counted over all parts; and a description of repeated frames.
    """
    counts = [len(part.record_spans) for part in parts]
    begins = np.cumsum([0, *counts[:-1]])
    rows_span = np.concatenate([part.record_span + begin for part, begin in zip(parts, begins, strict=True)])
    table = TableBuilder.join([part.frames for part in parts])
    if np.all(np.diff(table.seq) > 0):
        return table, rows_span, []
    order = np.argsort(table.seq, kind="stable")
    again = np.concatenate([[False], np.diff(table.seq[order]) == 0])
    repeated = _repeated(parts, table, order, again, np.repeat(np.arange(len(parts)), counts)[rows_span])
    kept = order[~again]
    return table.take(kept), rows_span[kept], repeated


def _repeated(
    parts: Sequence[Contents], table: FrameTable, order: IntArray, again: NDArray[np.bool_], rows_part: IntArray
) -> list[str]:
    """``again`` (n,) marks the rows in ``order`` that have the same number as the row before."""
    twice = np.flatnonzero(again)
    first = order[np.maximum.accumulate(np.where(again, 0, np.arange(len(order))))][twice]
    second = order[twice]
    same = (table.stamp_ns[first] == table.stamp_ns[second]) & (
        (table.cam_T_grip[first] == table.cam_T_grip[second]) | np.isnan(table.cam_T_grip[first])
    ).all(axis=1)
    faults = []
    for number, part in enumerate(parts):
        mine = rows_part[second] == number
        if not mine.any():
            continue
        others = np.unique(rows_part[first[mine]])
        who = ", ".join("the same file" if o == number else parts[o].path.name for o in others)
        text = f"{part.path}: {mine.sum()} of its frames stand in {who}, too; each was used once"
        differing = second[mine & ~same]
        if len(differing):
            text += f", though {len(differing)} differ (the first is frame {table.seq[differing].min()})"
        faults.append(text)
    return faults
