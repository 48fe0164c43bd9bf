"""Frames out of a recording, for replay through the same core.

To the bit it only is what happened where every frame's image was kept without loss (``image_every: 1``, ``image_format:
png``); float images are recorded with 8 bits.  A recording holds fewer images by default, and as JPEG: replaying it
comes close.

A frame that was refused because it was no image, or none of this camera's, has no image in the recording either.  It is
given again as what its record says of it: without image, with the same refusal in the same words.  What the watch of
the stream would have seen in such pixels (that another camera delivers them) is lost.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import msgspec

from gripmon.recording.overlay import IMAGE
from gripmon.records import (
    Frame,
    FrameRecord,
    RecordedCommand,
    RecordedConfiguration,
    ReferenceRecord,
    Refusal,
)
from gripmon.sources.base import SourceError

if TYPE_CHECKING:
    from rerun.chunk import Chunk

RECORD, REFERENCE, COMMAND, CONFIGURATION = "record", "reference", "command", "configuration"
JAW_REPORTED = "jaw/reported_m"
APPLICATION_ID = "gripmon"
_NEVER_AS_IMAGE = frozenset({Refusal.NOT_AN_IMAGE, Refusal.WRONG_TYPE, Refusal.NOT_FINITE})
"""What looks like another image, or like none, once it has been encoded with 8 bits."""
_MAY_BE_TOO_LARGE = frozenset({*_NEVER_AS_IMAGE, Refusal.WRONG_SIZE})
_T = TypeVar("_T")


class Shot(NamedTuple):
    """An encoded image as it was recorded."""

    blob: bytes
    media_type: str


class _Known(NamedTuple):
    """What is kept of each frame while the files are read for the first time."""

    stamp_ns: int
    refusal: tuple[Refusal, str] | None
    jaw_reported_m: float | None


class RecordedFrames:
    """A source of every frame of one run whose image is in these ``.rrd`` files of ours, in the order of ``seq``.

    Each with its stamp, its name and the jaw opening that was reported.  The files are read twice: at first for
    everything but images, which are decoded when their turn comes.  Raises :class:`SourceError` for a file that can't
    be read, for files of several runs, and where there is no image at all.
    """

    live = False
    connected = True
    dropped = 0

    def __init__(self, paths: Path | Sequence[Path]) -> None:
        self.paths = _in_order([paths] if isinstance(paths, Path) else list(paths))
        self.configuration: RecordedConfiguration | None = None
        self.reference: ReferenceRecord | None = None
        """The one in force when the first of these files began."""
        commands: list[RecordedCommand] = []
        self._images: set[int] = set()
        self._known: dict[int, _Known] = {}
        for path in self.paths:
            self._read(path, commands)
        self.commands = tuple(sorted(commands, key=lambda command: (command.seq, command.stamp_ns)))
        if not self._images:
            raise SourceError(f"path: {self.paths[0]} holds no images; a recording made with image_rate_hz above 0")
        # An image without a record, at the end of a recording that was cut off, was judged by nobody.
        self._seqs = sorted(seq for seq in self._known if seq in self._images or self._stands_in(seq))
        self.frames_without_image = len(self._known) - len(self._seqs)
        self.stand_ins = sum(seq not in self._images for seq in self._seqs)
        self._next = 0
        self._parts = self._read_again()
        self._shots: dict[int, Shot] = {}
        self._records: dict[int, FrameRecord] = {}
        self.shot: Shot | None = None
        """The image of the frame that was read last, as it was recorded."""
        self.record: FrameRecord | None = None
        """What was decided about that frame when it was recorded."""

    def __len__(self) -> int:
        return len(self._seqs)

    def read(self) -> Frame | None:
        """The next frame, None after the last."""
        if self._next >= len(self._seqs):
            return None
        seq = self._seqs[self._next]
        self._next += 1
        known = self._known[seq]
        while seq not in self._records or (seq in self._images and seq not in self._shots):
            self._take(next(self._parts))
        self.shot, self.record = self._shots.pop(seq, None), self._records.pop(seq)
        image, fault, refusal = None, None, Refusal.NOT_AN_IMAGE
        if self.shot is None or (known.refusal is not None and known.refusal[0] in _NEVER_AS_IMAGE):
            assert known.refusal is not None, "frames without image are refused ones"
            refusal, fault = known.refusal
        else:
            image = _decoded(self.shot)
            fault = None if image is not None else "the recorded image is damaged"
        return Frame(seq, known.stamp_ns, image, known.jaw_reported_m, self.record.name, fault, refusal)

    def close(self) -> None:
        """Nothing more is read."""
        self._next = len(self._seqs)
        self._shots.clear()
        self._records.clear()

    def _stands_in(self, seq: int) -> bool:
        """Whether a frame without image can be given again from its record alone."""
        refusal = self._known[seq].refusal
        return refusal is not None and refusal[0] in _MAY_BE_TOO_LARGE

    def _read(self, path: Path, commands: list[RecordedCommand]) -> None:
        """All but pixels."""
        jaws: dict[int, float] = {}
        stamped: dict[int, tuple[int, tuple[Refusal, str] | None]] = {}
        for entity, batch in _chunks(path, (IMAGE, RECORD, JAW_REPORTED, REFERENCE, COMMAND, CONFIGURATION)):
            if entity == CONFIGURATION:
                texts = [text for (text,) in batch.column("json").to_pylist()]
                self.configuration = self.configuration or _json(path, entity, texts[-1], RecordedConfiguration)
                continue
            if "frame" not in batch.schema.names:
                continue
            seqs = batch.column("frame").to_pylist()
            if entity == IMAGE:
                if "EncodedImage:blob" in batch.schema.names:
                    self._images.update(seqs)
            elif entity == JAW_REPORTED:
                openings = batch.column("Scalars:scalars").to_pylist()
                jaws.update((seq, some[0]) for seq, some in zip(seqs, openings, strict=True) if some)
            else:
                texts = [text for (text,) in batch.column("json").to_pylist()]
                if entity == REFERENCE:
                    self.reference = self.reference or _json(path, entity, texts[0], ReferenceRecord)
                elif entity == COMMAND:
                    commands += [_json(path, entity, text, RecordedCommand) for text in texts]
                else:
                    for record in (_json(path, entity, text, FrameRecord) for text in texts):
                        stamped[record.seq] = record.stamp_ns, _refusal_of(record)
        for seq, (stamp_ns, refusal) in stamped.items():
            self._known[seq] = _Known(stamp_ns, refusal, jaws.get(seq))

    def _read_again(self) -> Iterator[tuple[str, Any]]:
        return itertools.chain.from_iterable(_chunks(path, (IMAGE, RECORD)) for path in self.paths)

    def _take(self, part: tuple[str, Any]) -> None:
        """Images and records of a chunk, for when their turn comes."""
        entity, batch = part
        if "frame" not in batch.schema.names:
            return
        seqs = batch.column("frame").to_pylist()
        if entity == RECORD:
            for seq, (text,) in zip(seqs, batch.column("json").to_pylist(), strict=True):
                self._records[seq] = msgspec.json.decode(text, type=FrameRecord)
        elif "EncodedImage:blob" in batch.schema.names:
            blobs, kinds = batch.column("EncodedImage:blob"), batch.column("EncodedImage:media_type").to_pylist()
            for row, seq in enumerate(seqs):
                self._shots[seq] = Shot(blobs[row].values[0].values.to_numpy().tobytes(), (kinds[row] or [""])[0])


def _in_order(paths: list[Path]) -> list[Path]:
    """As they were written; one run only."""
    stores = [(_store(path), path) for path in paths]
    runs = sorted({store for store, _ in stores})
    if len(runs) > 1:
        raise SourceError(f"path: these are files of {len(runs)} runs; the files of one")
    return sorted(paths, key=lambda path: (_first_seq(path), path.name))


def _store(path: Path) -> str:
    """The id of the recording in a file."""
    reader = _reader(path)
    entries = reader.recordings()
    if not entries:
        raise SourceError(f"path: {path} holds no recording; an .rrd file of gripmon's")
    ours = [entry for entry in entries if entry.application_id == APPLICATION_ID]
    if not ours:
        raise SourceError(f"path: {path} is a recording of {entries[0].application_id!r}; one of gripmon's")
    return str(ours[0].recording_id)


def _first_seq(path: Path) -> int:
    """Of the first record; a file without any is the last."""
    for _, batch in _chunks(path, (RECORD,)):
        if "frame" in batch.schema.names:
            return min(batch.column("frame").to_pylist())
    return 2**63


def _reader(path: Path) -> Any:
    from rerun.chunk import RrdReader

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that a file has no footer, for one: its writer was killed
            return RrdReader(path)
    except Exception as error:  # whatever rerun's reader raises: the file is at fault
        raise _unreadable(path, error) from error


def _chunks(path: Path, entities: Iterable[str]) -> Iterator[tuple[str, Any]]:
    """Entity and Arrow record batch of each chunk, in the order of the file."""
    try:
        chunks: Iterable[Chunk] = _reader(path).stream().filter(content=[f"/{entity}" for entity in entities])
        for chunk in chunks:
            yield chunk.entity_path.removeprefix("/"), chunk.to_record_batch()
    except SourceError:
        raise
    except Exception as error:  # as above
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> SourceError:
    reason = " ".join(str(error).split())
    remedy = "a complete .rrd file (`rerun rrd optimize` saves what is whole in one that was cut off)"
    return SourceError(f"path: {path} can't be read ({reason}); {remedy}")


def _json(path: Path, entity: str, text: str, kind: type[_T]) -> _T:
    try:
        return msgspec.json.decode(text, type=kind)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        right = "a recording of this version of gripmon, or of an older one"
        raise SourceError(f"path: {path}: {entity} isn't understood ({error}); {right}") from None


def _refusal_of(record: FrameRecord) -> tuple[Refusal, str] | None:
    """The refusal with its words; None for a frame that was measured, or at which measuring failed."""
    kind, colon, words = (record.reason or "").partition(": ")
    if not colon or kind not in set(Refusal):
        return None
    return Refusal(kind), words


def _decoded(shot: Shot) -> Any:
    import cv2
    import numpy as np

    return cv2.imdecode(np.frombuffer(shot.blob, np.uint8), cv2.IMREAD_UNCHANGED)
