"""The series of files of one recording: opens, fills and closes them, and copes with a full or dead disk."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import rerun as rr

from gripmon.model.errors import one_line
from gripmon.record.columns import APPLICATION_ID, Row, Writer
from gripmon.record.container import free_closed_streams, is_complete
from gripmon.record.keeping import (
    PIN_SUFFIX,
    DiskBudget,
    Moments,
    PinBoard,
    PinnedBy,
    claim,
    is_being_written,
    pin_path,
    repair,
    space_missing,
)
from gripmon.record.recorder import Events, Scene
from gripmon.record.rows import RowWriter
from gripmon.record.scene import layout_file

_FIRST_RETRY_S = 1.0
_LONGEST_RETRY_S = 30.0
_FLUSH_TIMEOUT_S = 2.0
_STALLED_FLUSH_TIMEOUT_S = 0.1
_DESCRIPTOR_POLL_S = 0.05
_PIN_AROUND_S = 5.0  # pinned before and after an alert at least, even if no images are kept around it
_FILES_REMEMBERED = 64
_PICTURES_A_CHUNK = 16
_ALERTS_KEPT = 64  # while nothing can be written: the next file then explains it
# Free space needed to resume, over the minimum: otherwise recording would start and stop at every flush.
_RESUME_FREE_FACTOR = 1.02


def make_writer(stream: rr.RecordingStream, scene: Scene, file_number: int) -> Writer:
    """The writer for this scene, which has written the static data."""
    return RowWriter(stream, scene, file_number)


@dataclass
class _File:
    """A file and the capture times in it."""

    path: Path
    lock: int | None
    begun_s: float
    first_ns: int | None = None
    last_ns: int | None = None
    frames: int = 0
    whole_bytes: int = 0

    def cover(self, rows: Sequence[Row]) -> None:
        stamps_ns = [row.record.stamp_ns for row in rows]
        known_ns = [stamp_ns for stamp_ns in (self.first_ns, self.last_ns) if stamp_ns is not None]
        if stamps_ns:
            self.first_ns, self.last_ns = min(stamps_ns + known_ns), max(stamps_ns + known_ns)

    def is_written(self) -> bool:
        """Whether rerun still has the file open: its writing thread ends with the first write that fails."""
        opened = (entry for entry in Path("/proc/self/fd").iterdir() if entry.name != str(self.lock))
        for entry in opened:
            with contextlib.suppress(OSError):  # closed meanwhile
                if entry.readlink() == self.path:
                    return True
        return False


class FileSeries:
    """``name-0001.rrd``, ``name-0002.rrd``, …  Frames that arrive while nothing can be written are counted as lost.

    All files of a series have one recording id, so that a viewer shows several of them as one recording.
    """

    def __init__(self, scene: Scene):
        rr.set_strict_mode(True)
        self._scene = scene
        self._layout = layout_file(scene)
        self._settings = settings = scene.settings
        self._directory = Path(scene.directory)
        self._budget = DiskBudget(self._directory, scene.robot, scene.camera, scene.name, settings.budget_bytes)
        self._pins = PinBoard()
        self._pinning = Moments(round(1e9 * max(settings.around_alert_s, _PIN_AROUND_S)))
        self._alerts: deque[PinnedBy] = deque(maxlen=_FILES_REMEMBERED)
        self._ended: deque[_File] = deque(maxlen=_FILES_REMEMBERED)
        self._file: _File | None = None
        self._stream: rr.RecordingStream | None = None
        self._writer: Writer | None = None
        self._rows: list[Row] = []
        self._late: list[Row] = []
        self._events = Events()
        self._newest_reference = scene.reference
        self._unflushed = 0
        self._stalled = False
        self._retry_s = _FIRST_RETRY_S
        self._retry_at = 0.0
        self.failure: str | None = None
        self.frames_written = 0
        self.frames_lost = 0
        self.images_lost = 0  # of frames that are written
        self.notice: str | None = None  # findings at the start
        self._hung: list[rr.RecordingStream] = []  # they would block forever when garbage collected
        self._mend()
        self._begin()

    @property
    def hangs(self) -> bool:
        """Whether rerun waits forever for a writer that has died: not even the process can exit cleanly."""
        return bool(self._hung)

    @property
    def path(self) -> str | None:
        return None if self._file is None else str(self._file.path)

    @property
    def frames_waiting(self) -> int:
        return len(self._rows)

    def add_frames(self, rows: Sequence[Row]) -> None:
        self._rows += rows

    def add_pictures(self, rows: Sequence[Row]) -> None:
        """Pictures of frames that were added before without them."""
        self._late += rows

    def add_events(self, events: Events) -> None:
        self._events += events
        if events.references:
            self._newest_reference = events.references[-1]

    def pin(self, alert: PinnedBy, stamp_ns: int | None) -> None:
        """Pin the files around this capture time (None: no frame yet): past, present and future ones."""
        self._alerts.append(alert)
        if stamp_ns is not None:
            self._pinning.add(stamp_ns)
        if self._file is not None:
            self._pins.pin(self._file.path, (alert,))
        for file in self._ended:
            if self._touches(file):
                self._pins.pin(file.path, (alert,))

    def write(self) -> None:
        """Write what has been added to disk; begin, end or change the file as needed."""
        if self._stream is None and time.monotonic() >= self._retry_at:
            self._begin()
        if self._stream is None or self._writer is None or self._file is None:
            self._lose()
            return
        if not self._stalled:  # what rerun holds already is written when the disk responds again
            self._unflushed += len(self._rows)
            self._file.cover(self._rows)
            self._writer.write(self._rows, self._events)
            self._rows, self._events = [], Events()
        whole = self._flush(self._stream, self._file)
        while whole and self._late:
            late, self._late = self._late[:_PICTURES_A_CHUNK], self._late[_PICTURES_A_CHUNK:]
            self._writer.write_pictures(late)
            whole = self._flush(self._stream, self._file)
            self.images_lost += len(late) * (self._file is None)  # the file was abandoned, and they are lost with it
        if whole and self._file is not None:
            self._maintain(self._file)
        elif self._backlog_full():
            self._lose()

    def close(self) -> None:
        """Complete the file: its footer lets readers load it without scanning it."""
        self._end()
        self._lose()

    def _flush(self, stream: rr.RecordingStream, file: _File) -> bool:
        """Whether everything sent is on disk.  A disk that fails ends the file; for one that stalls, this waits."""
        timeout_s = _STALLED_FLUSH_TIMEOUT_S if self._stalled else _FLUSH_TIMEOUT_S
        begun_s = time.monotonic()
        try:
            stream.flush(timeout_sec=timeout_s)
            file.whole_bytes = file.path.stat().st_size
        except Exception as error:  # noqa: BLE001 - rerun raises the same type for both; a failure comes at once
            timed_out = time.monotonic() - begun_s >= 0.9 * timeout_s
            if timed_out and file.is_written():
                self._stalled = True
                self.failure = f"recording pauses: the disk under {self._directory} doesn't answer"
                return False
            if timed_out:
                self._hung.append(stream)
            self._abandon(self._why_not(file.path, error))
            return False
        file.frames += self._unflushed
        self.frames_written += self._unflushed
        self._unflushed = 0
        self._stalled = False
        self.failure = None
        self._retry_s = _FIRST_RETRY_S
        return True

    def _backlog_full(self) -> bool:
        """Whether the backlog for a disk that doesn't respond exceeds its memory limit."""
        pictures = (row.picture for row in self._rows)
        picture_bytes = sum(len(picture.blob) for picture in pictures if picture is not None)
        return len(self._rows) > self._settings.queue_frames or picture_bytes > self._settings.ring_bytes

    def _maintain(self, file: _File) -> None:
        """Pin the file if an alert touches it; begin the next one if this is full, old, or over budget, or pause if the
        disk is full.
        """
        settings = self._settings
        if self._touches(file):
            self._pins.pin(file.path, tuple(self._alerts))
        if missing := self._write_pins() or space_missing(self._directory, settings.min_free_bytes):
            self._end()
            self._pause(missing)
            return
        old = file.frames > 0 and time.monotonic() - file.begun_s >= settings.max_file_s
        if file.whole_bytes >= settings.max_file_bytes or old or not self._fits(file):
            self._end()
            self._begin()

    def _fits(self, file: _File) -> bool:
        """Whether this file may grow within the budget."""
        if not self._budget.exceeded_by(file.whole_bytes):
            return True
        try:
            return not self._budget.make_room(self._pins.holds, file.path)
        except OSError:
            return True  # the next flush reports what is wrong with the directory

    def _touches(self, file: _File) -> bool:
        return file.first_ns is not None and self._pinning.near(file.first_ns, file.last_ns)

    def _write_pins(self) -> str:
        try:
            self._pins.write()
        except OSError as error:
            return f"can't pin in {self._directory}: {error.strerror}"
        return ""

    def _end(self) -> None:
        """Write the footer and end the file, unless its disk has failed: rerun would wait for it forever.  What is
        queued stays for the next file.
        """
        stream, file = self._stream, self._file
        if stream is not None and self._writer is not None and file is not None:
            self._writer.finish()
            if not self._stalled:
                self._flush(stream, file)
            if self._file is None:  # abandoned
                return
            ending = threading.Thread(target=stream.disconnect, daemon=True)
            ending.start()
            while ending.is_alive() and file.is_written():
                ending.join(_DESCRIPTOR_POLL_S)
            ending.join(_FLUSH_TIMEOUT_S)
            if ending.is_alive():
                self._hung.append(stream)
                self._abandon(self._why_not(file.path, OSError("its end could not be written")))
        self._leave()

    def _leave(self) -> None:
        self._stream = self._writer = None
        if self._file is not None:
            if self._file.lock is not None:
                os.close(self._file.lock)
                self._file.lock = None
            if len(self._ended) == self._ended.maxlen:
                self._pins.forget(self._ended[0].path)
            self._ended.append(self._file)
        self._file = None
        self._stalled = False

    def _begin(self) -> None:
        """Open the next file and write what every file needs: the layout, static data, the reference."""
        with contextlib.suppress(OSError):  # reported below
            self._directory.mkdir(parents=True, exist_ok=True)  # it may have been removed
        missing = space_missing(self._directory, self._settings.min_free_bytes, _RESUME_FREE_FACTOR)
        missing = missing or self._room_missing()
        number = 0 if missing else self._next_number()
        if missing or number == 0:
            self._pause(missing or f"{self._directory} can't be read")
            return
        path = self._directory / f"{self._scene.name}-{number:04d}.rrd"
        stream = rr.RecordingStream(APPLICATION_ID, recording_id=self._scene.recording_id)
        begun_s = time.monotonic()
        try:
            stream.set_sinks(rr.FileSink(path))
            stream.send_recording_name(self._scene.name)
            stream.log_file_from_contents("layout.rbl", self._layout)
            writer = make_writer(stream, self._scene, number)
            stream.flush(timeout_sec=_FLUSH_TIMEOUT_S)
        except Exception as error:  # noqa: BLE001 - as above
            if time.monotonic() - begun_s >= 0.9 * _FLUSH_TIMEOUT_S and not _File(path, None, begun_s).is_written():
                self._hung.append(stream)
            del stream
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
            self._fail(self._why_not(path, error))
            return
        if self._newest_reference not in self._events.references:
            self._events = Events.at_first(self._newest_reference) + self._events
        self._stream, self._writer = stream, writer
        self._file = _File(path, claim(path), time.monotonic())
        self.failure = None
        free_closed_streams()  # of earlier files

    def _why_not(self, path: Path, error: Exception) -> str:
        """rerun only reports that its thread has ended; the free space explains the rest."""
        try:
            free = f"{1e-6 * shutil.disk_usage(self._directory).free:.1f} MB free"
        except OSError as missing:
            free = str(missing.strerror)
        return f"can't write {path} ({free}): {one_line(error)}"

    def _room_missing(self) -> str:
        try:
            return self._write_pins() or self._budget.make_room(self._pins.holds)
        except OSError as error:
            return f"{self._directory}: {error.strerror}"

    def _abandon(self, why: str) -> None:
        """Give up a file that can no longer be written: cut off its incomplete last message, because of which readers
        would reject the file.  A file without frames is deleted.
        """
        file = self._file
        self.frames_lost += self._unflushed
        self._unflushed = 0
        self._leave()
        if file is not None:
            with contextlib.suppress(OSError):  # the same disk; a later start repairs it
                if file.frames == 0:
                    file.path.unlink(missing_ok=True)
                    pin_path(file.path).unlink(missing_ok=True)
                elif file.path.stat().st_size > file.whole_bytes:
                    os.truncate(file.path, file.whole_bytes)
        self._fail(why)

    def _pause(self, why: str) -> None:
        self.failure = f"recording pauses: {why}"
        self._retry_at = time.monotonic() + self._retry_s

    def _fail(self, why: str) -> None:
        self.failure = f"recording failed: {why}"
        self._retry_at = time.monotonic() + self._retry_s
        self._retry_s = min(2.0 * self._retry_s, _LONGEST_RETRY_S)

    def _lose(self) -> None:
        """Drop queued frames but keep alerts, so that the next file says what happened."""
        self.frames_lost += len(self._rows)
        self.images_lost += len(self._late)
        self._rows, self._late, self._events = [], [], Events(alerts=self._events.alerts[-_ALERTS_KEPT:])

    def _mend(self) -> None:
        """Repair earlier files of this robot and camera whose writer was killed, and delete pins without a file."""
        with contextlib.suppress(OSError):  # errors of the directory are reported when the first file begins
            paths = [entry.path for entry in self._budget.recordings()]
            for path in paths:
                repair(path)
            lacking = [path for path in paths if not is_complete(path) and not is_being_written(path)]
            if lacking:
                self.notice = (
                    f"{len(lacking)} earlier recordings have no footer, as their recorder was killed, the newest "
                    f"{lacking[-1]}; gripmon and rerun's viewer read them; for tools that need one: "
                    "rerun rrd optimize FILE.rrd -o WHOLE.rrd"
                )
            for pin in self._budget.orphaned_pins():
                pin.unlink(missing_ok=True)

    def _next_number(self) -> int:
        """One above the highest so far, so that numbers of deleted files aren't reused.  0: they can't be listed."""
        numbered = re.compile(rf"{re.escape(self._scene.name)}-(\d{{4,}})\.rrd(?:{re.escape(PIN_SUFFIX)})?").fullmatch
        try:
            found = [numbered(path.name) for path in self._directory.iterdir()]
        except OSError:
            return 0
        own = [numbered(file.path.name) for file in self._ended]
        return 1 + max((int(match[1]) for match in (*found, *own) if match), default=0)
