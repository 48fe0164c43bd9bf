"""One recording's share of one file: columns, events, and where its images lie."""

from __future__ import annotations

import re
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import msgspec
import numpy as np

from gripmon.model.records import (
    AlertRecord,
    FrameRecord,
    Meta,
    RecordedCommand,
    RecordedConfiguration,
    ReferenceRecord,
    StateRecord,
    schema_name,
)
from gripmon.record.read import entities
from gripmon.record.read.container import FRAME, Block, Chunk, Manifest, RrdFile, Span, StoreName, texts_of
from gripmon.record.read.lenient import DECODING_ERRORS, read
from gripmon.record.read.table import IntArray, Line, TableBuilder

_BLOCK_BYTES = 1 << 20
_ABOUT = re.compile(r"^# (.+?) / (.+)$", re.MULTILINE)
_EVENTS: dict[str, type[msgspec.Struct]] = {
    entities.META: Meta,
    entities.CONFIGURATION: RecordedConfiguration,
    entities.REFERENCE: ReferenceRecord,
    entities.COMMAND: RecordedCommand,
    entities.STATE: StateRecord,
    entities.ALERT: AlertRecord,
}


class Source(Protocol):
    """A file that records can be read from once more."""

    path: Path
    faults: list[str]
    damaged: int

    def record_texts(self, store: StoreName, block: Block) -> list[str] | list[bytes]: ...
    def decode(self, store: StoreName, block: Block, content: Sequence[str] | None = None) -> list[Chunk]: ...


class Places:
    """Where an entity's rows lie: blocks with the range of their frames' numbers."""

    def __init__(self) -> None:
        self._blocks: list[Block] = []
        self._first = array("q")
        self._last = array("q")

    def add(self, block: Block, first: int, last: int) -> None:
        self._blocks.append(block)
        self._first.append(first)
        self._last.append(last)

    def find(self, seq: int) -> list[Block]:
        """Blocks that may hold a frame, in the order of the file, none twice."""
        first, last = np.frombuffer(self._first, np.int64), np.frombuffer(self._last, np.int64)
        return list(dict.fromkeys(self._blocks[i] for i in np.flatnonzero((first <= seq) & (seq <= last))))

    def blocks(self) -> list[Block]:
        return list(dict.fromkeys(self._blocks))


@dataclass
class Contents:
    """What one file holds of one recording.  ``record_block`` (n,) says of each row of ``frames`` in which of
    ``record_blocks`` it lies; ``events`` are decoded records by entity, ``alerting`` the frames' records with alerts.
    """

    source: Source
    store: StoreName
    frames: TableBuilder
    record_blocks: list[Block] = field(default_factory=list)
    record_block: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    image_seqs: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    places: dict[str, Places] = field(default_factory=dict)
    events: dict[str, list[Any]] = field(default_factory=dict)
    alerting: list[FrameRecord] = field(default_factory=list)
    about: tuple[str, str] | None = None
    faults: list[str] = field(default_factory=list)

    @property
    def path(self) -> Path:
        return self.source.path

    @property
    def meta(self) -> Meta | None:
        metas = self.events.get(entities.META)
        return metas[0] if metas else None

    @property
    def recording_id(self) -> str:
        """The run's own where it says so, else rerun's."""
        return (self.meta.recording_id if self.meta is not None else "") or self.store.recording_id

    @property
    def is_ours(self) -> bool:
        return self.meta is not None or len(self.frames) > 0 or self.about is not None

    @property
    def is_of_spots(self) -> bool:
        """Is it a second camera's?  Its records are of another kind."""
        return self.meta is not None and self.meta.kind == "spots"


def read_contents(file: RrdFile, store: StoreName, progress: Callable[[int], None]) -> Contents:
    """Everything but the images.  ``progress`` is called with the bytes that are behind.

    Raises OSError where the file can't be read any more.
    """
    reading = Reading(file, store)
    manifest = file.manifest(store)
    if manifest is None:
        reading.everything(file, progress)
    else:
        reading.by_manifest(file, manifest, progress)
    return reading.contents()


