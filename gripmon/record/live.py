"""The live view: rows served to viewers that connect, from a thread of its own that never delays the files."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from gripmon.model.errors import one_line
from gripmon.record.recorder import LOOPBACK, Row, Scene, ViewSettings
from gripmon.record.taking import Inbox, Load

if TYPE_CHECKING:
    import rerun as rr

    from gripmon.record.rows import RowWriter

_FLUSH_TIMEOUT_S = 1.0
_REPEAT_S = 60.0  # what is sent on change only is sent again, for viewers that join after it was dropped
_RETRY_S = 10.0
_WAITING_MEMORY_FRACTION = 0.25  # of the view's memory limit, for the pictures of queued rows
_ROWS_FOR_VIEWERS = 512


class LiveStream(Inbox):
    """Serves rows to viewers: the newest, as many as the limits allow.  What can't be served is dropped.

    The server keeps what it has sent up to a limit and drops the oldest data; a stalled viewer blocks it, and rows that
    arrive meanwhile are not shown.  The stream is separate from that of the files, which may begin and end without
    viewers noticing.
    """

    def __init__(self, scene: Scene, settings: ViewSettings) -> None:
        super().__init__(scene.reference)
        self._scene, self._settings = scene, settings
        self._stream: rr.RecordingStream | None = None  # the same after a failure: rerun keeps every stream for good
        self._writer: RowWriter | None = None  # None: nothing is served
        self._repeat_at = self._retry_at = 0.0
        self._stalled = False

    def write(self) -> None:
        """Start or restart the stream if due, and send; a server that a viewer blocks gets nothing more."""
        load, now_s = self._taken(), time.monotonic()
        if self._writer is None and now_s < self._retry_at:
            return
        try:
            writer = self._writer = self._writer or self._begin()
            if not self._stalled:
                if now_s >= self._repeat_at:
                    self._repeat_at = now_s + _REPEAT_S
                    writer.repeat()
                    load.events = self._with_reference(load.events)
                writer.write(load.rows, load.events)
                writer.write_pictures(load.late)
            self._flush()
            self.failure = None
        except Exception as error:  # noqa: BLE001 - rerun raises its own types; none may affect the files
            self._writer, self._stalled = None, False
            self._retry_at = now_s + _RETRY_S
            self.failure = f"the live view can't be served on {LOOPBACK}:{self._settings.port} ({one_line(error)})"

    def close(self) -> None:
        """End the server; while a viewer blocks it, this doesn't return."""
        if self._writer is not None and self._stream is not None:
            self._stream.disconnect()

    def _bound(self, load: Load) -> None:
        load.rows, load.late = self._newest(load.rows), self._newest(load.late)

    def _newest(self, rows: list[Row]) -> list[Row]:
        left_bytes, kept = _WAITING_MEMORY_FRACTION * self._settings.memory_limit_bytes, 0
        for row in reversed(rows[-_ROWS_FOR_VIEWERS:]):
            left_bytes -= row.picture_bytes
            if left_bytes < 0:
                break
            kept += 1
        return rows[len(rows) - kept :]

    def _flush(self) -> None:
        """Wait until everything is sent; a server that is gone fails at once, a blocked one after a timeout."""
        begun_s, was_stalled = time.monotonic(), self._stalled
        try:
            assert self._stream is not None, "begun"
            self._stream.flush(timeout_sec=_FLUSH_TIMEOUT_S)
            self._stalled = False
        except Exception:
            if time.monotonic() - begun_s < 0.9 * _FLUSH_TIMEOUT_S:
                raise
            self._stalled = True
        if was_stalled and not self._stalled:
            self._repeat_at = 0.0  # changes may have been among what was not shown

    def _begin(self) -> RowWriter:
        import rerun as rr

        from gripmon.record.layout import layout_file, layout_of
        from gripmon.record.rows import RowWriter
        from gripmon.record.written_file import open_stream

        self._stream = self._stream or open_stream(self._scene)
        limit = f"{self._settings.memory_limit_bytes}B"
        self._stream.set_sinks(rr.GrpcServerSink(LOOPBACK, self._settings.port, server_memory_limit=limit))
        self._stream.send_recording_name(f"{self._scene.name} (live)")
        self._stream.log_file_from_contents("layout.rbl", layout_file(layout_of(self._scene)))
        self._repeat_at = 0.0
        return RowWriter(self._stream, self._scene, 0)
