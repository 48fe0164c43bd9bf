"""The recording process's side of the pipe: takes batches from the daemon, encodes images, reports; no disk, no rerun.

It runs in a thread of its own from the process's first moments on: what the daemon handed over is safe from the
daemon's end while rerun is still imported, and the daemon hears of a disk that doesn't answer.
"""

from __future__ import annotations

import contextlib
import select
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection

import msgspec
from msgspec.structs import replace

from gripmon.model.outputs import Event
from gripmon.model.records import Alert, AlertRecord, ReferenceRecord
from gripmon.model.shared_images import SharedImages
from gripmon.record.keeping import Moments, PinnedBy, Trigger, pinned_by
from gripmon.record.pictures import PictureRing, encode_picture
from gripmon.record.recorder import Batch, RecordingSettings, Row, Status, those

_BEAT_PERIOD_S = 0.5  # longest time between two reports to the daemon
_ROWS_AT_ONCE = 128
_PICTURE_BYTES_AT_ONCE = 16_000_000
_MOST_PICTURE_BYTES = 64_000_000  # waiting for the disk
_SLOW_DISK_POLL_S = 0.01
_DISK_ANSWERS_WITHIN_S = 2.0
_STAMPS_KEPT = 4096


@dataclass
class Load:
    """What waits to be written.  ``late``: pictures of rows that were added before without them; ``pins``: alerts that
    pin files, with the capture time of their frame, None: there was no frame yet.
    """

    rows: list[Row] = field(default_factory=list)
    late: list[Row] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    pins: list[tuple[PinnedBy, int | None]] = field(default_factory=list)

    @property
    def picture_bytes(self) -> int:
        return sum(row.picture_bytes for row in self.rows) + sum(row.picture_bytes for row in self.late)


class Inbox:
    """Where one thread adds what another writes.  ``failure``: why nothing is written, None while all is well."""

    failure: str | None = None

    def __init__(self, reference: ReferenceRecord | None = None) -> None:
        """``reference``: the one in force, None: unknown."""
        self._reference = reference  # the newest that was taken
        self._changed = threading.Condition()
        self._load = Load()
        self._complete = False

    def add_frames(self, rows: Sequence[Row]) -> None:
        with self._changed:
            self._load.rows += rows
            self._bound(self._load)
            if self._much_waits():
                self._changed.notify_all()

    def add_pictures(self, rows: Sequence[Row]) -> None:
        """Pictures of frames that were added before without them."""
        with self._changed:
            self._load.late += rows
            self._bound(self._load)

    def add_events(self, events: Sequence[Event]) -> None:
        with self._changed:
            self._load.events += events

    def pin(self, alert: PinnedBy, stamp_ns: int | None) -> None:
        """Pin the files around this capture time (None: no frame yet): past, present and future ones."""
        with self._changed:
            self._load.pins.append((alert, stamp_ns))

    def end(self) -> None:
        """Nothing more will be added."""
        with self._changed:
            self._complete = True
            self._changed.notify_all()

    def serve(self, period_s: float, written: Callable[[], None] = lambda: None) -> None:
        """Write every so often, or when much waits, until the end; call ``written`` each time."""
        while not self._complete:
            self.write()
            written()
            with self._changed:
                self._changed.wait_for(self._much_waits, period_s)
        self.write()
        self.close()

    def write(self) -> None:
        """Write everything that was added."""
        raise NotImplementedError

    def close(self) -> None:
        """Called when everything is written."""

    def _taken(self) -> Load:
        with self._changed:
            load, self._load = self._load, Load()
        self._reference = [self._reference, *those(ReferenceRecord, load.events)][-1]
        return load

    def _with_reference(self, events: list[Event]) -> list[Event]:
        """What a stream begins with, and a live one repeats: the reference in force before all else."""
        known = self._reference
        return events if known is None or known in events else [known, *events]

    def _much_waits(self) -> bool:
        many = len(self._load.rows) >= _ROWS_AT_ONCE
        return self._complete or many or self._load.picture_bytes >= _PICTURE_BYTES_AT_ONCE

    def _bound(self, load: Load) -> None:
        """Drop what is too much."""


class FileInbox(Inbox):
    """What waits for the files: rows are bounded by the daemon, which counts what isn't written yet; pictures here.

    While recording is off and only the live view is wanted, this is all there is: frames are counted.
    """

    path: str | None = None
    notice: str | None = None
    """Findings about earlier files."""

    def __init__(self, directory: str, reference: ReferenceRecord | None = None) -> None:
        super().__init__(reference)
        self.directory = directory
        self.frames_written = self.frames_lost = self.images_lost = 0
        self.disk_asked_s: float | None = None
        """Since when the disk has been asked for something, monotonic; None: it isn't."""

    @property
    def disk_hangs(self) -> bool:
        asked_s = self.disk_asked_s
        return asked_s is not None and time.monotonic() - asked_s > _DISK_ANSWERS_WITHIN_S

    @property
    def full(self) -> bool:
        with self._changed:
            return self._load.picture_bytes > _MOST_PICTURE_BYTES

    def write(self) -> None:
        self.frames_written += len(self._taken().rows)

    def _bound(self, load: Load) -> None:
        if not self.disk_hangs or load.picture_bytes <= _MOST_PICTURE_BYTES:
            return
        self.images_lost += len(load.late) + sum(row.picture is not None for row in load.rows)
        load.late.clear()
        load.rows[:] = [replace(row, picture=None) for row in load.rows]


