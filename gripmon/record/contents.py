"""What one file contains of one recording: columns, events, and the places of its images; records of other versions
as far as they are understood.
"""

from __future__ import annotations

import contextlib
import re
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any, TypeVar, cast

import msgspec
import numpy as np

from gripmon.model.records import (
    OLDER,
    AlertRecord,
    FrameRecord,
    Meta,
    Origin,
    RecordedCommand,
    RecordedConfiguration,
    ReferenceRecord,
    State,
    StateRecord,
    Verdict,
    schema_name,
)
from gripmon.record.container import (
    BLOCK_BYTES,
    FRAME,
    NO_FRAME,
    RECORD,
    Chunk,
    Message,
    RrdFile,
    Span,
    StoreName,
    UnreadableFileError,
    texts_of,
)
from gripmon.record.table import IntArray, Line, TableBuilder

META = "meta"
CONFIGURATION = "configuration"
REFERENCE = "reference"
ALERT = "alert"
COMMAND = "command"
STATE = "state"
JAW_REPORTED = "jaw/reported_m"
IMAGE = "rig/camera/image"
PREDICTED_EDGES = f"{IMAGE}/edges/predicted"
EDGES_USED = f"{IMAGE}/edges/used"
EDGES_REFUSED = f"{IMAGE}/edges/refused"
PREDICTED_CORNERS = f"{IMAGE}/corners/predicted"
ON_DEMAND = (IMAGE, PREDICTED_EDGES, EDGES_USED, EDGES_REFUSED, PREDICTED_CORNERS, JAW_REPORTED)
"""Entities of which only the places are kept, to be read on demand."""
_ABOUT, _IMAGE_MEAN = "about", "image/mean_grey"
_EVENTS: dict[str, type[msgspec.Struct]] = {
    META: Meta,
    CONFIGURATION: RecordedConfiguration,
    REFERENCE: ReferenceRecord,
    COMMAND: RecordedCommand,
    STATE: StateRecord,
    ALERT: AlertRecord,
}
_AT_ONCE = (*_EVENTS, _ABOUT, _IMAGE_MEAN, RECORD)
_TITLE = re.compile(r"^# (.+?) / (.+)$", re.MULTILINE)
_DECODING_ERRORS = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)
_T = TypeVar("_T", bound=msgspec.Struct)

# For fields that another version doesn't write: unknown.
_UNKNOWN: dict[type[msgspec.Struct], dict[str, Any]] = {
    FrameRecord: {
        "verdict": Verdict.UNKNOWN, "state": State.LOST, "source": Origin.HELD, "cam_T_grip": None, "covariance": None,
        "smoothed": None, "drift": None, "reference_id": "", "revision": -1, "rms_px": None, "jaw_opening_m": None,
        "corners": (), "alerts": (),
    },
    Meta: {
        "name": "", "recording_id": "", "robot": "unknown", "camera": "unknown", "gripper": "unknown",
        "version": "unknown", "file_number": 0, "started_ns": 0, "image_policy": "unknown", "has_truth": False,
    },
}  # fmt: skip


def decoded(text: str | bytes, kind: type[_T]) -> tuple[_T, str]:
    """A record, and in a few words what was ignored (empty if it is as this version writes it).

    Raises ValueError, in one line, for text that isn't such a record in any version.
    """
    schema = schema_name(kind)
    try:
        return msgspec.json.decode(text, type=kind), ""
    except _DECODING_ERRORS as error:
        reason = str(error)
    try:
        fields = msgspec.json.decode(text, type=dict[str, Any])
    except _DECODING_ERRORS as error:
        raise ValueError(f"isn't a {schema}: {error}") from None
    written = fields.get("schema", schema)
    if not isinstance(written, str) or written.partition("/")[0] != schema.partition("/")[0]:
        raise ValueError(f"isn't a {schema} but {written!r:.80}")
    older = OLDER.get(kind)
    earlier = older is not None and written == schema_name(older)
    fields["schema"] = written if earlier else schema
    if kind is FrameRecord and fields.get("verdict") not in set(Verdict):
        fields["verdict"] = Verdict.UNKNOWN
    try:
        if older is not None and earlier:
            with contextlib.suppress(msgspec.MsgspecError):
                return cast(_T, msgspec.convert(fields, type=older).upgraded()), ""
            return cast(_T, msgspec.convert(_UNKNOWN.get(kind, {}) | fields, type=older).upgraded()), reason
        record = msgspec.convert(_UNKNOWN.get(kind, {}) | fields, type=kind)
    except _DECODING_ERRORS as error:
        raise ValueError(f"isn't a {schema} that can be understood: {error}") from None
    return record, f"is {written}, this version reads {schema}" if written != schema else reason


class Places:
    """Where an entity's rows are: messages with the range of their frame numbers."""

    def __init__(self) -> None:
        self._spans: list[Span] = []
        self._first = array("q")
        self._last = array("q")

    def add(self, span: Span, first: int, last: int) -> None:
        self._spans.append(span)
        self._first.append(first)
        self._last.append(last)

    def find(self, seq: int) -> list[Span]:
        """The messages that may contain a frame, in file order, each once."""
        first, last = np.frombuffer(self._first, np.int64), np.frombuffer(self._last, np.int64)
        return list(dict.fromkeys(self._spans[i] for i in np.flatnonzero((first <= seq) & (seq <= last))))

    def spans(self) -> list[Span]:
        return list(dict.fromkeys(self._spans))


