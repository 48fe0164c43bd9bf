"""A disk that stops: a file system of its own is frozen or, where that isn't allowed, the writer is stopped."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

_IMAGE_BYTES = 2_000_000_000  # sparse: only what is written takes room
# It thaws and unmounts when its input ends, which it also does when the benchmark is killed: whoever writes to a
# frozen file system can't be ended before.
_GUARD = 'cat > /dev/null; fsfreeze -u "$1"; umount "$1" || umount -l "$1"'


class Disk(Protocol):
    """Where a recording goes; ``how`` says in words what a stall is."""

    directory: Path
    how: str

    def stall(self, writer_pid: int | None) -> None: ...
    def go_on(self) -> None: ...


class FrozenDisk:
    """An ext4 in a file, mounted; a stall freezes it, so that every write to it waits, uninterruptibly."""

    how = "fsfreeze of an ext4 of its own"

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._frozen = False

    def stall(self, writer_pid: int | None) -> None:
        if not self._frozen:
            subprocess.run(["fsfreeze", "-f", str(self.directory)], check=True)
            self._frozen = True

    def go_on(self) -> None:
        if self._frozen:
            subprocess.run(["fsfreeze", "-u", str(self.directory)], check=True)
            self._frozen = False


class StoppedWriter:
    """A plain folder; a stall stops the recording process."""

    how = "SIGSTOP of the recording process"

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._stopped: int | None = None

    def stall(self, writer_pid: int | None) -> None:
        if self._stopped is None and writer_pid is not None:
            os.kill(writer_pid, signal.SIGSTOP)
            self._stopped = writer_pid

    def go_on(self) -> None:
        if self._stopped is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._stopped, signal.SIGCONT)
            self._stopped = None


@contextlib.contextmanager
def disk(scratch: Path, *, may_mount: bool = True) -> Iterator[Disk]:
    """The hardest one that this machine allows; below ``scratch``, which must exist."""
    with contextlib.ExitStack() as opened:
        mounted = _mount(scratch, opened) if may_mount and os.geteuid() == 0 else None
        yield mounted or StoppedWriter(scratch)


def _mount(scratch: Path, opened: contextlib.ExitStack) -> Disk | None:
    image, directory = scratch / "disk.ext4", scratch / "disk"
    directory.mkdir()
    try:
        with image.open("wb") as file:
            file.truncate(_IMAGE_BYTES)
        for command in (["mkfs.ext4", "-q", str(image)], ["mount", "-o", "loop", str(image), str(directory)]):
            subprocess.run(command, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    guard = subprocess.Popen(
        ["sh", "-c", _GUARD, "guard", str(directory)], stdin=subprocess.PIPE, stderr=subprocess.DEVNULL,
        start_new_session=True,
    )  # fmt: skip
    opened.callback(guard.communicate)
    return FrozenDisk(directory)
