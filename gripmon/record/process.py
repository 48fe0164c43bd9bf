"""The daemon's handle on the recording process: start, pipe, shared images, status reports, health, end."""

from __future__ import annotations

import mmap
import os
import select
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Limits
from gripmon.record.recorder import ImageNote, Scene, Status

# The working directory must not be searched for modules (-P), but where this package came from must.
_BOOTSTRAP = (
    "import sys; home = sys.argv[1]; home in sys.path or sys.path.insert(0, home); "
    "from gripmon.record.worker import main; main(int(sys.argv[2]), int(sys.argv[3]))"
)
_HOME = str(Path(__file__).resolve().parents[2])
_LENGTH_BYTES = 4  # of a message, before it
_PIPE_WAIT_S = 0.01  # for a batch larger than the pipe's buffer
_KILL_WAIT_S = 0.5  # a process blocked by the disk dies when the disk answers, perhaps never
_EXIT_WAIT_S = 0.2  # between a process's last descriptor and its exit code
_PIXEL_TYPES = frozenset({"|u1", "<u2", "<f4"})

SILENT_AFTER_S = 5.0
_START_TAKES_S = 30.0  # its imports, on a machine that is busy
_LOSSES_PERIOD_S = 1.0
_PERIODS_TO_RAISE = 3  # with losses
_PERIODS_TO_CLEAR = 5  # without
_STATE_SAMPLES = 5
_STOPPED = ("T", "t")  # by SIGSTOP, by a debugger


class ImageRing:
    """Slots for images in memory that two processes share.

    The memory has no name: it is freed when both processes have ended, however they end.  Pages that were never written
    cost nothing, so each slot has room for the widest pixels.
    """

    def __init__(self, width_px: int, height_px: int, slots: int, descriptor: int | None = None):
        """``descriptor``: of the ring that another process made; None: make a new one."""
        self.slots, self.slot_bytes = slots, width_px * height_px * 3 * 4
        self.descriptor = os.memfd_create("gripmon-images") if descriptor is None else descriptor
        if descriptor is None:
            os.ftruncate(self.descriptor, slots * self.slot_bytes)
        self._map = mmap.mmap(self.descriptor, slots * self.slot_bytes)

    def put(self, slot: int, image: NDArray[np.generic]) -> ImageNote:
        """Copy an image into a slot; the interpreter lock is free while the pixels move."""
        view = np.frombuffer(self._map, image.dtype, image.size, slot * self.slot_bytes).reshape(image.shape)
        np.copyto(view, image)
        return ImageNote(slot, image.shape, image.dtype.str)

    def get(self, note: ImageNote) -> NDArray[np.generic]:
        """A view of the slot, valid until the slot is reused."""
        count = int(np.prod(note.shape))
        flat = np.frombuffer(self._map, np.dtype(note.pixel_type), count, note.slot * self.slot_bytes)
        return flat.reshape(note.shape)

    def takes(self, image: object) -> bool:
        """Whether this is an image (grey or BGR, 8 or 16 bit or float) that fits into a slot."""
        if not isinstance(image, np.ndarray) or image.dtype.str not in _PIXEL_TYPES or image.size == 0:
            return False
        grey_or_bgr = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
        return grey_or_bgr and image.nbytes <= self.slot_bytes

    def close(self) -> None:
        self._map.close()
        os.close(self.descriptor)


def framed(payload: bytes) -> bytes:
    return len(payload).to_bytes(_LENGTH_BYTES, "little") + payload


