"""An ``.rrd`` file as a sequence of messages, any of which can be decoded on its own.

rerun's reader handles a file as a whole: if one message is cut off it returns nothing, without a footer it reads
everything, and damaged bytes can end the whole process (its native code panics).  So rerun only reads footers, which
have a checksum; their manifest says which message holds what.  Messages are parsed here: a file header of 12 bytes,
then for each message its kind and length (8 bytes each, little endian) and one of rerun's protobuf messages
(``rerun.log_msg.v1alpha1``), which contains an Arrow batch that Arrow itself reads and checks.  Reading one image of
an hour takes milliseconds, damage loses only what is damaged, and the file is never written to.

All private parts of rerun-sdk 0.41 that gripmon uses are at the end of this file: a later version may lack them.
"""

from __future__ import annotations

import os
import re
import struct
import warnings
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gripmon.model.errors import one_line

MAGIC = b"RRF2"
_FILE_HEADER_BYTES = 12
_MESSAGE = struct.Struct("<QQ")
_END, _STORE_INFO, _CHUNK, _BLUEPRINT = range(4)
_FOOTER_MARK = b"RRF2FOOT"
_FOOTER_BYTES = 64  # the mark is within this many last bytes
BLOCK_BYTES = 1 << 20
"""How much is read and decoded at a time, approximately."""
_MESSAGE_LIMIT_BYTES = 1 << 31
_PLAIN, _LZ4 = 1, 2
_LZ4_RATIO_LIMIT = 255
_RECORDING = 1  # a kind of store; 2 is a blueprint
NO_FRAME = int(np.iinfo(np.int64).min)
"""Used as the frame number where there is none."""
RECORD = "record"
FRAME = "frame"
"""The timeline of frame numbers."""
_RERUN_WANTED = "gripmon needs rerun-sdk>=0.41,<0.42 (pip install 'rerun-sdk>=0.41,<0.42')"


class UnreadableFileError(ValueError):
    """No part of a file can be used; the text gives the reason in a few words, without the file's name."""


class Span(NamedTuple):
    """Consecutive whole messages in a file: their offset and size in bytes."""

    offset: int
    size: int


class Chunk(NamedTuple):
    """Rows of one entity; ``batch`` is an Arrow batch with a column per timeline (none if static) and component."""

    entity: str
    batch: Any


class Message(NamedTuple):
    """A footer's entry about a message; ``first`` and ``last`` are frame numbers."""

    entity: str
    span: Span
    rows: int
    first: int
    last: int


class StoreName(NamedTuple):
    application: str
    recording_id: str


