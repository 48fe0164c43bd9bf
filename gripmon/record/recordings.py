"""One run of one monitor, assembled from all its files: frames in order, each once, and a description of what is
missing or contradictory.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import Any

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
from gripmon.record.contents import Contents, Shot, records_of, rows_of, shots_of
from gripmon.record.table import OTHER, FrameTable, IntArray, TableBuilder

UNKNOWN = "unknown"
_POINTS = "Points2D:positions"
_DRAWN = {
    entities.EDGES_USED: _POINTS,
    entities.EDGES_REFUSED: _POINTS,
    entities.PREDICTED_EDGES: entities.STRIPS,
}
Pixels = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Picture:
    """An image with what was measured in it; positions in the distorted image, px, first pixel's centre at 0.

    ``image`` is (height, width) or (height, width, 3) BGR, uint8 or uint16.  Edge points are (n, 2); ``edges_used``
    are those that the fit used.  ``predicted_edges``: one polyline (k, 2) per visible edge.  All are empty for a
    refused frame.
    """

    seq: int
    stamp_ns: int
    image: Image
    edges_used: Pixels
    edges_refused: Pixels
    predicted_edges: tuple[Pixels, ...]
    corners: tuple[CornerRecord, ...]


@dataclass(slots=True)
class _Drawing:
    """What is shown of a frame: its image, its record, what is drawn on the image, by entity."""

    shot: Shot | None = None
    record: FrameRecord | None = None
    drawn: dict[str, list[Any]] = field(default_factory=dict)

    def points(self, entity: str) -> Pixels:
        return np.array(self.drawn.get(entity, []), np.float32).reshape(-1, 2)


class Recording:
    """One run of one monitor: all given files of it, joined in the order of frame numbers.

    ``frames`` has each number once.  ``robot`` and ``camera`` are ``unknown`` if the files don't name them.  ``alerts``
    are those of the frame records and the daemon's own.  ``image_seqs``: frames whose image was recorded;
    ``overlay_seqs``: those with an outline drawn on it.
    """

    def __init__(self, contents: Sequence[Contents]) -> None:
        """All parts of one recording, at least one."""
        self._parts = parts = tuple(sorted(contents, key=_place_in_run))
        self.recording_id: str = parts[0].recording_id
        self.meta: Meta | None = next((part.meta for part in parts if part.meta is not None), None)
        self.files: tuple[Path, ...] = tuple(part.path for part in parts)
        self.references: tuple[ReferenceRecord, ...] = _events(parts, entities.REFERENCE, "revision")
        self.commands: tuple[RecordedCommand, ...] = _events(parts, entities.COMMAND, "seq")
        self.states: tuple[StateRecord, ...] = _events(parts, entities.STATE, "seq")
        self.configuration: RecordedConfiguration | None = next(
            (found for part in parts for found in part.events(entities.CONFIGURATION)), None
        )
        named: Any = next((n for n in (self.meta, *self.states, *_events(parts, entities.ALERT, "seq")) if n), None)
        self.robot: str = UNKNOWN if named is None else named.robot
        self.camera: str = UNKNOWN if named is None else named.camera
        self.alerts: tuple[AlertRecord, ...] = _alerts(parts, self.robot, self.camera)
        self.image_seqs: IntArray = np.array(sorted(set().union(*(part.image_seqs for part in parts))), np.int64)
        self.overlay_seqs: IntArray = np.array(sorted(set().union(*(part.overlay_seqs for part in parts))), np.int64)
        # If the last file of a run was begun and got no frames, nothing is lost.
        empty = [part for part in parts if not len(part.frames) and (part is not parts[-1] or len(parts) == 1)]
        self._wrong = [f"{part.path}: holds no frames" for part in empty] + _missing_files(parts)
        self.frames, self._part_of, repeated = _frames(parts)
        self._wrong += repeated
        unknown = (self.frames.state == FrameTable.STATES.index(OTHER)) | (
            self.frames.source == FrameTable.ORIGINS.index(OTHER)
        )
        if unknown.any():
            where = self._file_of(int(np.argmax(unknown)))
            self._wrong.append(f"{where}: has frames with a state or source that this version doesn't know")
        self.gaps: tuple[str, ...] = self._gaps()
        self._drawings: dict[int, _Drawing] = {}

    def __repr__(self) -> str:
        return f"Recording({self.recording_id}: {len(self.frames)} frames, {len(self.image_seqs)} images)"

    @property
    def file_faults(self) -> tuple[str, ...]:
        """Faults of one file regardless of the rest of its run, as far as they are known yet."""
        return tuple(f"{part.path}: {fault}" for part in self._parts for fault in part.faults)

    @property
    def faults(self) -> tuple[str, ...]:
        """One line each: what is wrong, in which file, and what was used; ``gaps``, about missing frames, too."""
        return (*self.file_faults, *self._wrong, *self.gaps, *self._backwards())

    def records(self, seqs: IntArray | None = None) -> Iterator[FrameRecord]:
        """Frame records, decoded again, in the order of their numbers; of all frames, or of ``seqs`` (ascending).

        A record whose file can no longer be read is skipped.
        """
        for record, _ in self._in_order(self.frames.seq if seqs is None else seqs, {}):
            yield record

    def with_shots(
        self, seqs: IntArray, images: dict[int, int] | None = None
    ) -> Iterator[tuple[FrameRecord, Shot | None]]:
        """As :meth:`records`, each with its image, None where there is none; ``images``: :meth:`images` if it is known.
        Every file is read once, and an image that was recorded later than its frame is waited for.
        """
        yield from self._in_order(seqs, self.images() if images is None else images)

    def prepare(self, seqs: Sequence[int]) -> None:
        """Read what :meth:`picture` is to show of these frames, in one pass a file."""
        missing = [seq for seq in seqs if seq not in self._drawings]
        self._drawings |= {seq: _Drawing() for seq in missing}
        wanted = np.array(missing, np.int64)
        for part in self._parts:
            if not part.has(wanted):
                continue
            for entity, batch in part.rows((entities.RECORD, entities.IMAGE, *_DRAWN), wanted):
                self._draw(entity, batch)

    def picture(self, seq: int) -> Picture | None:
        """The image of a frame with its overlay; None if there is none, it is damaged, or its file is gone."""
        self.prepare([seq])
        drawing = self._drawings[seq]
        shot, record = drawing.shot, drawing.record
        image = None if shot is None else decode_image(shot.blob)
        if shot is None or image is None:
            return None
        strips = drawing.drawn.get(entities.PREDICTED_EDGES, [])
        return Picture(
            seq=seq,
            stamp_ns=shot.stamp_ns,
            image=image,
            edges_used=drawing.points(entities.EDGES_USED),
            edges_refused=drawing.points(entities.EDGES_REFUSED),
            predicted_edges=tuple(np.array(strip, np.float32).reshape(-1, 2) for strip in strips if strip),
            corners=() if record is None else record.corners,
        )

    def jaw_reported_m(self, seq: int) -> float | None:
        """The jaw opening that was reported with a frame, m; None if there was none."""
        return next((part.jaw[seq] for part in self._parts if seq in part.jaw), None)

    def _draw(self, entity: str, batch: Any) -> None:
        for shot in shots_of(batch) if entity == entities.IMAGE else ():
            self._drawings[shot.seq].shot = self._drawings[shot.seq].shot or shot
        for record in records_of(batch) if entity == entities.RECORD else ():
            self._drawings[record.seq].record = self._drawings[record.seq].record or record
        for seq, values in rows_of(batch, _DRAWN[entity]) if entity in _DRAWN else ():
            self._drawings[seq].drawn.setdefault(entity, values.as_py())

    def images(self) -> dict[int, int]:
        """The frames whose image can be read, and the number of the part that it is in.  Reads all images."""
        found: dict[int, int] = {}
        for number, part in enumerate(self._parts):
            for _, batch in part.rows((entities.IMAGE,), component=entities.MEDIA_TYPE):
                for seq, _ in rows_of(batch, entities.MEDIA_TYPE):
                    found.setdefault(seq, number)
        return found

    def _in_order(self, seqs: IntArray, there: dict[int, int]) -> Iterator[tuple[FrameRecord, Shot | None]]:
        """Records by number, with the images that are ``there``; what comes too early waits in memory."""
        rows = np.flatnonzero(np.isin(self.frames.seq, seqs))
        wanted = self.frames.seq[rows].tolist()
        known = set(wanted)
        again = (
            (number, each)
            for number, part in enumerate(self._parts)
            if part.has(seqs)
            for each in part.again(seqs, images=bool(there))
            if each.seq in known
        )
        records: dict[int, FrameRecord] = {}
        shots: dict[int, Shot] = {}
        reached = 0
        for seq, part_number in zip(wanted, self._part_of[rows].tolist(), strict=True):
            last = max(part_number, there.get(seq, 0))
            while reached <= last and (seq not in records or (seq in there and seq not in shots)):
                reached, each = next(again, (len(self._parts), None))
                if each is None or each.seq < seq:
                    continue
                if isinstance(each, Shot):
                    shots.setdefault(each.seq, each)
                else:
                    records.setdefault(each.seq, each)
            shot = shots.pop(seq, None)
            if seq in records:
                yield records.pop(seq), shot

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
        return self._parts[self._part_of[row]].path



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


def file_number(meta: Meta | None) -> int:
    """The number of a file in its run; 0: it has none."""
    return 0 if meta is None else meta.file_number


def _place_in_run(part: Contents) -> tuple[int, int, str]:
    return file_number(part.meta), part.frames.first_seq, str(part.path)


def _missing_files(parts: Sequence[Contents]) -> list[str]:
    """Missing file numbers, where frames are missing there, too: files may have been merged."""
    numbered = [(part.meta.file_number, part) for part in parts if part.meta is not None and len(part.frames)]
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
    found = dict.fromkeys(event for part in parts for event in part.events(entity))
    return tuple(sorted(found, key=attrgetter(order)))


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
    own = (alert for part in parts for alert in part.events(entities.ALERT))
    return tuple(sorted(dict.fromkeys((*found, *own)), key=attrgetter("seq")))


def _frames(parts: Sequence[Contents]) -> tuple[FrameTable, IntArray, list[str]]:
    """The frames of all parts in the order of their numbers, each once (from the first part that has it); the number of
    each one's part; and a description of repeated frames.
    """
    part_of = np.repeat(np.arange(len(parts)), [len(part.frames) for part in parts])
    table = TableBuilder.join([part.frames for part in parts])
    if np.all(np.diff(table.seq) > 0):
        return table, part_of, []
    order = np.argsort(table.seq, kind="stable")
    again = np.concatenate([[False], np.diff(table.seq[order]) == 0])
    repeated = _repeated(parts, table, order, again, part_of)
    kept = order[~again]
    return table.take(kept), part_of[kept], repeated


def _repeated(
    parts: Sequence[Contents], table: FrameTable, order: IntArray, again: NDArray[np.bool_], part_of: IntArray
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
        mine = part_of[second] == number
        if not mine.any():
            continue
        others = np.unique(part_of[first[mine]])
        who = ", ".join("the same file" if o == number else parts[o].path.name for o in others)
        text = f"{part.path}: {mine.sum()} of its frames stand in {who}, too; each was used once"
        differing = second[mine & ~same]
        if len(differing):
            text += f", though {len(differing)} differ (the first is frame {table.seq[differing].min()})"
        faults.append(text)
    return faults
