"""The recording process: reads batches from the daemon, encodes images, writes files; ends when its input ends.

With the live view on, the rows are also sent to rerun viewers that connect, without ever delaying the files.
"""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import cv2
import msgspec
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from gripmon.model.errors import in_short, one_line
from gripmon.model.priority import give_way
from gripmon.model.records import Alert, AlertRecord, Limits
from gripmon.record.columns import APPLICATION_ID, Picture, Row, Writer
from gripmon.record.files import FileSeries, make_writer
from gripmon.record.keeping import Moments, PictureRing, Trigger, pinned_by
from gripmon.record.process import ImageRing, Unframer
from gripmon.record.recorder import (
    LOOPBACK,
    Batch,
    Events,
    FrameNote,
    RecordingSettings,
    Scene,
    Status,
    ViewSettings,
    to_8_bit,
)
from gripmon.record.scene import make_blueprint

_STDIN = 0
_READ_BYTES = 1 << 20
_FRAMES_A_WRITE = 128
_STAMPS_KEPT = 4096
_REPORT_PERIOD_S = 1.0  # a sign of life for the daemon

_FLUSH_TIMEOUT_S = 1.0
_REPEAT_S = 60.0  # what is sent on change only is sent again, for viewers that join after it was dropped
_RETRY_S = 10.0
_ROWS_WAITING = 512
_WAITING_MEMORY_FRACTION = 0.25  # of the view's memory limit, for the pictures of queued rows
_CLOSE_S = 2.0


def main(status_descriptor: int, memory_descriptor: int) -> None:
    """Entry point of the process; messages arrive on standard input."""
    # Only the end of the input ends this process: Ctrl-C is meant for the daemon, which then closes the pipe.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    give_way()
    cv2.setNumThreads(1)
    unframer, payloads, code = Unframer(), list[bytes](), 0
    while not payloads:
        if not (part := os.read(_STDIN, _READ_BYTES)):
            os._exit(0)
        payloads += unframer.feed(part)
    loop: RecordingLoop | None = None
    try:
        scene = msgspec.msgpack.decode(payloads[0], type=Scene)
        loop = RecordingLoop(scene, status_descriptor, memory_descriptor)
        loop.run(unframer, payloads[1:])
    except Exception as error:  # noqa: BLE001 - reported in one line; the daemon starts another process
        sys.stderr.write(f"recording process: {in_short(error)}\n")
        code = 1
    if loop is None or not loop.hangs:
        del loop  # a released stream waits until its file is complete, or forever if its writer has died
    os._exit(code)  # everything is written, or can't be


