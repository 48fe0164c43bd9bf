"""Recordings whose writer was killed in the middle of a message: readers refuse the whole file, so its end is cut off.

An .rrd file is a header of 12 bytes, then messages, each after its kind and its length (two little-endian uint64).
"""

from __future__ import annotations

import contextlib
import os
import shutil
import struct
from collections.abc import Sequence
from pathlib import Path

from gripmon.model.errors import NoResultError
from gripmon.record.write.budget import claim

_FILE_HEADER_BYTES = 12
_MESSAGE_HEADER = struct.Struct("<QQ")
_MAGIC, _FOOTER_MAGIC = b"RRF2", b"RRF2FOOT"
_TRAILER_BYTES = 32


def whole_bytes(path: Path) -> int:
    """Up to where the file consists of whole messages; its size if nothing is wrong with it, or it isn't understood."""
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(4) != _MAGIC:
            return size
        if is_complete(path):
            return size
        end = _FILE_HEADER_BYTES
        while True:
            file.seek(end)
            header = file.read(_MESSAGE_HEADER.size)
            if len(header) < _MESSAGE_HEADER.size:
                return min(end, size)
            after = end + _MESSAGE_HEADER.size + _MESSAGE_HEADER.unpack(header)[1]
            if after > size:
                return end
            end = after


def is_complete(path: Path) -> bool:
    """Whether a recording was finished: it ends with a footer.  OSError."""
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(max(size - _TRAILER_BYTES, 0))
        return _FOOTER_MAGIC in file.read(_TRAILER_BYTES)


def repair(path: Path) -> int:
    """Cut off a message that isn't whole, unless somebody is writing the file; returns the bytes cut off.  OSError."""
    lock = claim(path)
    if lock is None:
        return 0
    try:
        size, whole = path.stat().st_size, whole_bytes(path)
        if whole < size:
            about = path.stat()
            os.truncate(path, whole)
            os.utime(path, ns=(about.st_atime_ns, about.st_mtime_ns))  # its age decides when it is deleted
        return size - whole
    finally:
        os.close(lock)


def keep_whole(written: Sequence[Path], path: Path, failure: str | None, *, whole: bool = True) -> None:
    """Give a finished recording its name ``path``; what stood there before stays until then.

    One that isn't ``whole``, lacks its footer, or went into several files because writing failed in between, is
    removed: :class:`~gripmon.model.errors.NoResultError`.  ``failure`` is what the recorder reports.
    """
    reason = failure
    try:
        if whole and len(written) == 1 and is_complete(written[0]):
            written[0].replace(path)
            return
    except OSError as error:
        reason = error.strerror
    # rerun only says that its thread has ended: the room there is explains the rest.
    with contextlib.suppress(OSError):
        reason = f"{_cause(reason)}; its disk has {1e-6 * shutil.disk_usage(path.parent).free:.1f} MB free"
    for part in written:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
    raise NoResultError(f"--recording {path}: writing failed ({_cause(reason)})")


def _cause(failure: str | None) -> str:
    """The last part: before it stands a path that the user has not named."""
    return " ".join((failure or "it was not finished").rpartition(": ")[2].split())
