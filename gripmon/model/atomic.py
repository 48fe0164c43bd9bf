"""Atomic file writes: a file is there completely or not at all."""

from __future__ import annotations

import contextlib
import glob
import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from gripmon.model.errors import InputError


def writable_folder(path: Path, argument: str = "out") -> Path:
    """Return the folder, created if missing.  Raises :class:`InputError` about ``argument`` if it isn't writable."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: can't be made ({error.strerror}); a directory to write to", argument) from None
    if not os.access(path, os.W_OK | os.X_OK):
        raise InputError(f"{path}: may not be written to; a directory of your own", argument)
    return path


@contextlib.contextmanager
def writing(file: object, argument: str = "") -> Iterator[None]:
    """Turn a fault of a file that is written into :class:`InputError`, about ``argument`` if that is given."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{file}: can't be written ({error.strerror or error}); a file", argument) from None


def write_atomically(path: Path, data: bytes) -> None:
    """Write a whole file at once, see :func:`opened_atomically`."""
    with opened_atomically(path) as file:
        file.write(data)


@contextlib.contextmanager
def opened_atomically(path: Path) -> Iterator[IO[bytes]]:
    """Write to a temporary file beside ``path``, then rename it: a reader sees either the old or the new file, and a
    failure leaves the old one.  Once the context ends, the new file survives a power cut.  OSError if it can't be
    written.

    A device or a pipe is written to directly: a rename would replace it with a file, for every program on the machine.
    """
    if path.exists() and not path.is_file():
        with path.open("wb") as file:
            yield file
        return
    name = path.with_name(f".{path.name}-{os.urandom(4).hex()}.tmp")
    # Use the mode of any new file: mkstemp's is narrower, and the umask can't be read without changing it.
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
    """Remove temporary files left beside ``path`` by processes that were killed while writing it.

    Only for the one process that writes this file.  OSError if a file can't be removed.
    """
    for leftover in path.parent.glob(f".{glob.escape(path.name)}-*.tmp"):
        leftover.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    """Make the rename itself survive a power cut; an error from file systems that can't sync a folder is ignored."""
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:
        return  # a folder that can be written but not read
    try:
        with contextlib.suppress(OSError):
            os.fsync(descriptor)
    finally:
        os.close(descriptor)
