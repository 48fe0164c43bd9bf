"""The recording process: how the daemon starts it, talks to it and ends it; and what it does.

Nothing here may import rerun or OpenCV, which the daemon's process does without, before :func:`_run`.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import sys
import threading
import time
from collections.abc import Callable
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any

import msgspec

from gripmon.model.errors import in_short
from gripmon.model.own_process import OwnProcess
from gripmon.model.priority import give_way
from gripmon.model.shared_images import SharedImages
from gripmon.record.health import START_TAKES_S
from gripmon.record.recorder import Scene, Status

_KILL_WAIT_S = 0.5  # a process blocked by the disk dies when the disk answers, perhaps never
_BEAT_WAIT_S = 1.5  # three times the period of its reports
_LIVE_CLOSE_S = 2.0
_PIPE_BYTES = 1 << 20  # as much as Linux lets everybody have


class Worker:
    """The daemon's handle on one recording process.

    The process ends by itself when the daemon closes its pipe or ends, and then writes all that it was given.
    """

    def __init__(self, scene: Scene, images: SharedImages) -> None:
        """Raises OSError if no process can be started."""
        theirs, self._batches = Pipe(duplex=False)
        self._reports, told = Pipe(duplex=False)
        with contextlib.suppress(OSError):  # else what is sent while it starts waits in this process
            fcntl.fcntl(self._batches.fileno(), fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        inherited = theirs.fileno(), told.fileno()
        try:
            self._process = OwnProcess(_run, scene, images, *inherited, inherits=(*inherited, images.descriptor))
        except OSError:
            self._batches.close()
            self._reports.close()
            raise
        finally:
            theirs.close()
            told.close()
        self._decode = msgspec.json.Decoder(Status).decode
        self.status = Status()
        self.heard = False
        self.heard_s = time.monotonic()
        """When its last report was read; before the first one, when it was started."""
        self.pid = self._process.pid
        self.sending_from_s: float | None = None
        """Since when it doesn't take what it is sent, monotonic; None: it does."""
        self.images_sent = self.frames_sent = 0
        self.gone = self.still_writes = False

    @property
    def frames_unwritten(self) -> int:
        """Frames that it was sent and has neither written nor given up."""
        return self.frames_sent - self.status.frames - self.status.frames_lost

    def send(self, payload: bytes) -> None:
        """Send a message.  Blocks while the process doesn't run, until it does or is killed."""
        self.sending_from_s = time.monotonic()
        try:
            self._batches.send_bytes(payload)
        except OSError:
            self.look()  # its last report says why it ended
            self.gone = True
        self.sending_from_s = None

    def look(self) -> None:
        """Update :attr:`status` to the newest report, and :attr:`gone` when the process has ended."""
        newest = None
        try:
            while not self.gone and self._reports.poll():
                newest = self._reports.recv_bytes()
        except (EOFError, OSError):
            self.gone = True
        if newest is not None:
            self.status, self.heard, self.heard_s = self._decode(newest), True, time.monotonic()

    def finish(self, deadline: float, *, complete: bool) -> str | None:
        """Let it write everything and end; ``complete``: it was sent everything.

        A complete process that still starts, or is still writing, at the ``deadline`` (monotonic seconds) is left
        running, and :attr:`still_writes` is set: it needs no parent and ends on its own.  Any other is killed.  Returns
        why the recording is incomplete, None if it is complete.
        """
        self._batches.close()
        while not self.gone and (left_s := deadline - time.monotonic()) > 0.0:
            self._reports.poll(left_s)
            self.look()
        if not self.gone and complete and not self.status.hangs:
            starts = not self.heard and time.monotonic() - self.heard_s < START_TAKES_S
            self.still_writes = starts or self._reports.poll(_BEAT_WAIT_S)
            self.look()
            self.still_writes &= not self.gone
        if not self.still_writes:
            return self.reap()
        self._process.leave()
        return None

    def reap(self) -> str | None:
        """Wait for the end of a process that is :attr:`gone`, kill any other, and close everything."""
        failure = None
        if not self._process.ended_within(_KILL_WAIT_S if self.gone else 0.0):
            failure = "the recording process did not finish in time; the end of its last file may be missing"
            self.kill()
        for pipe in (self._batches, self._reports):
            pipe.close()
        if not self._process.ended_within(_KILL_WAIT_S):
            self._process.leave()
            return "the recording process hangs in a disk that doesn't answer, and was left there"
        code = self._process.returncode
        return failure or (None if code == 0 else f"the recording process ended with code {code}")

    def kill(self) -> None:
        """Kill it, from any thread: a blocked :meth:`send` then returns."""
        self._process.kill()


def _run(scene: Scene, images: SharedImages, batches: int, reports: int) -> None:
    """What the process does; it is given the descriptors of its ends of the pipes."""
    # Errors with files are in the status; rerun's own lines on stderr would only repeat them.
    os.environ |= {"RUST_LOG": os.environ.get("RUST_LOG", "off"), "RERUN": "on"}
    give_way()
    taken: Connection[Any, Any] = Connection(batches, writable=False)
    told: Connection[Any, Any] = Connection(reports, readable=False)
    _or_end(_record, scene, images, taken, told)
    os._exit(0)  # everything is written; a viewer that stalls may still hold the live view's thread


def _or_end(work: Callable[..., None], *given: Any) -> None:
    """Work, in any thread; what that raises ends the process: the daemon starts another one."""
    try:
        work(*given)
    except Exception as error:  # noqa: BLE001 - reported in one line
        sys.stderr.write(f"recording process: {in_short(error)}\n")
        sys.stderr.flush()
        os._exit(1)


def _record(scene: Scene, images: SharedImages, batches: Connection, reports: Connection) -> None:
    import cv2

    cv2.setNumThreads(1)
    from gripmon.record.files import FileSeries
    from gripmon.record.taking import FileInbox, Taker

    files = FileSeries(scene) if scene.settings.enabled else FileInbox(scene.directory)
    live = None
    if scene.view is not None:
        from gripmon.record.live import LiveStream

        live = LiveStream(scene, scene.view)
    taker = Taker(scene.settings, images, batches, reports, files, live)
    threading.Thread(target=_or_end, args=(taker.run,), name="taking", daemon=True).start()
    period_s = scene.settings.flush_period_s
    if live is not None:
        serving = threading.Thread(target=_or_end, args=(live.serve, period_s), name="live view", daemon=True)
        serving.start()
    files.serve(period_s, taker.report)
    if live is not None:
        serving.join(_LIVE_CLOSE_S)
    taker.report()
