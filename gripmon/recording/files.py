"""The series of files of one recording: begins, fills, ends them, and keeps clear of a full disk."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import rerun as rr

from gripmon.recording.columns import Row
from gripmon.recording.layout import make_blueprint
from gripmon.recording.rows import RowWriter
from gripmon.recording.wire import Events, Scene

APPLICATION_ID = "gripmon"
_FIRST_RETRY_S = 1.0
_LONGEST_RETRY_S = 30.0
_FLUSH_TIMEOUT_S = 5.0
# Space must have become a little more than it has to be, or recording would start and stop at every flush.
_FREE_AGAIN = 1.02


class FileSeries:
    """``name-0001.rrd`` and on.  Frames that arrive while nothing can be written are counted as lost.

    All files of a series carry one recording id: a viewer that is given several of them shows one recording.
    ``extra_sinks`` is called for every file that begins; its rerun sinks get all that the file gets.
    """

    def __init__(self, scene: Scene, extra_sinks: Callable[[], Sequence[Any]] = tuple):
        rr.set_strict_mode(True)
        self._scene = scene
        self._extra_sinks = extra_sinks
        self._directory = Path(scene.directory)
        self._number = 1
        self._own_files: list[Path] = []
        self._file: Path | None = None
        self._stream: rr.RecordingStream | None = None
        self._writer: RowWriter | None = None
        self._rows: list[Row] = []
        self._events = Events()
        self._newest_reference = scene.reference
        self._frames_in_file = 0
        self._retry_s = _FIRST_RETRY_S
        self._retry_at = 0.0
        self.failure: str | None = None
        self.frames_written = 0
        self.frames_lost = 0
        self._begin()

    @property
    def path(self) -> str | None:
        return None if self._file is None else str(self._file)

    def add_frames(self, rows: list[Row]) -> None:
        self._rows += rows

    def add_events(self, events: Events) -> None:
        self._events += events
        if events.references:
            self._newest_reference = events.references[-1]

    def write(self) -> None:
        """Put on disk what has been added; begin, end or change the file where that is due."""
        if self._stream is None and time.monotonic() >= self._retry_at:
            self._begin()
        if self._stream is None or self._writer is None or self._file is None:
            self._lose()
            return
        rows, events = self._rows, self._events
        self._rows, self._events = [], Events()
        self._writer.write(rows, events)
        try:
            self._stream.flush(timeout_sec=_FLUSH_TIMEOUT_S)
            size = self._file.stat().st_size
        except Exception as error:  # noqa: BLE001 - rerun raises its own kinds; every one means that the file ends here
            self.frames_lost += len(rows)
            self._abandon(f"can't write {self._file}: {error}")
            return
        self.frames_written += len(rows)
        self._frames_in_file += len(rows)
        self._retry_s = _FIRST_RETRY_S
        missing = self._space_missing()
        if missing:
            self.close()
            self._fail(missing)
        elif size >= self._scene.settings.max_file_bytes:
            self.close()
            self._begin()

    def close(self) -> None:
        """Complete the file: its footer lets readers load it without a scan."""
        if self._stream is not None:
            self._stream.disconnect()
        self._stream = self._writer = None
        self._file = None
        self._lose()

    def _begin(self) -> None:
        """Open the next file and write what every file needs: the layout, all that is static, the reference."""
        missing = self._space_missing(_FREE_AGAIN)
        if missing:
            self._fail(missing)
            return
        path = self._next_path()
        stream = rr.RecordingStream(APPLICATION_ID, recording_id=self._scene.recording_id)
        try:
            stream.set_sinks(rr.FileSink(path), *self._extra_sinks())
            stream.send_recording_name(self._scene.name)
            stream.send_blueprint(make_blueprint(self._scene), make_active=True, make_default=True)
            writer = RowWriter(stream, self._scene, self._number)
            stream.flush(timeout_sec=_FLUSH_TIMEOUT_S)
        except Exception as error:  # noqa: BLE001 - as above
            path.unlink(missing_ok=True)
            self._fail(f"can't write {path}: {error}")
            self._retry_s = min(2.0 * self._retry_s, _LONGEST_RETRY_S)
            return
        if self._newest_reference not in self._events.references:
            self._events = Events(references=[self._newest_reference]) + self._events
        self._stream, self._writer, self._file = stream, writer, path
        self._frames_in_file = 0
        self._number += 1
        self.failure = None
        self._own_files.append(path)
        keep = self._scene.settings.keep_files
        while keep and len(self._own_files) > keep:
            self._own_files.pop(0).unlink(missing_ok=True)

    def _abandon(self, why: str) -> None:
        """Leave a file that can't be written any more; one without frames is worth nothing."""
        self._stream = self._writer = None
        if self._file is not None and self._frames_in_file == 0:
            self._own_files.remove(self._file)
            self._file.unlink(missing_ok=True)
        self._file = None
        self._fail(why)
        self._retry_s = min(2.0 * self._retry_s, _LONGEST_RETRY_S)

    def _fail(self, why: str) -> None:
        self.failure = f"recording failed: {why}"
        self._retry_at = time.monotonic() + self._retry_s

    def _lose(self) -> None:
        self.frames_lost += len(self._rows)
        self._rows, self._events = [], Events()

    def _next_path(self) -> Path:
        while True:
            path = self._directory / f"{self._scene.name}-{self._number:04d}.rrd"
            if not path.exists():
                return path
            self._number += 1

    def _space_missing(self, factor: float = 1.0) -> str:
        """Why there is no room for more, empty if there is."""
        wanted = self._scene.settings.min_free_bytes
        try:
            free = shutil.disk_usage(self._directory).free
        except OSError as error:
            return f"{self._directory}: {error.strerror}"
        if free >= wanted * factor:
            return ""
        return f"{self._directory} has {free / 1e6:.0f} MB free, min_free_bytes keeps {wanted / 1e6:.0f} MB"