class Contents:
    """What one file contains of one recording.  ``record_span`` maps each row of ``frames`` to one of ``record_spans``;
    ``events`` are decoded records by entity, ``alerting`` the frame records with alerts, ``places`` where the images
    are, ``image_seqs`` the frames that have one.
    """

    def __init__(self, source: RrdFile | LineFile, store: StoreName) -> None:
        """Empty; :func:`read_contents` and :func:`read_lines` fill it."""
        self.source, self.store = source, store
        self.frames = TableBuilder()
        self.record_spans: list[Span] = []
        self.record_span: IntArray = np.empty(0, np.int64)
        self.image_seqs: IntArray = np.empty(0, np.int64)
        self.places = {entity: Places() for entity in ON_DEMAND}
        self.events: dict[str, list[Any]] = {}
        self.alerting: list[FrameRecord] = []
        self.about: tuple[str, str] | None = None
        self.faults: list[str] = []
        self._rows_span = array("q")
        self._images: list[IntArray] = []
        self._texts: dict[str, dict[str, None]] = {entity: {} for entity in _EVENTS}
        self._not_understood: Counter[str] = Counter()
        self._examples: dict[str, str] = {}
        self._schemas: set[str] = set()
        self._decode = msgspec.json.Decoder(Line).decode
        self._checked = False

    @property
    def path(self) -> Path:
        return self.source.path

    @property
    def meta(self) -> Meta | None:
        metas = self.events.get(META)
        return metas[0] if metas else None

    @property
    def recording_id(self) -> str:
        """The run's own id if the file has it, else rerun's."""
        return (self.meta.recording_id if self.meta is not None else "") or self.store.recording_id

    @property
    def is_ours(self) -> bool:
        return self.meta is not None or len(self.frames) > 0 or self.about is not None

    @property
    def is_of_spots(self) -> bool:
        """Whether it is a second camera's, whose records are of another type."""
        return self.meta is not None and self.meta.kind == "spots"

    def take_by_manifest(self, file: RrdFile, messages: Sequence[Message], progress: Callable[[int], None]) -> None:
        """Decode the messages that are read immediately, and note the places of the others."""
        by_entity: dict[str, list[Message]] = {}
        for message in messages:
            by_entity.setdefault(message.entity, []).append(message)
        for entity, places in self.places.items():
            for message in by_entity.get(entity, ()):
                if message.last >= message.first > NO_FRAME:
                    places.add(message.span, message.first, message.last)
        for entity in _AT_ONCE:
            found = sorted(by_entity.get(entity, ()), key=attrgetter("span"))
            for number, message in enumerate(found, 1):
                self._take(message.span, file.decode(self.store, message.span))
                if entity == RECORD:
                    progress(file.size * number // len(found))
        images = sum(message.rows for message in by_entity.get(IMAGE, ()) if message.first >= 0)
        if images != sum(map(len, self._images)):
            self._images.clear()  # written by another version: scan the images themselves
            for span in self.places[IMAGE].spans():
                self._take(span, file.decode(self.store, span), look_at_images=True)

    def take_everything(self, file: RrdFile, progress: Callable[[int], None]) -> None:
        """Decode the file from beginning to end, about a megabyte at a time."""
        for span in file.spans():
            self._take(span, file.decode(self.store, span), look_at_images=True, keep_places=True)
            progress(span.offset + span.size)

    def finish(self) -> Contents:
        """Decode what was collected, and note in ``faults`` what is wrong with it."""
        self.frames.close()
        self.record_span = np.array(self._rows_span, np.int64)
        if self._images:
            self.image_seqs = np.unique(np.concatenate(self._images))
        for name in sorted(self.frames.unknown_names):
            self.faults.append(f"has frames with {name!r:.60}, which this version doesn't know")
        self.events = {entity: self._understood(entity) for entity in _EVENTS}
        self.faults = [*self.source.faults, *self.faults, *self._misunderstood()]
        if self.source.damaged:
            self.faults.append(f"has {self.source.damaged} damaged messages, which were left out")
        return self

    def _take(
        self, span: Span, chunks: Sequence[Chunk], look_at_images: bool = False, keep_places: bool = False
    ) -> None:
        for chunk in chunks:
            entity = chunk.entity
            if keep_places and entity in self.places:
                seqs = frame_numbers(chunk.batch)
                if len(seqs):
                    self.places[entity].add(span, int(seqs.min()), int(seqs.max()))
            if entity == RECORD:
                self.take_records(span, texts_of(chunk.batch, "json"))
            elif entity in self._texts:
                self._texts[entity].update(dict.fromkeys(texts_of(chunk.batch, "json")))
            elif entity == _ABOUT:
                self._take_about(chunk.batch)
            elif entity == (IMAGE if look_at_images else _IMAGE_MEAN):
                component = "EncodedImage:blob" if look_at_images else "Scalars:scalars"
                self._images.append(_seqs_with(chunk.batch, component))

    def take_records(self, span: Span, texts: Iterable[str | bytes]) -> None:
        """Add frame records, in order."""
        if not self.record_spans or self.record_spans[-1] != span:
            self.record_spans.append(span)
        number = len(self.record_spans) - 1
        for text in texts:
            try:
                line = self._decode(text)
            except _DECODING_ERRORS as error:
                self._note(RECORD, str(error))
                continue
            self.frames.add(line)
            self._rows_span.append(number)
            self._schemas.add(line.schema)
            if line.alerts or not self._checked:
                self._take_whole_record(text)

    def _take_whole_record(self, text: str | bytes) -> None:
        """Compare the file's first record with what this version writes; keep records with alerts."""
        try:
            record, note = decoded(text, FrameRecord)
        except ValueError as error:
            self._note("alert of a frame", str(error))
            return
        if note and not self._checked:
            self.faults.append(f"has records of another version ({note}); what is missing counts as unknown")
        self._checked = True
        if record.alerts:
            self.alerting.append(record)

    def _take_about(self, batch: Any) -> None:
        for text in texts_of(batch, "TextDocument:text"):
            found = _TITLE.search(text)
            self.about = (found[1], found[2]) if found else self.about

    def _understood(self, entity: str) -> list[Any]:
        found = []
        for text in self._texts[entity]:
            try:
                record, note = decoded(text, _EVENTS[entity])
            except ValueError as error:
                self._note(entity, str(error))
                continue
            if note:
                self.faults.append(f"has a {entity} of another version ({note}); used as far as it is understood")
            found.append(record)
        return found

    def _note(self, what: str, error: str) -> None:
        self._not_understood[what] += 1
        self._examples.setdefault(what, error)

    def _misunderstood(self) -> list[str]:
        newer = sorted(self._schemas - {"", schema_name(FrameRecord), schema_name(OLDER[FrameRecord])})
        faults = [f"has records of {name!r:.60}: read as {schema_name(FrameRecord)}" for name in newer]
        for what, count in self._not_understood.items():
            faults.append(f"has {count} of {what} that can't be understood ({self._examples[what]:.120}); left out")
        return faults


def read_contents(file: RrdFile, store: StoreName, progress: Callable[[int], None]) -> Contents:
    """Read everything but the images.  ``progress`` is called with the number of bytes read.

    Raises OSError if the file can no longer be read.
    """
    contents = Contents(file, store)
    manifest = file.manifest(store, {*_AT_ONCE, *ON_DEMAND})
    if manifest is None:
        contents.take_everything(file, progress)
    else:
        contents.take_by_manifest(file, manifest, progress)
    return contents.finish()


def frame_numbers(batch: Any) -> IntArray:
    """(rows,) of a batch; empty if it isn't on the frame timeline, :data:`NO_FRAME` for rows that aren't."""
    if FRAME not in batch.schema.names:
        return np.empty(0, np.int64)
    return batch.column(FRAME).cast("int64").fill_null(NO_FRAME).to_numpy(zero_copy_only=False)


def _seqs_with(batch: Any, component: str) -> IntArray:
    """Frames in which a component is not empty."""
    seqs = frame_numbers(batch)
    if component not in batch.schema.names or not len(seqs):
        return np.empty(0, np.int64)
    counts = batch.column(component).value_lengths().fill_null(0).to_numpy(zero_copy_only=False)
    return seqs[(counts > 0) & (seqs > NO_FRAME)]


class LineFile:
    """``estimates.jsonl``, one record per line, as a recording without images."""

    damaged = 0

    def __init__(self, path: Path) -> None:
        """Raises :class:`UnreadableFileError`."""
        self.path = path
        self.faults: list[str] = []
        try:
            self.size = path.stat().st_size
        except OSError as error:
            raise UnreadableFileError(error.strerror or str(error)) from None
        if self.size == 0:
            raise UnreadableFileError("is empty")

    def record_texts(self, store: StoreName, span: Span) -> list[bytes]:
        """The lines there."""
        with self.path.open("rb") as file:
            file.seek(span.offset)
            return [line for line in file.read(span.size).split(b"\n") if line.strip()]

    def decode(self, store: StoreName, span: Span, content: Sequence[str] | None = None) -> list[Chunk]:
        """There are no chunks."""
        return []


def read_lines(file: LineFile, progress: Callable[[int], None]) -> Contents:
    """Read all records.  Raises OSError if the file can't be read, :class:`UnreadableFileError` if it has none."""
    store = StoreName("gripmon", str(file.path.resolve()))
    contents = Contents(file, store)
    with file.path.open("rb") as lines:
        offset = 0
        while text := lines.readlines(BLOCK_BYTES):
            size = sum(map(len, text))
            contents.take_records(Span(offset, size), [line for line in text if line.strip()])
            offset += size
            progress(offset)
    if not len(contents.frames):
        raise UnreadableFileError("holds no frame records")
    return contents.finish()
