"""The recording as it is made, for viewers that connect: next to the files, never in their way.

The server keeps what it has sent up to a limit, and drops the oldest.  A viewer that stands still blocks the server: so
a thread of its own waits for it, and what comes meanwhile is not shown.  The stream is not that of the files, which
begin and end without a viewer's notice.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence

import rerun as rr

from gripmon.record.write.columns import AnyRow
from gripmon.record.write.files import APPLICATION_ID
from gripmon.record.write.layout import make_blueprint
from gripmon.record.write.view import LOOPBACK, ViewSettings
from gripmon.record.write.wire import Events, Scene
from gripmon.record.write.writers import Writer, make_writer

_FLUSH_TIMEOUT_S = 1.0
_REPEAT_S = 60.0  # what only changes say is said again, for viewers that join when it has been dropped
_RETRY_S = 10.0
_MOST_ROWS, _WAITING_SHARE = 512, 0.25  # that wait for the thread, and the memory that their pictures may take
_CLOSE_S = 2.0


class LiveStream:
    """Serves the rows that it is given.  What can't be served is given up; ``failure`` says why, else it is None."""

    def __init__(self, scene: Scene, settings: ViewSettings):
        self._scene, self._settings = scene, settings
        self._lock = threading.Condition()  # guards what follows
        self._rows: list[AnyRow] = []
        self._late: list[AnyRow] = []
        self._events = Events.at_first(scene.reference)
        self._due = self._ending = False
        # Of the thread alone.
        self._newest_reference = scene.reference
        self._stream: rr.RecordingStream | None = None
        self._writer: Writer | None = None
        self._repeat_at = self._retry_at = 0.0
        self._stalled = False
        self.failure: str | None = None
        self._thread = threading.Thread(target=self._run, name="live view", daemon=True)
        self._thread.start()

    def add_frames(self, rows: Sequence[AnyRow]) -> None:
        with self._lock:
            self._rows = self._bounded(self._rows + list(rows))

    def add_pictures(self, rows: Sequence[AnyRow]) -> None:
        """Pictures of frames that were added before without them."""
        with self._lock:
            self._late = self._bounded(self._late + list(rows))

    def add_events(self, events: Events) -> None:
        with self._lock:
            self._events += events

    def _bounded(self, rows: list[AnyRow]) -> list[AnyRow]:
        """The newest of them, as many as may wait."""
        left_bytes, kept = _WAITING_SHARE * self._settings.memory_limit_bytes, 0
        for row in reversed(rows[-_MOST_ROWS:]):
            left_bytes -= 0 if row.picture is None else len(row.picture.blob)
            if left_bytes < 0:
                break
            kept += 1
        return rows[len(rows) - kept :]

    def write(self) -> None:
        """Let the thread send what has been added; returns at once."""
        with self._lock:
            self._due = True
            self._lock.notify()

    def close(self) -> bool:
        """Send the rest and end the server; False if a viewer still holds it up after some seconds."""
        with self._lock:
            self._due = self._ending = True
            self._lock.notify()
        self._thread.join(_CLOSE_S)
        return not self._thread.is_alive()

    def _run(self) -> None:
        ending = False
        while not ending:
            with self._lock:
                self._lock.wait_for(lambda: self._due)
                rows, late, events = self._rows, self._late, self._events
                self._rows, self._late, self._events, self._due = [], [], Events(), False
                ending = self._ending
            if events.references:
                self._newest_reference = events.references[-1]
            self._send(rows, late, events)
        if self._stream is not None:
            self._stream.disconnect()
        self._stream = self._writer = None

    def _send(self, rows: list[AnyRow], late: list[AnyRow], events: Events) -> None:
        """Begin, or begin again, where that is due; nothing more goes to a server that a viewer holds up."""
        now_s = time.monotonic()
        if self._writer is None and now_s < self._retry_at:
            return
        try:
            stream, writer = self._begun()
            if not self._stalled:
                if now_s >= self._repeat_at:
                    self._repeat_at = now_s + _REPEAT_S
                    writer.repeat()
                    if self._newest_reference not in events.references:
                        events = Events.at_first(self._newest_reference) + events
                writer.write(rows, events)
                writer.write_pictures(late)
            self._flush(stream)
            self.failure = None
        except Exception as error:  # noqa: BLE001 - rerun raises its own kinds; none of them may touch the files
            self._stream = self._writer = None
            self._stalled = False
            self._retry_at = now_s + _RETRY_S
            reason = " ".join(str(error).split())
            self.failure = f"the live view can't be served on {LOOPBACK}:{self._settings.port} ({reason})"

    def _flush(self, stream: rr.RecordingStream) -> None:
        """Wait until it has been sent; a server that is gone fails at once, one that is held up in time."""
        begun_s = time.monotonic()
        was_stalled = self._stalled
        try:
            stream.flush(timeout_sec=_FLUSH_TIMEOUT_S)
            self._stalled = False
        except Exception:
            if time.monotonic() - begun_s < 0.9 * _FLUSH_TIMEOUT_S:
                raise
            self._stalled = True
        if was_stalled and not self._stalled:
            self._repeat_at = 0.0  # changes may have been among what was not shown

    def _begun(self) -> tuple[rr.RecordingStream, Writer]:
        if self._stream is None or self._writer is None:
            limit = f"{self._settings.memory_limit_bytes}B"
            stream = rr.RecordingStream(APPLICATION_ID, recording_id=self._scene.recording_id)
            stream.set_sinks(rr.GrpcServerSink(LOOPBACK, self._settings.port, server_memory_limit=limit))
            stream.send_recording_name(f"{self._scene.name} (live)")
            stream.send_blueprint(make_blueprint(self._scene), make_active=True, make_default=True)
            self._stream, self._writer = stream, make_writer(stream, self._scene, 0)
            self._repeat_at = 0.0
        return self._stream, self._writer


class NoFiles:
    """In the place of the files where recording is switched off and only the live view is wanted."""

    path: str | None = None
    failure: str | None = None
    notice: str | None = None
    frames_lost = frames_waiting = images_lost = 0
    hangs = False

    def __init__(self) -> None:
        self.frames_written = 0

    def add_frames(self, rows: Sequence[AnyRow]) -> None:
        self.frames_written += len(rows)

    def add_pictures(self, rows: Sequence[AnyRow]) -> None:
        pass

    def add_events(self, events: Events) -> None:
        pass

    def pin(self, *_alert: object) -> None:
        pass

    def write(self) -> None:
        pass

    def close(self) -> None:
        pass
