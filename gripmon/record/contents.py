"""What one file holds of one recording: columns, events, and which frames have an image."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import msgspec

from gripmon.model.decoding import decoder_of
from gripmon.model.records import (
    OLDER,
    AlertRecord,
    FrameRecord,
    Meta,
    RecordedCommand,
    RecordedConfiguration,
    ReferenceRecord,
    StateRecord,
)
from gripmon.record.rrd import FRAME, RrdFile, Store, UnreadableFileError
from gripmon.record.table import IntArray, TableBuilder

RECORD = "record"
META, CONFIGURATION, REFERENCE = "meta", "configuration", "reference"
ALERT, COMMAND, STATE = "alert", "command", "state"
IMAGE = "rig/camera/image"
PREDICTED_EDGES = f"{IMAGE}/edges/predicted"
EDGES_USED = f"{IMAGE}/edges/used"
EDGES_REFUSED = f"{IMAGE}/edges/refused"
MEDIA_TYPE, _BLOB = "EncodedImage:media_type", "EncodedImage:blob"
JSON, SCALARS, STRIPS = "json", "Scalars:scalars", "LineStrips2D:strips"
_IMAGE_MEAN, _JAW_REPORTED = "image/mean_grey", "jaw/reported_m"
_EVENTS: dict[str, type[msgspec.Struct]] = {
    META: Meta,
    CONFIGURATION: RecordedConfiguration,
    REFERENCE: ReferenceRecord,
    COMMAND: RecordedCommand,
    STATE: StateRecord,
    ALERT: AlertRecord,
}
_AT_ONCE = (*_EVENTS, _IMAGE_MEAN, _JAW_REPORTED, PREDICTED_EDGES, RECORD)
_DECODING_ERRORS = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)
_LARGEST = 2**63
_LINES_A_STEP = 1000

_decode_record: Callable[[str | bytes], Any] = decoder_of(FrameRecord | OLDER[FrameRecord]).decode  # type: ignore


def decoded_record(text: str | bytes) -> FrameRecord:
    """A frame's record, of schema 1, too.  ValueError in one line for anything else."""
    try:
        record = _decode_record(text)
    except _DECODING_ERRORS as error:
        raise ValueError(str(error)) from None
    if max(map(abs, (record.seq, record.stamp_ns, record.revision, record.latency_ns))) >= _LARGEST:
        raise ValueError("a number of more than 64 bits")
    found: Any = record.upgraded() if isinstance(record, OLDER[FrameRecord]) else record
    return cast(FrameRecord, found)


@dataclass(frozen=True, slots=True)
class Shot:
    """A recorded image as stored in the file: bytes of a JPEG or PNG."""

    seq: int
    stamp_ns: int
    blob: bytes
    media_type: str


class Contents:
    """What a file holds of one recording.  ``alerting`` are the frame records with
    alerts; ``image_seqs`` the frames that have an image, ``overlay_seqs`` those with an outline drawn on it; ``jaw``
    the jaw opening (m) reported with a frame, by its number; ``faults``, a few words each, what is wrong.
    """

    def __init__(self, source: RrdFile | LineFile, store: Store) -> None:
        """Empty; :func:`contents_of` fills it."""
        self.source, self.store = source, store
        self.frames = TableBuilder()
        self._events: dict[str, dict[str, Any]] = {entity: {} for entity in _EVENTS}  # by their texts
        self.alerting: list[FrameRecord] = []
        self.image_seqs: set[int] = set()
        self.overlay_seqs: set[int] = set()
        self.jaw: dict[int, float] = {}
        self._not_understood: Counter[str] = Counter()
        self._examples: dict[str, str] = {}

    @property
    def path(self) -> Path:
        return self.source.path

    @property
    def meta(self) -> Meta | None:
        return next(iter(self.events(META)), None)

    def events(self, entity: str) -> Collection[Any]:
        """The decoded records of an entity, each once."""
        return self._events[entity].values()

    @property
    def recording_id(self) -> str:
        """The run's own id if the file has it, else rerun's."""
        return (self.meta.recording_id if self.meta is not None else "") or self.store.recording_id

    @property
    def is_ours(self) -> bool:
        return self.meta is not None or len(self.frames) > 0

    @property
    def is_of_spots(self) -> bool:
        """Whether it is a second camera's, whose records are of another type."""
        return self.meta is not None and self.meta.kind == "spots"

    @property
    def faults(self) -> list[str]:
        faults = [
            f"has {count} of {what} that can't be understood ({self._examples[what]:.120}); left out"
            for what, count in self._not_understood.items()
        ]
        return [*self.source.faults, *faults]

    def has(self, seqs: IntArray) -> bool:
        """Whether it may have something of one of these frames."""
        within = (self.frames.first_seq <= seqs) & (seqs <= self.frames.last_seq)
        return bool(within.any()) or not self.image_seqs.isdisjoint(seqs.tolist())

    def take(self, entity: str, batch: Any) -> None:
        """Some rows of the file."""
        if entity == RECORD:
            for text in texts_of(batch):
                self.take_record(text)
        elif entity in _EVENTS:
            for text in texts_of(batch):
                self._take_event(entity, text)
        elif entity == _JAW_REPORTED:
            for seq, values in rows_of(batch, SCALARS):
                self.jaw.setdefault(seq, values.as_py()[0])
        else:
            component, seqs = (STRIPS, self.overlay_seqs) if entity == PREDICTED_EDGES else (SCALARS, self.image_seqs)
            seqs.update(seq for seq, _ in rows_of(batch, component))

    def take_record(self, text: str | bytes) -> None:
        """The next frame's record."""
        try:
            record = decoded_record(text)
        except ValueError as error:
            self._note(RECORD, str(error))
            return
        self.frames.add(record)
        if record.alerts:
            self.alerting.append(record)

    def _take_event(self, entity: str, text: str) -> None:
        try:
            self._events[entity].setdefault(text, decoder_of(_EVENTS[entity]).decode(text))
        except _DECODING_ERRORS as error:
            self._note(entity, str(error))

    def _note(self, what: str, error: str) -> None:
        self._not_understood[what] += 1
        self._examples.setdefault(what, error)

    def again(self, seqs: IntArray, *, images: bool) -> Iterator[FrameRecord | Shot]:
        """The records of some frames again, and their images, in the order of the file."""
        if isinstance(self.source, LineFile):
            with contextlib.suppress(OSError):
                for line in self.source.lines():
                    with contextlib.suppress(ValueError):
                        yield decoded_record(line)
        for entity, batch in self.rows((RECORD, IMAGE) if images else (RECORD,), seqs):
            yield from records_of(batch) if entity == RECORD else shots_of(batch)

    def rows(
        self, entities: Collection[str], seqs: IntArray | None = None, component: str | None = None
    ) -> Iterator[tuple[str, Any]]:
        """Rows of the file again, by entity; no more if it is gone, or can't be read any more, which is a fault."""
        if not isinstance(self.source, RrdFile):
            return
        try:
            for store, entity, batch in self.source.read(entities, seqs, component):
                if store == self.store:
                    yield entity, batch
        except UnreadableFileError as error:
            self.source.faults.append(str(error))
        except OSError as error:
            self.source.faults.append(f"{error.strerror or error}; what was read before was used")


