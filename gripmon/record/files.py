"""The series of files of one recording: begins, fills and ends them; pauses while its disk is full or fails."""

from __future__ import annotations

import contextlib
import re
import shutil
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from gripmon.model.outputs import Event
from gripmon.model.records import AlertRecord
from gripmon.record.keeping import (
    PIN_SUFFIX,
    DiskBudget,
    Moments,
    PinBoard,
    PinnedBy,
    mend,
    pin_path,
    space_missing,
)
from gripmon.record.recorder import Row, Scene, those
from gripmon.record.taking import FileInbox, Load

if TYPE_CHECKING:
    import rerun as rr

    from gripmon.record.written_file import WrittenFile

_FIRST_RETRY_S = 1.0
_LONGEST_RETRY_S = 30.0
_PIN_AROUND_S = 5.0  # pinned before and after an alert at least, even if no images are kept around it
_FILES_REMEMBERED = 64
_ROWS_A_CHUNK = 32
_PICTURE_BYTES_A_CHUNK = 1_000_000
_PICTURES_A_CHUNK = 16
_ALERTS_KEPT = 64  # while nothing can be written: the next file then explains it
# Free space needed to resume, over the minimum: otherwise recording would start and stop at every flush.
_RESUME_FREE_FACTOR = 1.02


def _fitting(rows: list[Row]) -> int:
    """How many rows make a chunk, which is lost as a whole if the file is cut there."""
    total_bytes = 0
    for count, row in enumerate(rows[:_ROWS_A_CHUNK]):
        total_bytes += row.picture_bytes
        if total_bytes > _PICTURE_BYTES_A_CHUNK:
            return max(count, 1)
    return _ROWS_A_CHUNK


class _Paused(Exception):
    """Nothing can be written for now; the text says why."""