class Unframer:
    """Splits the bytes from a pipe into whole payloads."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, part: bytes) -> Iterator[bytes]:
        self._buffer += part
        while len(self._buffer) >= _LENGTH_BYTES:
            end = _LENGTH_BYTES + int.from_bytes(self._buffer[:_LENGTH_BYTES], "little")
            if len(self._buffer) < end:
                return
            payload = bytes(self._buffer[_LENGTH_BYTES:end])
            del self._buffer[:end]
            yield payload


class WorkerProcess:
    """One recording process.  No method blocks, except :meth:`finish` and :meth:`reap`.

    The process ends with its parent, because the pipe that it reads from ends then; signals meant for the daemon
    (Ctrl-C, a service manager's SIGTERM to the group) don't reach it or are ignored, so that it can finish its file.
    """

    def __init__(self, scene: Scene, ring: ImageRing):
        self._reports, status_write = os.pipe()
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", _BOOTSTRAP, _HOME, str(status_write), str(ring.descriptor)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            pass_fds=(status_write, ring.descriptor),
            start_new_session=True,
            # Errors with files are in the status; rerun's own lines on stderr would only repeat them.
            env={"RUST_LOG": "off", **os.environ, "RERUN": "on"},
        )
        os.close(status_write)
        assert self._process.stdin is not None
        self._commands: int | None = os.dup(self._process.stdin.fileno())
        self._process.stdin.close()
        for descriptor in (self._commands, self._reports):
            os.set_blocking(descriptor, False)
        self._unsent = memoryview(framed(msgspec.msgpack.encode(scene)))
        self._report_part = b""
        self._decode = msgspec.json.Decoder(Status).decode
        self.status = Status()
        self.heard = False
        self.heard_s = time.monotonic()
        self.images_sent = 0
        self.frames_sent = 0
        self.limits_sent: Limits | None = None
        self.gone = False
        self.still_writes = False

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def ready(self) -> bool:
        """Whether everything passed to :meth:`send` has left this process."""
        return not self._unsent and not self.gone

    def send(self, payload: bytes) -> None:
        """Send a message; call it only when :attr:`ready`, so that at most one is pending."""
        self._unsent = memoryview(framed(payload))
        self.pump()
        self.pump(_PIPE_WAIT_S)

    def pump(self, wait_s: float = 0.0) -> None:
        """Write as much as the pipe takes, waiting up to ``wait_s`` for it to take more."""
        if self._unsent and wait_s > 0.0:
            _wait_for(self._commands, select.POLLOUT, wait_s)
        while self._unsent and self._commands is not None and not self.gone:
            try:
                self._unsent = self._unsent[os.write(self._commands, self._unsent) :]
            except BlockingIOError:
                return
            except BrokenPipeError:
                self.read_reports()  # the last status says why it ended
                self.gone = True

    def read_reports(self) -> None:
        """Update :attr:`status` to the newest report, and :attr:`gone` when the process has ended."""
        while not self.gone:
            try:
                part = os.read(self._reports, 65536)
            except BlockingIOError:
                return
            if not part:
                self.gone = True
            *lines, self._report_part = (self._report_part + part).split(b"\n")
            if lines:
                self.heard, self.heard_s = True, time.monotonic()
                self.status = self._decode(lines[-1])

    def finish(self, deadline: float) -> str | None:
        """Let it write everything and end.

        A process that has received everything but is still writing at the ``deadline`` (monotonic seconds) is left
        running, and :attr:`still_writes` is set: it needs no parent and ends on its own.  Any other is killed.  Returns
        why the recording is incomplete, None if it is complete.
        """
        while self._unsent and not self.gone and (left_s := deadline - time.monotonic()) > 0.0:
            self.pump(left_s)
        has_everything = not self._unsent
        self._close_commands()
        # Read until the pipe ends, so that the process is never blocked by a full pipe.
        while not self.gone and (left_s := deadline - time.monotonic()) > 0.0:
            _wait_for(self._reports, select.POLLIN, left_s)
            self.read_reports()
        silent_s = time.monotonic() - self.heard_s
        if not self.gone and has_everything and silent_s < SILENT_AFTER_S and not stands_still(self.pid):
            self.still_writes = True
            os.close(self._reports)
            return None
        return self.reap(deadline - time.monotonic())

    def discard(self) -> None:
        """Kill it."""
        self._process.kill()
        self.reap(_KILL_WAIT_S)

    def reap(self, timeout_s: float) -> str | None:
        """Wait for the end of the process or kill it, then close all descriptors."""
        self._close_commands()
        try:
            code = self._process.wait(max(timeout_s, _EXIT_WAIT_S))
            failure = None if code == 0 else f"the recording process ended with code {code}"
        except subprocess.TimeoutExpired:
            self._process.kill()
            failure = "the recording process did not finish in time; the end of its last file may be missing"
            try:
                self._process.wait(_KILL_WAIT_S)
            except subprocess.TimeoutExpired:
                failure = "the recording process hangs in a disk that doesn't answer, and was left there"
        os.close(self._reports)
        return failure

    def _close_commands(self) -> None:
        if self._commands is not None:
            os.close(self._commands)
            self._commands = None


def _wait_for(descriptor: int | None, event: int, timeout_s: float) -> None:
    if descriptor is not None:
        poll = select.poll()
        poll.register(descriptor, event)
        poll.poll(1e3 * timeout_s)


class Health:
    """Whether the process responds and keeps up, judged by counts and times alone; ``fault`` is one line, None while
    all is well.
    """

    def __init__(self, now_s: float) -> None:
        self.fault: str | None = None
        self._looked_s = now_s
        self._counts = (0, 0)
        self._with_losses = self._without = 0
        self._thins: str | None = None

    def look(
        self, now_s: float, heard_s: float, heard: bool, pid: int, frames: int, images: int, explained: bool = False
    ) -> None:
        """``heard_s``: time of its last report, or of its start if it was never ``heard``; ``frames`` and ``images``
        count what was dropped so far.  ``explained``: the process itself says why it writes nothing, so that losses
        don't mean that it is too slow.
        """
        if now_s - heard_s > (SILENT_AFTER_S if heard else _START_TAKES_S):
            self.fault = f"recording pauses: {_why_silent(pid)}"
            self._counts, self._looked_s = (frames, images), now_s
            return
        if now_s - self._looked_s >= _LOSSES_PERIOD_S:
            self._looked_s = now_s
            self._count(heard and not explained, frames, images)
        if explained:
            self._thins, self._with_losses = None, 0
        self.fault = self._thins

    def _count(self, counts: bool, frames: int, images: int) -> None:
        """A short burst of losses is not reported, losses that last for seconds are."""
        (frames_before, images_before), self._counts = self._counts, (frames, images)
        what = "frames" if frames > frames_before else "images" if images > images_before else ""
        losing = bool(what) and counts
        self._with_losses = self._with_losses + 1 if losing else 0
        self._without = 0 if losing else self._without + 1
        if self._with_losses >= _PERIODS_TO_RAISE and self._thins is None:
            self._thins = f"recording thins: it can't keep up, {what} are dropped"
        elif self._without >= _PERIODS_TO_CLEAR:
            self._thins = None


def stands_still(pid: int) -> bool:
    """Whether a process was stopped from outside, or one of its threads waits for a disk in every sample over a tenth
    of a second.
    """
    for _ in range(_STATE_SAMPLES):
        states = [_state(thread) for thread in Path(f"/proc/{pid}/task").glob("*")]
        if not any(state in ("D", *_STOPPED) for state in states):
            return False
        time.sleep(0.1 / _STATE_SAMPLES)
    return True


def _state(process: Path) -> str:
    """The state letter that Linux gives a process or thread; empty if it doesn't exist."""
    try:
        return (process / "stat").read_text().rpartition(")")[2].split()[0]
    except (OSError, IndexError):
        return ""


def _why_silent(pid: int) -> str:
    state = _state(Path(f"/proc/{pid}"))
    if state == "D":
        return "the disk doesn't answer"
    if state in _STOPPED:
        return "its process was stopped from outside"
    return f"its process hasn't answered for {SILENT_AFTER_S:g} s"