class RrdFile:
    """A file that contains the store information of at least one recording.

    ``faults`` lists what is found wrong while reading, in a few words each; ``damaged`` counts messages that could not
    be decoded.
    """

    def __init__(self, path: Path) -> None:
        """Raises :class:`UnreadableFileError`, also for errors of the file system."""
        self.path = path
        self.faults: list[str] = []
        self.damaged = 0
        try:
            with path.open("rb") as file:
                self.size = os.fstat(file.fileno()).st_size
                self._check_header(file.read(_FILE_HEADER_BYTES))
                self.has_footer = is_complete(path)
                self.stores = self._stores_of_footer() or _stores_introduced(file.fileno(), self.size)
        except OSError as error:
            raise UnreadableFileError(error.strerror or str(error)) from None
        if not self.stores:
            raise UnreadableFileError("is cut short before its recording begins")

    def manifest(self, store: StoreName, content: Collection[str]) -> list[Message] | None:
        """A store's messages of the entities ``content``, from the footer; None if it is missing or inconsistent."""
        if not self.has_footer:
            return None
        from rerun.chunk import RrdReader

        try:
            reader = RrdReader(self.path)
            entry = next(e for e in reader.recordings() if e.recording_id == store.recording_id)
            return _messages(_chunk_index(reader.store(store=entry)), content, self.size)
        except RerunChangedError as error:
            self.has_footer = False
            self.faults.append(f"its messages were read one by one: {error}")
        except Exception as error:  # noqa: BLE001 - whatever rerun raises: the messages themselves may be sound
            self._distrust_footer(error)
        return None

    def spans(self) -> Iterator[Span]:
        """All whole messages in file order, about a megabyte at a time.

        Ends at the end of the file or at the first bytes that are not a message, which is noted in ``faults``.
        """
        with self.path.open("rb") as file:
            begin = end = _FILE_HEADER_BYTES
            for kind, offset, size in _walk(file.fileno(), self.size):
                if kind is None or kind == _END or offset != end or end - begin + size > BLOCK_BYTES:
                    if end > begin:
                        yield Span(begin, end - begin)
                    begin = end = offset
                if kind is None:
                    self._note_where_it_ends(offset, damaged=size > 0)
                elif kind == _END:
                    begin = end = offset + size
                else:
                    end += size

    def record_texts(self, store: StoreName, span: Span) -> list[str]:
        """The frame records in some messages, as JSON."""
        return [text for chunk in self.decode(store, span, (RECORD,)) for text in texts_of(chunk.batch, "json")]

    def decode(self, store: StoreName, span: Span, content: Sequence[str] | None = None) -> list[Chunk]:
        """A store's chunks in some messages, only those of entities in ``content`` (None: all).

        Damaged messages are skipped and counted.  Raises OSError if the file can no longer be read.
        """
        with self.path.open("rb") as file:
            part = os.pread(file.fileno(), span.size, span.offset)
        chunks = []
        offset = 0
        while offset < len(part):
            kind, size = _MESSAGE.unpack_from(part, offset) if offset + _MESSAGE.size <= len(part) else (_END, 0)
            body = part[offset + _MESSAGE.size : offset + _MESSAGE.size + size]
            offset += _MESSAGE.size + size
            if offset > len(part) or kind not in (_CHUNK, _STORE_INFO, _BLUEPRINT):
                self.damaged += 1
                break
            try:
                chunk = _chunk(body, store, content) if kind == _CHUNK else None
            except Exception:  # noqa: BLE001 - whatever Arrow raises: this message is damaged, the others need not be
                self.damaged += 1
                continue
            if chunk is not None:
                chunks.append(chunk)
        return chunks

    def _check_header(self, header: bytes) -> None:
        if self.size == 0:
            raise UnreadableFileError("is empty")
        if header[: len(MAGIC)] != MAGIC:
            raise UnreadableFileError("is not a rerun recording, whatever its name says")
        if len(header) < _FILE_HEADER_BYTES:
            raise UnreadableFileError("is cut short within its header")
        written, ours = tuple(header[4:7]), _rerun_version()
        if written > ours:
            newer, older = (".".join(map(str, version)) for version in (written, ours))
            self.faults.append(f"was written by rerun {newer}, newer than {older} here; what is understood was used")

    def _stores_of_footer(self) -> list[StoreName]:
        """The recordings (not blueprints) that rerun finds in a file with a footer."""
        if not self.has_footer:
            return []
        from rerun.chunk import RrdReader

        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")  # a mark without a footer: rerun would scan the whole file
                found = RrdReader(self.path).recordings()
                return list(dict.fromkeys(StoreName(entry.application_id, entry.recording_id) for entry in found))
        except Exception as error:  # noqa: BLE001 - whatever rerun raises
            self._distrust_footer(error)
            return []

    def _distrust_footer(self, error: Exception) -> None:
        self.has_footer = False
        self.faults.append(f"has a footer that can't be used ({one_line(error)}); its messages were read one by one")

    def _note_where_it_ends(self, offset: int, damaged: bool) -> None:
        if damaged:
            self.faults.append(f"is damaged at byte {offset}; the {offset / 1e6:.1f} MB before it were used")
        elif offset < self.size:
            whole = f"its {offset / 1e6:.1f} MB of whole messages were used"
            self.faults.append(f"is cut short in the middle of a message at byte {self.size}; {whole}")
        else:
            self.faults.append("was not finished (no footer); all its messages were used")


