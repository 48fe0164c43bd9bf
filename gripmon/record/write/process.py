"""The recording process as the daemon holds it: start, pipe, reports, end."""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from pathlib import Path

import msgspec

from gripmon.model.records import Limits
from gripmon.record.write.health import SILENT_AFTER_S, stands_still
from gripmon.record.write.wire import ImageRing, Scene, Status, framed

# The working directory must not be searched for modules (-P), but where this package came from must.
_BOOTSTRAP = (
    "import sys; home = sys.argv[1]; home in sys.path or sys.path.insert(0, home); "
    "from gripmon.record.write.worker import main; main(int(sys.argv[2]), int(sys.argv[3]))"
)
_HOME = str(Path(__file__).resolve().parents[3])
_PATIENCE_S = 0.01  # of a batch that is larger than the pipe
_KILL_GRACE_S = 0.5  # a process that hangs in the disk dies when that answers, perhaps never
_EXIT_GRACE_S = 0.2  # between a process's last descriptor and its exit code


class WorkerProcess:
    """One recording process.  Everything here returns at once, except :meth:`finish`.

    It ends by itself when its parent does, because the pipe that it reads from ends then; signals meant for the daemon
    (Ctrl-C, a service manager's SIGTERM to the group) don't reach or don't end it, so that it can finish its file.
    """

    def __init__(self, scene: Scene, ring: ImageRing):
        status_read, status_write = os.pipe()
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", _BOOTSTRAP, _HOME, str(status_write), str(ring.descriptor)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            pass_fds=(status_write, ring.descriptor),
            start_new_session=True,
            # What goes wrong with files is reported; rerun's own lines about it would only repeat it on stderr.
            env={"RUST_LOG": "off", **os.environ, "RERUN": "on"},
        )
        os.close(status_write)
        assert self._process.stdin is not None
        self._commands: int | None = os.dup(self._process.stdin.fileno())
        self._process.stdin.close()
        self._reports = status_read
        for descriptor in (self._commands, self._reports):
            os.set_blocking(descriptor, False)
        self._unsent = memoryview(framed(msgspec.msgpack.encode(scene)))
        self._report_part = b""
        self._decode = msgspec.json.Decoder(Status).decode
        self.status = Status(path=None, failure=None, frames=0, frames_lost=0, images_done=0)
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
        """Whether everything that was given to :meth:`send` has left this process."""
        return not self._unsent and not self.gone

    def send(self, payload: bytes) -> None:
        """Hand over a message; only when :attr:`ready`, so that at most one waits here."""
        self._unsent = memoryview(framed(payload))
        self.pump()
        self.pump(_PATIENCE_S)

    def pump(self, wait_s: float = 0.0) -> None:
        """Write what the pipe takes; with ``wait_s`` give it that time to take more."""
        if self._unsent and wait_s > 0.0:
            _wait_for(self._commands, select.POLLOUT, wait_s)
        while self._unsent and self._commands is not None and not self.gone:
            try:
                self._unsent = self._unsent[os.write(self._commands, self._unsent) :]
            except BlockingIOError:
                return
            except BrokenPipeError:
                self.gone = True

    def read_reports(self) -> None:
        """Take the newest :attr:`status`; notice when the process has ended."""
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

        One that has everything and is only slow past the ``deadline`` (monotonic seconds) is left to it, and
        :attr:`still_writes`: it needs nobody, and ends by itself.  Others are ended by force.  Returns why the
        recording is incomplete, None if all went well.
        """
        while self._unsent and not self.gone and (left_s := deadline - time.monotonic()) > 0.0:
            _wait_for(self._commands, select.POLLOUT, left_s)
            self.pump()
        has_everything = not self._unsent
        self._close_commands()
        # Reading on until the pipe ends keeps the process from waiting for room in it.
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
        """End it, whatever it is at."""
        self._process.kill()
        self.reap(_KILL_GRACE_S)

    def reap(self, timeout_s: float) -> str | None:
        """Wait for the end, or bring it about; then release all descriptors."""
        self._close_commands()
        try:
            code = self._process.wait(max(timeout_s, _EXIT_GRACE_S))
            failure = None if code == 0 else f"the recording process ended with code {code}"
        except subprocess.TimeoutExpired:
            self._process.kill()
            failure = "the recording process did not finish in time; the end of its last file may be missing"
            try:
                self._process.wait(_KILL_GRACE_S)
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
