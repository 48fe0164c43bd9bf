"""One run of one monitor, out of all its files."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

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
from gripmon.record.read import entities
from gripmon.record.read.container import Block
from gripmon.record.read.contents import Contents, frame_numbers
from gripmon.record.read.lenient import read
from gripmon.record.read.merging import Merged, merge
from gripmon.record.read.table import FrameTable, IntArray

_BLOCKS_KEPT = 16
Pixels = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Picture:
    """An image with what was measured in it; positions in the distorted image, px, the first pixel's centre 0.

    ``image`` is (height, width) or (height, width, 3) BGR, uint8 or uint16.  Edge points are (n, 2): ``edges_used``
    those that the fit believed; ``predicted_edges`` one polyline (k, 2) a visible edge; ``predicted_corners`` (c, 2)
    those of the visible ones.  All are empty for a frame that was refused.
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
    """A recorded image as it stands in the file, and what came with the frame.

    ``blob`` are a JPEG's or PNG's bytes; ``jaw_reported_m`` is None where nobody reported an opening, ``record`` where
    it is lost.
    """

    seq: int
    stamp_ns: int
    blob: bytes
    media_type: str
    jaw_reported_m: float | None
    record: FrameRecord | None


class _Row(NamedTuple):
    batch: Any
    number: int

    def value(self, component: str) -> Any:
        """None where the component is missing or empty in this row."""
        if component not in self.batch.schema.names:
            return None
        return self.batch.column(component)[self.number]