def is_complete(path: Path) -> bool:
    """Whether a recording was finished: it ends with a footer.  OSError."""
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        return _FOOTER_MARK in os.pread(file.fileno(), _FOOTER_BYTES, max(0, size - _FOOTER_BYTES))


def whole_bytes(path: Path) -> int:
    """Length of the part that consists of whole messages; the file's size if it is complete or not understood."""
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        if file.read(len(MAGIC)) == MAGIC and not is_complete(path):
            for kind, offset, excess in _walk(file.fileno(), size):
                if kind is None and excess == 0:
                    return min(offset, size)
        return size


def _messages(batch: Any, content: Collection[str], file_size: int) -> list[Message]:
    """Raises ValueError if they can't belong to this file."""
    column = {name: batch.column(name) for name in batch.schema.names}

    def integers(name: str) -> list[int]:
        if name not in column:
            return [NO_FRAME] * batch.num_rows
        values: list[int] = column[name].cast("int64").fill_null(NO_FRAME).to_pylist()
        return values

    names = "chunk_byte_offset", "chunk_byte_size", "chunk_num_rows", "frame:start", "frame:end"
    found = [
        Message(path.removeprefix("/"), Span(offset - _MESSAGE.size, size + _MESSAGE.size), rows, first, last)
        for path, offset, size, rows, first, last in zip(
            column["chunk_entity_path"].to_pylist(), *map(integers, names), strict=True
        )
        if path.removeprefix("/") in content
    ]
    spans = [message.span for message in found]
    if any(s.offset < _FILE_HEADER_BYTES or s.size <= 0 or s.offset + s.size > file_size for s in spans):
        raise ValueError("it names bytes beyond the file")
    return found


def _walk(descriptor: int, file_size: int) -> Iterator[tuple[int | None, int, int]]:
    """Kind, offset and total size of every message, also in a concatenation of several files.

    Without an end message the last item is (None, offset, 0) if the file ends too early, (None, offset, 1) if the bytes
    there can't be a message.
    """
    offset = _FILE_HEADER_BYTES
    while True:
        header = os.pread(descriptor, _MESSAGE.size, offset)
        kind, size = _MESSAGE.unpack(header) if len(header) == _MESSAGE.size else (_END, file_size)
        if kind > _BLUEPRINT or size > _MESSAGE_LIMIT_BYTES:
            yield None, offset, 1
            return
        if offset + _MESSAGE.size + size > file_size:
            yield None, offset, 0
            return
        yield kind, offset, _MESSAGE.size + size
        offset += _MESSAGE.size + size
        if kind == _END:
            behind = os.pread(descriptor, 2 * _FOOTER_BYTES, offset)
            next_file = re.search(MAGIC + b"(?!FOOT)", behind)
            if next_file is None:
                return
            offset += next_file.start() + _FILE_HEADER_BYTES


def _chunk(body: bytes, store: StoreName, content: Sequence[str] | None) -> Chunk | None:
    """The chunk in a message; None if it belongs to another store or entity.  Raises if anything in it is wrong."""
    import pyarrow as pa

    fields = _fields(body)
    if _recording_id(fields[1]) != store.recording_id:
        return None
    payload = fields[5]
    if fields.get(2, _PLAIN) == _LZ4:
        if fields[3] > _LZ4_RATIO_LIMIT * len(payload) + _MESSAGE.size:
            raise ValueError("more bytes than can have been compressed into it")
        payload = pa.Codec("lz4_raw").decompress(payload, fields[3])
    reader = pa.ipc.open_stream(payload)
    entity = reader.schema.metadata[b"rerun:entity_path"].decode().removeprefix("/")
    if content is not None and entity not in content:
        return None
    batch = reader.read_next_batch()
    batch.validate(full=True)
    return Chunk(entity, batch)


