"""``estimates.jsonl`` as a recording without images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from gripmon.record.read.container import Block, Chunk, Span, StoreName, UnreadableFileError
from gripmon.record.read.contents import Contents, Reading

_BLOCK_BYTES = 1 << 20


class LineFile:
    """A record a line, as ``replay`` and the daemon write it."""

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

    def record_texts(self, store: StoreName, block: Block) -> list[bytes]:
        """The lines of a block."""
        texts: list[bytes] = []
        with self.path.open("rb") as file:
            for span in block:
                file.seek(span.offset)
                texts += [line for line in file.read(span.size).split(b"\n") if line.strip()]
        return texts

    def decode(self, store: StoreName, block: Block, content: Sequence[str] | None = None) -> list[Chunk]:
        """Nothing of rerun's."""
        return []


def read_lines(file: LineFile, progress: Callable[[int], None]) -> Contents:
    """All records.  Raises OSError where the file can't be read, :class:`UnreadableFileError` for one without any."""
    store = StoreName("gripmon", str(file.path.resolve()))
    reading = Reading(file, store)
    with file.path.open("rb") as lines:
        offset = 0
        while text := lines.readlines(_BLOCK_BYTES):
            size = sum(map(len, text))
            reading.take_records((Span(offset, size),), [line for line in text if line.strip()])
            offset += size
            progress(offset)
    contents = reading.contents()
    if not len(contents.frames):
        raise UnreadableFileError("holds no frame records")
    return contents
