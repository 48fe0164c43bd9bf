"""Whether a JPEG file is whole, by its markers (ITU-T T.81, annex B): decoders fill what is missing with whatever they
have.
"""

from __future__ import annotations

import re

_SOI, _EOI, _SOS = b"\xff\xd8", 0xD9, 0xDA
_MARKER = re.compile(rb"\xff+([^\x00\xd0-\xd7\xff])")
"""In an entropy-coded segment: neither a stuffed 0xFF nor a restart."""


def jpeg_end(data: bytes | bytearray, start: int = 0) -> tuple[int, bool]:
    """How far a JPEG that begins at ``start`` reaches, and whether it is whole: it reaches behind its end-of-image
    marker then, else to where it breaks off.

    Walks from segment to segment, so that the end of a thumbnail inside isn't taken for it.
    """
    at = start + len(_SOI)
    if data[start:at] != _SOI:
        return start, False
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if marker == 0xFF:  # a fill byte
            at += 1
            continue
        if marker < 0xC0 or 0xD0 <= marker <= 0xD9 or length < 2:
            return at, False
        at += 2 + length
        if marker != _SOS:
            continue
        found = _MARKER.search(data, at)
        if found is None:
            return len(data), False
        at = found.end() - 2
        if data[at + 1] == _EOI:
            return at + 2, True
    return at, False


def jpeg_fault(data: bytes) -> str | None:
    """Why a JPEG can't be used; None for one that has its end.  What follows the end doesn't count."""
    return None if jpeg_end(data)[1] else "truncated or damaged: a JPEG without its end"