class LineFile:
    """``estimates.jsonl``, one record per line, as a recording without images."""

    def __init__(self, path: Path) -> None:
        """Raises :class:`UnreadableFileError`."""
        self.path = path
        self.faults: list[str] = []
        try:
            if path.stat().st_size == 0:
                raise UnreadableFileError("is empty")
        except OSError as error:
            raise UnreadableFileError(error.strerror or str(error)) from None

    def lines(self) -> Iterator[bytes]:
        """Those that aren't empty.  Raises OSError."""
        with self.path.open("rb") as lines:
            yield from (line for line in lines if line.strip())


def contents_of(file: RrdFile | LineFile, progress: Callable[[int], None]) -> list[Contents]:
    """All but the images, of each recording in a file.  ``progress`` is called with the number of bytes read.

    Raises OSError, :class:`UnreadableFileError`.
    """
    found: dict[Store, Contents] = {}
    if isinstance(file, RrdFile):
        for store, entity, batch in file.read(_AT_ONCE):
            if store not in found:
                found[store] = Contents(file, store)
            found[store].take(entity, batch)
        return [found.get(store) or Contents(file, store) for store in file.stores]
    contents, done = Contents(file, Store("gripmon", str(file.path.resolve()))), 0
    for number, line in enumerate(file.lines()):
        contents.take_record(line)
        done += len(line)
        if number % _LINES_A_STEP == 0:
            progress(done)
    if not len(contents.frames):
        raise UnreadableFileError("holds no frame records")
    return [contents]


def texts_of(batch: Any) -> list[str]:
    """All JSON texts; none if there is something else."""
    values: Any = batch.column(JSON) if JSON in batch.schema.names else None
    found = values.flatten().to_pylist() if hasattr(values, "flatten") else []
    return [text for text in found if isinstance(text, str)]


def records_of(batch: Any) -> Iterator[FrameRecord]:
    """Those that can be understood."""
    for text in texts_of(batch):
        with contextlib.suppress(ValueError):
            yield decoded_record(text)


def shots_of(batch: Any) -> Iterator[Shot]:
    """The images in it."""
    kinds = dict(rows_of(batch, MEDIA_TYPE))
    timed = "capture_time" in batch.schema.names
    stamps_ns = dict(rows_of(batch, "capture_time")) if timed else {}
    for seq, value in rows_of(batch, _BLOB):
        kind = kinds[seq].as_py()[0] if seq in kinds else ""
        stamp_ns = stamps_ns[seq].value if seq in stamps_ns else 0
        yield Shot(seq, stamp_ns, value.values[0].values.to_numpy().tobytes(), kind)


def rows_of(batch: Any, component: str) -> Iterator[tuple[int, Any]]:
    """Frame number and value of the rows in which a component isn't empty."""
    if FRAME in batch.schema.names and component in batch.schema.names:
        for seq, value in zip(batch.column(FRAME).to_pylist(), batch.column(component), strict=True):
            if seq is not None and value.is_valid and (not hasattr(value, "values") or len(value)):
                yield seq, value