class Reading:
    """Gathers a file's share of a recording."""

    def __init__(self, source: Source, store: StoreName) -> None:
        self._source = source
        self._store = store
        self._builder = TableBuilder()
        self._record_blocks: list[Block] = []
        self._record_block = array("q")
        self._image_seqs: list[IntArray] = []
        self._places = {entity: Places() for entity in entities.ON_DEMAND}
        self._texts: dict[str, dict[str, None]] = {entity: {} for entity in _EVENTS}
        self._alerting: list[FrameRecord] = []
        self._about: tuple[str, str] | None = None
        self._not_understood: Counter[str] = Counter()
        self._examples: dict[str, str] = {}
        self._schemas: set[str] = set()
        self._decode = msgspec.json.Decoder(Line).decode
        self._checked = False
        self._notes: list[str] = []

    def by_manifest(self, file: RrdFile, manifest: Manifest, progress: Callable[[int], None]) -> None:
        """Only the blocks of what is read at once; of the others their places."""
        at: dict[str, list[int]] = {}
        for i, entity in enumerate(manifest.entity):
            at.setdefault(entity, []).append(i)
        for entity, places in self._places.items():
            for i in at.get(entity, ()):
                place = (Span(int(manifest.offset[i]), int(manifest.size[i])),)
                if manifest.last[i] >= manifest.first[i] > np.iinfo(np.int64).min:
                    places.add(place, int(manifest.first[i]), int(manifest.last[i]))
        for entity in entities.READ:
            blocks = _gathered(manifest, at.get(entity, ()))
            for number, block in enumerate(blocks):
                self._take(block, file.decode(self._store, block))
                if entity == entities.RECORD:
                    progress(file.size * (number + 1) // len(blocks))
        images = sum(int(manifest.rows[i]) for i in at.get(entities.IMAGE, ()) if manifest.first[i] >= 0)
        if images != sum(map(len, self._image_seqs)):
            self._image_seqs.clear()  # written by another version: look at the images themselves
            for block in self._places[entities.IMAGE].blocks():
                self._take(block, file.decode(self._store, block), look_at_images=True)

    def everything(self, file: RrdFile, progress: Callable[[int], None]) -> None:
        """Block by block, as the file stands."""
        for span in file.blocks():
            block = (span,)
            self._take(block, file.decode(self._store, block), look_at_images=True, keep_places=True)
            progress(span.offset + span.size)

    def contents(self) -> Contents:
        """What was gathered."""
        self._builder.close()
        for name in sorted(self._builder.unknown_names):
            self._notes.append(f"has frames with {name!r:.60}, which this version doesn't know")
        events = {entity: self._understood(entity) for entity in _EVENTS}
        faults = [*self._source.faults, *self._notes, *self._said()]
        if self._source.damaged:
            faults.append(f"has {self._source.damaged} damaged messages, which were left out")
        seqs = np.unique(np.concatenate(self._image_seqs)) if self._image_seqs else np.empty(0, np.int64)
        return Contents(
            source=self._source,
            store=self._store,
            frames=self._builder,
            record_blocks=self._record_blocks,
            record_block=np.array(self._record_block, np.int64),
            image_seqs=seqs,
            places=self._places,
            events=events,
            alerting=self._alerting,
            about=self._about,
            faults=faults,
        )

    def _take(
        self, block: Block, chunks: Sequence[Chunk], look_at_images: bool = False, keep_places: bool = False
    ) -> None:
        for chunk in chunks:
            entity = chunk.entity
            if keep_places and entity in self._places:
                seqs = frame_numbers(chunk.batch)
                if len(seqs):
                    self._places[entity].add(block, int(seqs.min()), int(seqs.max()))
            if entity == entities.RECORD:
                self.take_records(block, texts_of(chunk.batch, "json"))
            elif entity in self._texts:
                self._texts[entity].update(dict.fromkeys(texts_of(chunk.batch, "json")))
            elif entity == entities.ABOUT:
                self._take_about(chunk.batch)
            elif entity == (entities.IMAGE if look_at_images else entities.IMAGE_MEAN):
                component = "EncodedImage:blob" if look_at_images else "Scalars:scalars"
                self._image_seqs.append(_seqs_with(chunk.batch, component))

    def take_records(self, block: Block, texts: Iterable[str | bytes]) -> None:
        """Frames' records, in order."""
        if not self._record_blocks or self._record_blocks[-1] != block:
            self._record_blocks.append(block)
        number = len(self._record_blocks) - 1
        for text in texts:
            try:
                line = self._decode(text)
            except DECODING_ERRORS as error:
                self._note(entities.RECORD, str(error))
                continue
            self._builder.add(line)
            self._record_block.append(number)
            self._schemas.add(line.schema)
            if line.alerts or not self._checked:
                self._take_whole_record(text)

    def _take_whole_record(self, text: str | bytes) -> None:
        """The file's first record is compared with what this version writes; those with alerts are kept."""
        try:
            record, note = read(text, FrameRecord)
        except ValueError as error:
            self._note("alert of a frame", str(error))
            return
        if note and not self._checked:
            self._notes.append(f"has records of another version ({note}); what is missing counts as unknown")
        self._checked = True
        if record.alerts:
            self._alerting.append(record)

    def _take_about(self, batch: Any) -> None:
        for text in texts_of(batch, "TextDocument:text"):
            found = _ABOUT.search(text)
            self._about = (found[1], found[2]) if found else self._about

    def _understood(self, entity: str) -> list[Any]:
        found = []
        for text in self._texts[entity]:
            try:
                record, note = read(text, _EVENTS[entity])
            except ValueError as error:
                self._note(entity, str(error))
                continue
            if note:
                self._notes.append(f"has a {entity} of another version ({note}); used as far as it is understood")
            found.append(record)
        return found

    def _note(self, what: str, error: str) -> None:
        self._not_understood[what] += 1
        self._examples.setdefault(what, error)

    def _said(self) -> list[str]:
        newer = sorted(self._schemas - {"", schema_name(FrameRecord)})
        said = [f"has records of {name!r:.60}: read as {schema_name(FrameRecord)}" for name in newer]
        for what, count in self._not_understood.items():
            said.append(f"has {count} of {what} that can't be understood ({self._examples[what]:.120}); left out")
        return said


def _gathered(manifest: Manifest, messages: Sequence[int]) -> list[Block]:
    """Messages in the order of the file, about a megabyte at a time."""
    blocks: list[Block] = []
    spans: list[Span] = []
    size = 0
    for i in sorted(messages, key=lambda i: int(manifest.offset[i])):
        span = Span(int(manifest.offset[i]), int(manifest.size[i]))
        if spans and size + span.size > _BLOCK_BYTES:
            blocks.append(tuple(spans))
            spans, size = [], 0
        spans.append(span)
        size += span.size
    return [*blocks, tuple(spans)] if spans else blocks


def frame_numbers(batch: Any) -> IntArray:
    """(rows,) of a batch; empty where it isn't on the timeline of frames, the least number where a row isn't."""
    if FRAME not in batch.schema.names:
        return np.empty(0, np.int64)
    return batch.column(FRAME).cast("int64").fill_null(np.iinfo(np.int64).min).to_numpy(zero_copy_only=False)


def _seqs_with(batch: Any, component: str) -> IntArray:
    """Frames in which a component holds something."""
    seqs = frame_numbers(batch)
    if component not in batch.schema.names or not len(seqs):
        return np.empty(0, np.int64)
    counts = batch.column(component).value_lengths().fill_null(0).to_numpy(zero_copy_only=False)
    return seqs[(counts > 0) & (seqs > np.iinfo(np.int64).min)]
