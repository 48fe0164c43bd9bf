"""As much of protobuf's wire format as it takes to find a few fields (developers.google.com, Encoding)."""

from __future__ import annotations

from typing import Any

_RECORDING = 1  # of the kinds of stores; 2 is a layout


def fields(message: bytes) -> dict[int, Any]:
    """Number -> int or bytes; of a repeated field the first.  Raises ValueError for what is no message."""
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


def store_name(store: bytes) -> str | None:
    """The recording id in a ``StoreId``; None for a layout's."""
    found = fields(store)
    name = found[2].decode()
    return name if found.get(1) == _RECORDING else None


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