class Taker:
    """Takes batches until the daemon ends or closes the pipe; decides which pictures are written."""

    def __init__(
        self,
        settings: RecordingSettings,
        images: SharedImages,
        batches: Connection,
        reports: Connection,
        files: FileInbox,
        live: Inbox | None,
    ) -> None:
        self._settings, self._images, self._batches, self._reports = settings, images, batches, reports
        self._files, self._live = files, live
        self._inboxes: tuple[Inbox, ...] = (files,) if live is None else (files, live)
        self._around_ns = round(1e9 * settings.around_alert_s)
        self._moments = Moments(self._around_ns)
        self._before = PictureRing(self._around_ns, settings.ring_bytes)
        self._late: list[Row] = []
        self._without: deque[int] = deque(maxlen=_STAMPS_KEPT)  # capture times of images for which there was no room
        self._images_lost = self._images_done = 0
        self._trigger = Trigger()
        self._newest_ns: int | None = None
        self._decode = msgspec.msgpack.Decoder(Batch).decode

    def run(self) -> None:
        """Take everything until the daemon has closed its end; report until the process ends."""
        with contextlib.suppress(EOFError, OSError):
            while True:
                self.report()
                if self._batches.poll(_BEAT_PERIOD_S):
                    self._take(self._decode(self._batches.recv_bytes()))
        for inbox in self._inboxes:
            inbox.end()
        while True:
            time.sleep(_BEAT_PERIOD_S)
            self.report()

    def report(self) -> None:
        """Tell the daemon how it stands, unless it doesn't read."""
        files, failure = self._files, self._files.failure
        if files.disk_hangs:
            failure = f"recording pauses: the disk under {files.directory} doesn't answer"
        status = Status(
            path=files.path,
            failure=failure,
            frames=files.frames_written,
            frames_lost=files.frames_lost,
            images_done=self._images_done,
            view_failure=None if self._live is None else self._live.failure,
            notice=files.notice,
            images_lost=self._images_lost + files.images_lost,
            hangs=files.disk_hangs,
        )
        if select.select((), (self._reports,), (), 0.0)[1]:  # then it takes a message as short as this whole
            with contextlib.suppress(BrokenPipeError):
                self._reports.send_bytes(msgspec.json.encode(status))

    def _take(self, batch: Batch) -> None:
        for inbox in self._inboxes:
            inbox.add_events(batch.events)
        rows = [self._row(row) for row in batch.rows]
        for alert in those(AlertRecord, batch.events):
            # Its own stamp may be from another clock than that of the frames.
            self._on_alert(alert, alert.seq, alert.stamp_ns, self._newest_ns)
        late, self._late = self._late, []
        for inbox in self._inboxes:
            inbox.add_frames(rows)
            inbox.add_pictures(late)
        while self._files.full and not self._files.disk_hangs:  # a slow disk: who can wait does so
            time.sleep(_SLOW_DISK_POLL_S)
            self.report()

    def _row(self, row: Row) -> Row:
        """Around an alert every picture is written; otherwise those that are due, and the rest is kept for an alert."""
        record = row.record
        self._newest_ns = record.stamp_ns
        for alert in record.alerts:
            self._on_alert(alert, record.seq, record.stamp_ns, record.stamp_ns)
        if row.lost and not row.due:
            self._without.append(record.stamp_ns)
            self._count_lost()
        if row.image is None:
            return row
        pictured = replace(row, picture=encode_picture(self._images.get(row.image), self._settings), image=None)
        self._images_done += 1
        if row.due or self._is_near(record.stamp_ns):
            return pictured
        self._before.push(pictured)
        return row

    def _count_lost(self) -> None:
        """Count images around an alert that never arrived here."""
        missed = [stamp_ns for stamp_ns in self._without if self._is_near(stamp_ns)]
        self._images_lost += len(missed)
        for stamp_ns in missed:
            self._without.remove(stamp_ns)

    def _is_near(self, stamp_ns: int) -> bool:
        return self._around_ns > 0 and self._moments.near(stamp_ns)

    def _on_alert(self, alert: Alert | AlertRecord, seq: int, stamp_ns: int, near_ns: int | None) -> None:
        """If the alert triggers it, pin the files around it and write the pictures before it."""
        if not self._trigger.by(alert):
            return
        self._files.pin(pinned_by(alert, stamp_ns, seq), near_ns)
        if self._around_ns > 0 and near_ns is not None:
            self._moments.add(near_ns)
            self._count_lost()
            self._late += self._before.take(self._moments)