class RecordingLoop:
    """Reads batches and passes their rows to the files and the live view."""

    def __init__(self, scene: Scene, status_descriptor: int, memory_descriptor: int):
        self._settings = settings = scene.settings
        self._status_descriptor = status_descriptor
        self._ring = ImageRing(scene.lens.width_px, scene.lens.height_px, settings.queue_images, memory_descriptor)
        self._around_ns = round(1e9 * settings.around_alert_s)
        self._moments = Moments(self._around_ns)
        self._before = PictureRing(self._around_ns, settings.ring_bytes)
        self._without: deque[int] = deque(maxlen=_STAMPS_KEPT)  # capture times of images for which there was no room
        self._images_lost = self._images_done = 0
        self._limits: Limits | None = None
        self._trigger = Trigger()
        self._newest_ns: int | None = None
        self._parent_listens = True
        self._decode = msgspec.msgpack.Decoder(Batch).decode
        self._files = FileSeries(scene) if settings.enabled else NoFiles()
        self._live = None if scene.view is None else LiveStream(scene, scene.view)
        self._receivers = (self._files,) if self._live is None else (self._files, self._live)

    @property
    def hangs(self) -> bool:
        """Whether rerun waits forever for a writer that has died."""
        return self._files.hangs

    def run(self, unframer: Unframer, payloads: list[bytes]) -> None:
        """Run until the input ends; ``payloads`` arrived together with the scene."""
        next_flush = next_report = time.monotonic()
        ended = False
        while not ended and not self.hangs:
            for payload in payloads:
                self._take(payload)
                if self._files.frames_waiting >= _FRAMES_A_WRITE:
                    # A process that queues more than it can write sends no status and grows in memory.
                    self._files.write()
                    self._report()
            payloads = []
            if time.monotonic() >= next_flush:
                self._write()
                next_report = time.monotonic()
                next_flush = next_report + self._settings.flush_period_s
            if time.monotonic() >= next_report:
                self._report()
                next_report = time.monotonic() + _REPORT_PERIOD_S
            wait_s = max(min(next_flush, next_report) - time.monotonic(), 0.0)
            if select.select((_STDIN,), (), (), wait_s)[0]:
                part = os.read(_STDIN, _READ_BYTES)
                ended = not part
                payloads += unframer.feed(part)
        if not self.hangs:
            self._write()
        self._files.close()
        if self._live is not None:
            self._live.close()
        self._report()

    def _write(self) -> None:
        for receiver in self._receivers:
            receiver.write()

    def _take(self, payload: bytes) -> None:
        batch = self._decode(payload)
        for receiver in self._receivers:
            receiver.add_events(batch.events)
        for note in batch.frames:
            self._take_frame(note)
        for alert in batch.events.alerts:
            # Its own stamp may be from another clock than that of the frames.
            self._on_alert(alert, alert.seq, alert.stamp_ns, self._newest_ns)

    def _take_frame(self, note: FrameNote) -> None:
        """Around an alert every picture is written; otherwise those that are due, and the rest is kept for an alert."""
        record, picture = note.record, None
        self._newest_ns = record.stamp_ns
        for alert in record.alerts:
            self._on_alert(alert, record.seq, record.stamp_ns, record.stamp_ns)
        if note.image is not None:
            picture = encode_picture(self._ring.get(note.image), self._settings)
            self._images_done += 1
            self._report()  # its slot is free
        self._limits = note.limits or self._limits
        row: Row
        row = Row(
            record, picture, note.trace, note.truth_tcp_m, note.jaw_reported_m, note.statistic_share, self._limits
        )
        if note.lost and not note.due:
            self._without.append(record.stamp_ns)
            self._count_lost()
        if picture is not None and not note.due and not self._is_near(record.stamp_ns):
            self._before.push(row)
            row = replace(row, picture=None)
        for receiver in self._receivers:
            receiver.add_frames([row])

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
            pictures = self._before.take(self._moments)
            for receiver in self._receivers:
                receiver.add_pictures(pictures)

    def _report(self) -> None:
        files = self._files
        status = Status(
            path=files.path,
            failure=files.failure,
            frames=files.frames_written,
            frames_lost=files.frames_lost,
            images_done=self._images_done,
            view_failure=None if self._live is None else self._live.failure,
            notice=files.notice,
            images_lost=self._images_lost + files.images_lost,
        )
        if self._parent_listens:
            try:
                os.write(self._status_descriptor, msgspec.json.encode(status) + b"\n")
            except BrokenPipeError:
                self._parent_listens = False


class NoFiles:
    """Replaces the files when recording is off and only the live view is wanted."""

    path = failure = notice = None
    frames_lost = frames_waiting = images_lost = 0
    hangs = False

    def __init__(self) -> None:
        self.frames_written = 0

    def add_frames(self, rows: Sequence[Row]) -> None:
        self.frames_written += len(rows)

    def add_pictures(self, rows: Sequence[Row]) -> None: ...
    def add_events(self, events: Events) -> None: ...
    def pin(self, *_alert: object) -> None: ...
    def write(self) -> None: ...
    def close(self) -> None: ...


