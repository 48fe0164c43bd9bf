"""An ``.rrd`` file as a sequence of messages: a header of 12 bytes, then for each message its kind and length (8 bytes
each, little endian) and its body, which only rerun understands.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

MAGIC = b"RRF2"
HEADER_BYTES = 12
_MESSAGE = struct.Struct("<QQ")
_END, STORE_INFO, _CHUNK, _BLUEPRINT = range(4)
_FOOTER_MARK = b"RRF2FOOT"
_FOOTER_BYTES = 64  # the mark is within this many last bytes
_MESSAGE_LIMIT_BYTES = 1 << 31


class Message(NamedTuple):
    kind: int
    offset: int
    size: int


class Walk:
    """The whole messages of a file, also of several files put one behind the other, but for what ends each.

    ``end``: where the last whole one ends.  ``damaged``: the bytes there can't be a message; ``cut``: the file ends
    within one; ``joined``: something stands between the messages.  Raises OSError.
    """

    def __init__(self, path: Path) -> None:
        with path.open("rb") as file:
            self._descriptor = file.fileno()
            self.size = os.fstat(self._descriptor).st_size
            self.damaged = self.joined = False
            self.end = HEADER_BYTES
            self.messages: list[Message] = list(self._messages())
        self.cut = not self.damaged and self.end < self.size and not is_complete(path)

    def _messages(self) -> Iterator[Message]:
        while len(header := os.pread(self._descriptor, _MESSAGE.size, self.end)) == _MESSAGE.size:
            kind, size = _MESSAGE.unpack(header)
            size += _MESSAGE.size
            if kind > _BLUEPRINT or size > _MESSAGE_LIMIT_BYTES:
                self.damaged = True
                return
            if self.end + size > self.size:
                return
            if kind != _END:
                yield Message(kind, self.end, size)
            self.end += size
            if kind == _END:
                behind = re.search(MAGIC + b"(?!FOOT)", os.pread(self._descriptor, 2 * _FOOTER_BYTES, self.end))
                if behind is None:
                    return
                self.joined = True
                self.end += behind.start() + HEADER_BYTES


def is_complete(path: Path) -> bool:
    """Whether a recording was finished: it ends with a footer.  OSError."""
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        return _FOOTER_MARK in os.pread(file.fileno(), _FOOTER_BYTES, max(0, size - _FOOTER_BYTES))


def whole_bytes(path: Path) -> int:
    """Length of the part that consists of whole messages; the file's size if it is complete or not understood."""
    with path.open("rb") as file:
        if file.read(len(MAGIC)) == MAGIC and not is_complete(path):
            walk = Walk(path)
            return walk.size if walk.damaged else min(walk.end, walk.size)
    return path.stat().st_size