def _stores_introduced(descriptor: int, size: int) -> list[StoreName]:
    """The recordings whose store information is in the file."""
    places = [(offset, length) for kind, offset, length in _walk(descriptor, size) if kind == _STORE_INFO]
    found = [_introduced(os.pread(descriptor, length, offset)[_MESSAGE.size :]) for offset, length in places]
    return list(dict.fromkeys(name for name in found if name is not None))


def _introduced(body: bytes) -> StoreName | None:
    """The recording that a message describes; None for a blueprint or a damaged message."""
    try:
        store = _fields(_fields(body)[2])[2]
        recording_id = _recording_id(store)
        application = _fields(_fields(store)[3])[1].decode()
    except (ValueError, KeyError, TypeError, AttributeError):
        return None
    return None if recording_id is None else StoreName(application, recording_id)


def _recording_id(store: bytes) -> str | None:
    """The id in a ``StoreId``; None for a blueprint."""
    found = _fields(store)
    name: str = found[2].decode()
    return name if found.get(1) == _RECORDING else None


def texts_of(batch: Any, component: str) -> list[str]:
    """All texts of a component; none if it is absent or holds something else."""
    if component not in batch.schema.names:
        return []
    values = batch.column(component)
    values = values.flatten() if hasattr(values, "flatten") else values
    return [text for text in values.to_pylist() if isinstance(text, str)]


def _fields(message: bytes) -> dict[int, Any]:
    """The part of protobuf's encoding (protobuf.dev) that is needed here: field number -> int or bytes, the first of a
    repeated field.  Raises ValueError for bytes that are not a message.
    """
    found: dict[int, Any] = {}
    offset = 0
    while offset < len(message):
        tag, offset = _varint(message, offset)
        number, kind = tag >> 3, tag & 7
        value: int | bytes
        if kind == 0:
            value, offset = _varint(message, offset)
        else:
            if kind == 2:
                size, offset = _varint(message, offset)
            elif kind in (1, 5):
                size = 8 if kind == 1 else 4
            else:
                raise ValueError(f"a field of unknown kind {kind}")
            if offset + size > len(message):
                raise ValueError("a field that is longer than its message")
            value, offset = message[offset : offset + size], offset + size
        found.setdefault(number, value)
    return found


def _varint(message: bytes, offset: int) -> tuple[int, int]:
    value = shift = 0
    while offset < len(message) and shift < 70:
        byte = message[offset]
        offset += 1
        value |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            return value, offset
    raise ValueError("a number that doesn't end")


def _rerun_version() -> tuple[int, ...]:
    import rerun as rr

    return tuple(int("".join(c for c in part if c.isdigit()) or 0) for part in rr.__version__.split(".")[:3])


class RerunChangedError(RuntimeError):
    """The installed rerun lacks something that is needed; the text names it and the version that has it."""


def _chunk_index(store: Any) -> Any:
    """The record batch of a file's footer, a row for each chunk, of a :class:`rerun.chunk.LazyStore`.

    The public ``summary`` has neither the bytes nor the frames of a chunk, without which every file is read whole.
    """
    return _private(store, "_chunk_index", "LazyStore")().to_arrow()


def free_closed_streams() -> None:
    """Release disconnected streams: rerun would keep each one, with its threads, until the process ends."""
    import rerun as rr

    _private(getattr(rr, "bindings", None), "flush_and_cleanup_orphaned_recordings", "rerun.bindings")()


def _private(owner: Any, name: str, where: str) -> Any:
    found = getattr(owner, name, None)
    if found is None:
        import rerun as rr

        raise RerunChangedError(f"rerun-sdk {rr.__version__} has no {where}.{name}; {_RERUN_WANTED}")
    return found