class LiveStream:
    """Serves rows to viewers.  What can't be served is dropped; ``failure`` says why, None while all is well.

    The server keeps what it has sent up to a limit and drops the oldest data.  A stalled viewer blocks the server, so
    a separate thread waits for it, and rows that arrive meanwhile are not shown.  The stream is separate from that of
    the files, which may begin and end without viewers noticing.
    """

    def __init__(self, scene: Scene, settings: ViewSettings):
        self._scene, self._settings = scene, settings
        self._lock = threading.Condition()  # guards what follows
        self._rows: list[Row] = []
        self._late: list[Row] = []
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

    def add_frames(self, rows: Sequence[Row]) -> None:
        with self._lock:
            self._rows = self._bounded([*self._rows, *rows])

    def add_pictures(self, rows: Sequence[Row]) -> None:
        """Pictures of frames that were added before without them."""
        with self._lock:
            self._late = self._bounded([*self._late, *rows])

    def add_events(self, events: Events) -> None:
        with self._lock:
            self._events += events

    def write(self) -> None:
        """Let the thread send what has been added; returns immediately."""
        with self._lock:
            self._due = True
            self._lock.notify()

    def close(self) -> None:
        """Send the rest and end the server, unless a viewer still blocks it after some seconds."""
        with self._lock:
            self._due = self._ending = True
            self._lock.notify()
        self._thread.join(_CLOSE_S)

    def _bounded(self, rows: list[Row]) -> list[Row]:
        """The newest rows, as many as the limits allow."""
        left_bytes, kept = _WAITING_MEMORY_FRACTION * self._settings.memory_limit_bytes, 0
        for row in reversed(rows[-_ROWS_WAITING:]):
            left_bytes -= 0 if row.picture is None else len(row.picture.blob)
            if left_bytes < 0:
                break
            kept += 1
        return rows[len(rows) - kept :]

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

    def _send(self, rows: list[Row], late: list[Row], events: Events) -> None:
        """Start or restart the stream if due, and send; a server that a viewer blocks gets nothing more."""
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
        except Exception as error:  # noqa: BLE001 - rerun raises its own types; none may affect the files
            self._stream = self._writer = None
            self._stalled = False
            self._retry_at = now_s + _RETRY_S
            self.failure = f"the live view can't be served on {LOOPBACK}:{self._settings.port} ({one_line(error)})"

    def _flush(self, stream: rr.RecordingStream) -> None:
        """Wait until everything is sent; a server that is gone fails at once, a blocked one after a timeout."""
        begun_s, was_stalled = time.monotonic(), self._stalled
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


def encode_picture(image: NDArray[np.generic], settings: RecordingSettings) -> Picture:
    """Compress an image and compute its quality statistics (on 8-bit grey values)."""
    shown = to_8_bit(image)
    if settings.image_format == "png":
        exact = image.astype(np.uint16, copy=False) if image.dtype == np.uint16 else shown
        _, blob = cv2.imencode(".png", exact, (cv2.IMWRITE_PNG_COMPRESSION, 1))
    else:
        _, blob = cv2.imencode(".jpg", shown, (cv2.IMWRITE_JPEG_QUALITY, settings.jpeg_quality))
    return measured_picture(blob.tobytes(), f"image/{settings.image_format}", shown)


def measured_picture(blob: bytes, media_type: str, image: NDArray[np.generic]) -> Picture:
    """An encoded image with the quality statistics of its pixels."""
    shown = to_8_bit(image)
    grey = shown if shown.ndim == 2 else cv2.cvtColor(shown, cv2.COLOR_BGR2GRAY)
    mean, deviation = cv2.meanStdDev(grey)
    laplacian = cv2.Laplacian(grey, cv2.CV_16S)
    return Picture(
        blob=blob,
        media_type=media_type,
        mean_grey=float(mean[0, 0]),
        contrast_grey=float(deviation[0, 0]),
        saturated_percent=100.0 * float(np.count_nonzero(grey >= 254)) / grey.size,
        sharpness=float(cv2.meanStdDev(laplacian)[1][0, 0]),
    )