class FileSeries(FileInbox):
    """``name-0001.rrd``, ``name-0002.rrd``, …  Frames that arrive while nothing can be written are counted as lost.

    All files of a series have one recording id, so that a viewer shows several of them as one recording.
    """

    def __init__(self, scene: Scene) -> None:
        """Touches no disk yet, and imports no rerun."""
        super().__init__(scene.directory, scene.reference)
        self._scene, self._settings, self._directory = scene, scene.settings, Path(scene.directory)
        budget_bytes = self._settings.budget_bytes
        self._budget = DiskBudget(self._directory, scene.robot, scene.camera, scene.name, budget_bytes)
        self._pins = PinBoard()
        self._pinning = Moments(round(1e9 * max(self._settings.around_alert_s, _PIN_AROUND_S)))
        self._alerts: deque[PinnedBy] = deque(maxlen=_FILES_REMEMBERED)
        self._ended: deque[WrittenFile] = deque(maxlen=_FILES_REMEMBERED)
        self._file: WrittenFile | None = None
        self._stream: rr.RecordingStream | None = None
        self._layout: bytes | None = None
        self._unsaid: list[Event] = []  # of the time without a file
        self._retry_s, self._retry_at = _FIRST_RETRY_S, 0.0

    def write(self) -> None:
        """Write what has been added to disk; begin, end or change the file as needed."""
        load = self._taken()
        load.events, self._unsaid = self._unsaid + load.events, []
        for alert, stamp_ns in load.pins:
            self._pin(alert, stamp_ns)
        try:
            if self._file is None and time.monotonic() >= self._retry_at:
                self._begin()
            while self._file is not None:
                self._fill(self._file, load)
                self._maintain(self._file)
                if not (load.rows or load.late):
                    break
        except _Paused as pause:
            self._pause(f"recording pauses: {pause}")
        except OSError as error:
            self._fail(error)
        if self._file is None:
            self._lose(load)

    def close(self) -> None:
        """Complete the file."""
        try:
            self._end()
        except OSError as error:
            self._fail(error)

    def _fill(self, file: WrittenFile, load: Load) -> None:
        """Write some of a load and take it out as it reaches the disk: what is left is lost if that fails."""
        rows = load.rows[: _fitting(load.rows)]
        file.writer.write(rows, self._with_reference(load.events) if file.bytes == 0 else load.events)
        file.flush()
        file.cover([row.record.stamp_ns for row in rows])
        self.frames_written += len(rows)
        del load.rows[: len(rows)]
        load.events = []
        while load.late and not load.rows:
            file.writer.write_pictures(load.late[:_PICTURES_A_CHUNK])
            file.flush()
            del load.late[:_PICTURES_A_CHUNK]
        self.failure, self._retry_s = None, _FIRST_RETRY_S

    def _maintain(self, file: WrittenFile) -> None:
        """Pin the file if an alert touches it; begin the next one if this is full, old, or over budget.  Raises
        :class:`_Paused` if the disk is full.
        """
        settings = self._settings
        if self._touches(file):
            self._pins.pin(file.path, tuple(self._alerts))
        with self._asking_disk():
            missing = self._write_pins() or space_missing(self._directory, settings.min_free_bytes)
            old = time.monotonic() - file.begun_s >= settings.max_file_s
            full = file.frames > 0 and (old or file.bytes >= settings.max_file_bytes or not self._fits(file))
        if missing or full:
            self._end()
        if missing:
            raise _Paused(missing)
        if full:
            self._begin()

    def _fits(self, file: WrittenFile) -> bool:
        """Whether this file may grow within the budget."""
        if not self._budget.exceeded_by(file.bytes):
            return True
        with contextlib.suppress(OSError):  # the next flush reports what is wrong with the directory
            return not self._budget.make_room(self._pins.holds, file.path)
        return True

    def _pin(self, alert: PinnedBy, stamp_ns: int | None) -> None:
        self._alerts.append(alert)
        if stamp_ns is not None:
            self._pinning.add(stamp_ns)
        if self._file is not None:
            self._pins.pin(self._file.path, (alert,))
        for file in self._ended:
            if self._touches(file):
                self._pins.pin(file.path, (alert,))

    def _touches(self, file: WrittenFile) -> bool:
        return file.first_ns is not None and self._pinning.near(file.first_ns, file.last_ns)

    def _write_pins(self) -> str:
        try:
            self._pins.write()
        except OSError as error:
            return f"can't pin in {self._directory}: {error.strerror}"
        return ""

    def _begin(self) -> None:
        """Begin the next file."""
        from gripmon.record.layout import layout_file, layout_of
        from gripmon.record.written_file import WrittenFile, open_stream

        self._stream = self._stream or open_stream(self._scene)
        if self._layout is None:
            self._layout = layout_file(layout_of(self._scene))
            with self._asking_disk():
                self.notice = mend(self._budget)
        with self._asking_disk():
            with contextlib.suppress(OSError):  # reported below
                self._directory.mkdir(parents=True, exist_ok=True)  # it may have been removed
            missing = space_missing(self._directory, self._settings.min_free_bytes, _RESUME_FREE_FACTOR)
            missing = missing or self._write_pins() or self._budget.make_room(self._pins.holds)
            if missing:
                raise _Paused(missing)
            number = self._next_number()
            path = self._directory / f"{self._scene.name}-{number:04d}.rrd"
        self._file = WrittenFile(path, self._stream, self._scene, number, self._layout, self._asking_disk)
        self.path = str(path)

    def _next_number(self) -> int:
        """One above the highest so far, so that numbers of deleted files aren't reused."""
        numbered = re.compile(rf"{re.escape(self._scene.name)}-(\d{{4,}})\.rrd(?:{re.escape(PIN_SUFFIX)})?").fullmatch
        names = [path.name for path in (*self._directory.iterdir(), *(file.path for file in self._ended))]
        return 1 + max((int(match[1]) for match in map(numbered, names) if match), default=0)

    def _end(self) -> None:
        """Complete the file.  Raises OSError."""
        if self._file is None:
            return
        self._file.finish()
        self._leave()

    def _leave(self) -> None:
        """Keep what later alerts may pin."""
        assert self._file is not None
        if len(self._ended) == self._ended.maxlen:
            self._pins.forget(self._ended[0].path)
        self._ended.append(self._file)
        self._file = self.path = None

    def _pause(self, why: str) -> None:
        self.failure = why
        self._retry_at = time.monotonic() + self._retry_s

    def _fail(self, error: OSError) -> None:
        """End a file whose disk has failed, and remove it if it holds no frame."""
        file = self._file
        path = self._directory if file is None else file.path
        try:
            with self._asking_disk():
                free = f"{1e-6 * shutil.disk_usage(self._directory).free:.1f} MB free"
        except OSError as missing:
            free = str(missing.strerror)
        self._pause(f"recording failed: can't write {path} ({free}): {error.strerror or error}")
        self._retry_s = min(2.0 * self._retry_s, _LONGEST_RETRY_S)
        if file is not None:
            with contextlib.suppress(OSError):  # the same disk
                file.close()
            self._leave()
            if file.frames == 0:
                with contextlib.suppress(OSError), self._asking_disk():
                    file.path.unlink(missing_ok=True)
                    pin_path(file.path).unlink(missing_ok=True)

    def _lose(self, load: Load) -> None:
        """Count what could not be written but keep alerts, so that the next file says what happened."""
        self.frames_lost += len(load.rows)
        self.images_lost += len(load.late)
        self._unsaid = [*those(AlertRecord, load.events)[-_ALERTS_KEPT:]]

    @contextlib.contextmanager
    def _asking_disk(self) -> Iterator[None]:
        self.disk_asked_s = time.monotonic()
        try:
            yield
        finally:
            self.disk_asked_s = None