class Recording:
    """One run of one monitor: all given files of it, put together in the order of frame numbers.

    ``frames`` has no number twice.  ``meta`` is None for files that are older than it; ``robot`` and ``camera`` are
    ``unknown`` where the files don't say.  ``alerts`` are those of the frames' records and the daemon's own.
    ``faults`` are one line each: what is wrong, in which file, and what was used; ``file_faults`` those of them that a
    file has by itself, whether the others of its run are there or not, ``gaps`` those that tell of frames whose numbers
    are missing.
    """

    def __init__(self, contents: Sequence[Contents]) -> None:
        """All parts of one recording, at least one."""
        merged: Merged = merge(contents)
        self._parts = merged.parts
        self._rows_block = merged.rows_block
        self._blocks = merged.blocks
        self._kept: OrderedDict[tuple[int, Block], dict[str, list[Any]]] = OrderedDict()
        self.recording_id: str = merged.parts[0].recording_id
        self.meta: Meta | None = merged.meta
        self.robot: str = merged.robot
        self.camera: str = merged.camera
        self.files: tuple[Path, ...] = tuple(part.path for part in merged.parts)
        self.frames: FrameTable = merged.table
        self.alerts: tuple[AlertRecord, ...] = merged.alerts
        self.references: tuple[ReferenceRecord, ...] = merged.references
        self.commands: tuple[RecordedCommand, ...] = merged.commands
        self.states: tuple[StateRecord, ...] = merged.states
        self.configuration: RecordedConfiguration | None = merged.configuration
        self.image_seqs: IntArray = merged.image_seqs
        self.faults: tuple[str, ...] = merged.faults
        self.gaps: tuple[str, ...] = merged.gaps
        self.file_faults: tuple[str, ...] = tuple(
            f"{part.path}: {said}" for part in merged.parts for said in part.faults
        )

    def __repr__(self) -> str:
        return f"Recording({self.recording_id}: {len(self.frames)} frames, {len(self.image_seqs)} images)"

    def records(self, seqs: IntArray | None = None) -> Iterator[FrameRecord]:
        """Frames' records decoded once more, in the order of their numbers; of all frames, or of ``seqs`` (rising).

        Those of another version have what this one knows; one that can't be understood, or whose file can't be read any
        more, is passed over.
        """
        rows = np.arange(len(self.frames))
        if seqs is not None:
            rows = np.flatnonzero(np.isin(self.frames.seq, seqs))
        breaks = np.flatnonzero(np.diff(self._rows_block[rows])) + 1
        for run in np.split(rows, breaks) if len(rows) else []:
            wanted = self.frames.seq[run].tolist()
            part, block = self._blocks[int(self._rows_block[run[0]])]
            found = self._records_of(part, block, set(wanted))
            yield from (found[seq] for seq in wanted if seq in found)

    def picture(self, seq: int) -> Picture | None:
        """The image of a frame with its overlay; None where there is none, it is damaged, or its file is gone."""
        found = self._row(entities.IMAGE, seq)
        image = None if found is None else _decoded(_blob(found))
        if found is None or image is None:
            return None
        record = next(self.records(np.array([seq])), None)
        return Picture(
            seq=seq,
            stamp_ns=_stamp_ns(found),
            image=image,
            media_type=_media_type(found),
            edges_used=self._points(entities.EDGES_USED, seq),
            edges_refused=self._points(entities.EDGES_REFUSED, seq),
            predicted_edges=self._strips(entities.PREDICTED_EDGES, seq),
            predicted_corners=self._points(entities.PREDICTED_CORNERS, seq),
            corners=() if record is None else record.corners,
        )

    def shots(self) -> Iterator[Shot]:
        """All recorded images in the order of their frames' numbers, none of them kept in memory."""
        records = self.records(self.image_seqs)
        record = next(records, None)
        for seq in self.image_seqs.tolist():
            while record is not None and record.seq < seq:
                record = next(records, None)
            row = self._row(entities.IMAGE, seq)
            if row is None:
                continue
            yield Shot(
                seq=seq,
                stamp_ns=_stamp_ns(row),
                blob=_blob(row),
                media_type=_media_type(row),
                jaw_reported_m=self.jaw_reported_m(seq),
                record=record if record is not None and record.seq == seq else None,
            )

    def jaw_reported_m(self, seq: int) -> float | None:
        """The opening that was reported with a frame; None where there was none."""
        row = self._row(entities.JAW_REPORTED, seq)
        value = None if row is None else row.value("Scalars:scalars")
        openings_m = None if value is None else value.as_py()
        return openings_m[0] if openings_m else None

    def _records_of(self, part: int, block: Block, wanted: set[int]) -> dict[int, FrameRecord]:
        contents = self._parts[part]
        try:
            texts = contents.source.record_texts(contents.store, block)
        except OSError:
            return {}
        found: dict[int, FrameRecord] = {}
        for text in texts:
            try:
                record, _ = read(text, FrameRecord)
            except ValueError:
                continue
            if record.seq in wanted:
                found.setdefault(record.seq, record)
        return found

    def _row(self, entity: str, seq: int) -> _Row | None:
        """The row of a frame in an entity; in the first file that has it."""
        for number, contents in enumerate(self._parts):
            for block in contents.places[entity].find(seq) if entity in contents.places else ():
                for batch in self._batches(number, block).get(entity, ()):
                    rows = np.flatnonzero(frame_numbers(batch) == seq)
                    if len(rows):
                        return _Row(batch, int(rows[0]))
        return None

    def _batches(self, part: int, block: Block) -> dict[str, list[Any]]:
        """A block's rows by entity; those that were used last are kept."""
        key = part, block
        if key not in self._kept:
            contents = self._parts[part]
            found: dict[str, list[Any]] = {}
            try:
                chunks = contents.source.decode(contents.store, block, entities.ON_DEMAND)
            except OSError:
                chunks = []
            for chunk in chunks:
                if not chunk.is_static:
                    found.setdefault(chunk.entity, []).append(chunk.batch)
            self._kept[key] = found
            if len(self._kept) > _BLOCKS_KEPT:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]

    def _points(self, entity: str, seq: int) -> Pixels:
        row = self._row(entity, seq)
        points = None if row is None else row.value("Points2D:positions")
        return np.array([] if points is None else points.as_py() or [], np.float32).reshape(-1, 2)

    def _strips(self, entity: str, seq: int) -> tuple[Pixels, ...]:
        row = self._row(entity, seq)
        strips = None if row is None else row.value("LineStrips2D:strips")
        return tuple(np.array(s, np.float32).reshape(-1, 2) for s in (strips.as_py() or ()) if s) if strips else ()


def decode_image(blob: bytes) -> Image | None:
    """A recorded image's pixels, as they were recorded; None for a damaged one."""
    return _decoded(blob)


def _decoded(blob: bytes) -> Image | None:
    import cv2

    if not blob:
        return None
    try:
        image: Image | None = cv2.imdecode(np.frombuffer(blob, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    return image


def _blob(row: _Row) -> bytes:
    value = row.value("EncodedImage:blob")
    if value is None or not value.is_valid or not len(value.values):
        return b""
    first = value.values[0]
    return bytes(first.values.to_numpy().tobytes()) if hasattr(first, "values") else bytes(first.as_py() or b"")


def _media_type(row: _Row) -> str:
    value = row.value("EncodedImage:media_type")
    texts = None if value is None else value.as_py()
    return texts[0] if texts else ""


def _stamp_ns(row: _Row) -> int:
    value = row.value("capture_time")
    return 0 if value is None or not value.is_valid else int(value.value)
