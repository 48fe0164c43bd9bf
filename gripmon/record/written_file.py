"""One file while it is written: rerun encodes into memory, and the bytes go from there to the disk.

rerun's own file sink ends its thread, without a word, with the first write that fails, and whoever asks it for more
waits for ever.  Memory doesn't fail: an error of the disk is an :class:`OSError` here, with its number.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import mmap
import os
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import rerun as rr

from gripmon.record.columns import APPLICATION_ID
from gripmon.record.recorder import Scene
from gripmon.record.rows import RowWriter

_ENCODED_WITHIN_S = 60.0


rr.set_strict_mode(True)  # else rerun only warns


def open_stream(scene: Scene) -> rr.RecordingStream:
    """Of all files of a recording, one after another: rerun keeps every stream, with two threads, for good."""
    return rr.RecordingStream(APPLICATION_ID, recording_id=scene.recording_id)


class WrittenFile:
    """A file and the capture times in it.  ``writer`` takes what it holds; :meth:`flush` brings that to the disk."""

    def __init__(
        self,
        path: Path,
        stream: rr.RecordingStream,
        scene: Scene,
        number: int,
        layout: bytes,
        asking_disk: Callable[[], AbstractContextManager[None]],
    ) -> None:
        """Begins the file, with what each one needs: layout and static data.  Raises OSError, also if it exists.

        ``stream`` is of no other file until this one is closed.  ``asking_disk`` is entered for as long as the disk is
        waited for.
        """
        self.path, self.begun_s = path, time.monotonic()
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self.frames = 0
        self.bytes = 0  # on disk, whole messages
        self._freed = 0  # from the beginning of the memory
        self._asking_disk = asking_disk
        with asking_disk():
            self._disk = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
            with contextlib.suppress(OSError):  # some network file systems have no locks
                fcntl.flock(self._disk, fcntl.LOCK_EX)  # others see that it is being written
        self._memory = os.memfd_create("gripmon-rrd")
        self._stream = stream
        self._stream.set_sinks(rr.FileSink(f"/proc/self/fd/{self._memory}"))
        self._stream.send_recording_name(scene.name + (": recorded and replayed" if scene.then is not None else ""))
        self._stream.log_file_from_contents("layout.rbl", layout)
        self.writer = RowWriter(self._stream, scene, number)

    def cover(self, stamps_ns: list[int]) -> None:
        """Count frames with these capture times."""
        self.frames += len(stamps_ns)
        known_ns = [stamp_ns for stamp_ns in (self.first_ns, self.last_ns) if stamp_ns is not None]
        if stamps_ns:
            self.first_ns, self.last_ns = min(stamps_ns + known_ns), max(stamps_ns + known_ns)

    def flush(self) -> None:
        """Bring everything that was written to the disk.  Raises OSError; the file then ends with a whole message."""
        self._stream.flush(timeout_sec=_ENCODED_WITHIN_S)
        self._copy()

    def finish(self) -> None:
        """Complete the file and close it: its footer lets readers load it without scanning it.  Raises OSError."""
        self.writer.finish()
        self._stream.disconnect()
        self._copy()
        self.close()

    def close(self) -> None:
        """Close it as it is; twice does nothing more.  Raises OSError: some disks say only then that they are full."""
        if self._disk < 0:
            return
        disk, memory, self._disk, self._memory = self._disk, self._memory, -1, -1
        self._stream.disconnect()
        os.close(memory)
        with self._asking_disk():
            os.close(disk)

    def _copy(self) -> None:
        copied, end = self.bytes, os.fstat(self._memory).st_size
        with self._asking_disk():
            if os.fstat(self._disk).st_nlink == 0:
                raise FileNotFoundError(errno.ENOENT, "it was removed")
            try:
                while copied < end:
                    copied += os.sendfile(self._disk, self._memory, copied, end - copied)
            except OSError:
                os.ftruncate(self._disk, self.bytes)  # readers would reject the file because of half a message
                raise
        self.bytes = end
        whole = end - end % mmap.PAGESIZE
        if whole > self._freed:
            with mmap.mmap(self._memory, whole - self._freed, offset=self._freed) as pages:
                pages.madvise(mmap.MADV_REMOVE)
            self._freed = whole
