"""Files that are there whole or not at all."""

from __future__ import annotations

import contextlib
import glob
import os
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from gripmon.model.errors import InputError


def writable_folder(path: Path, argument: str = "out") -> Path:
    """The folder, made where it is missing.  :class:`InputError` about this argument where it can't be written to."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: can't be made ({error.strerror}); a directory to write to", argument) from None
    if not os.access(path, os.W_OK | os.X_OK):
        raise InputError(f"{path}: may not be written to; a directory of your own", argument)
    return path


def write_atomically(path: Path, data: bytes) -> None:
    """A whole file at once, see :func:`opened_atomically`."""
    with opened_atomically(path) as file:
        file.write(data)


@contextlib.contextmanager
def opened_atomically(path: Path) -> Iterator[IO[bytes]]:
    """Write under another name beside ``path``, then rename: a reader sees the old file or the new one, and a fault
    leaves the old one.  When the context ends, the new one survives a power cut.  OSError if it can't be written.

    A device or a pipe is written to: a rename would put a file in its place, for every program of the machine.
    """
    if path.exists() and not path.is_file():
        with path.open("wb") as file:
            yield file
        return
    name = path.with_name(f".{path.name}-{secrets.token_hex(4)}.tmp")
    # With the mode that any new file gets: mkstemp's is narrower, and the umask can't be read without changing it.
    descriptor = os.open(name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    try:
        with os.fdopen(descriptor, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        name.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            name.unlink()
        raise
    _sync_folder(path.parent)


def remove_leftovers(path: Path) -> None:
    """Remove what processes that were killed while they wrote ``path`` have left beside it.

    Only for the one process that writes this file.  OSError if it may not be done.
    """
    for leftover in path.parent.glob(f".{glob.escape(path.name)}-*.tmp"):
        leftover.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    """The new name itself survives a power cut; file systems that can't do that for folders say so, and are let off."""
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:
        return  # a folder that may be written but not read
    try:
        with contextlib.suppress(OSError):
            os.fsync(descriptor)
    finally:
        os.close(descriptor)
