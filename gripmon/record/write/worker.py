"""The recording process: reads batches from the daemon, encodes images, writes files; ends when its input does."""

from __future__ import annotations

import os
import select
import signal
import sys
import time
from collections import deque
from dataclasses import replace

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Alert, AlertRecord, FrameRecord, Limits
from gripmon.record.write.columns import AnyRow, Picture, Row, SpotRow
from gripmon.record.write.files import FileSeries
from gripmon.record.write.live import LiveStream, NoFiles
from gripmon.record.write.pins import pinned_by
from gripmon.record.write.ring import Moments, PictureRing, Trigger
from gripmon.record.write.settings import RecordingSettings
from gripmon.record.write.wire import Batch, FrameNote, ImageRing, Scene, Status, Unframer

_NICENESS = 5  # the loop goes first when both want the same core; at 10 a busy machine kept it waiting for seconds
_STDIN = 0
_FRAMES_A_WRITE = 128
_STAMPS_KEPT = 4096
_REPORT_PERIOD_S = 1.0  # the daemon must hear something


def main(status_descriptor: int, memory_descriptor: int) -> None:
    """Entry of the process; standard input carries the messages."""
    # The end of the input is the one sign to end: a Ctrl-C is meant for the daemon, which then closes its end.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    os.nice(_NICENESS)
    cv2.setNumThreads(1)
    code = 0
    loop = RecordingLoop(status_descriptor, memory_descriptor)
    try:
        loop.run()
    except Exception as error:  # noqa: BLE001 - one line, and the daemon starts another process
        sys.stderr.write(f"recording process: {type(error).__name__}: {error}\n")
        code = 1
    if not loop.hangs:
        del loop  # a stream that is let go waits until its file is whole, or for ever if its writer has died
    os._exit(code)  # all is written, or can't be


class RecordingLoop:
    def __init__(self, status_descriptor: int, memory_descriptor: int):
        self._status_descriptor = status_descriptor
        self._memory_descriptor = memory_descriptor
        self._unframer = Unframer()
        self._scene: Scene | None = None
        self._files: FileSeries | NoFiles
        self._live: LiveStream | None = None
        self._ring: ImageRing
        self._moments: Moments
        self._before: PictureRing
        self._without: deque[int] = deque(maxlen=_STAMPS_KEPT)  # capture times of images that had no room
        self._images_lost = 0
        self._decode = msgspec.msgpack.Decoder(Batch).decode
        self._encode = msgspec.json.Encoder().encode
        self._images_done = 0
        self._limits: Limits | None = None
        self._around_ns = 0
        self._trigger = Trigger()
        self._newest_ns: int | None = None
        self._flush_period_s = 0.1
        self._parent_listens = True

    def run(self) -> None:
        next_flush = next_report = time.monotonic() + self._flush_period_s
        ended = False
        while not ended and not self.hangs:
            next_turn = min(next_flush, next_report)
            readable, _, _ = select.select((_STDIN,), (), (), max(next_turn - time.monotonic(), 0.0))
            if readable:
                part = os.read(_STDIN, 1 << 20)
                ended = not part
                for payload in self._unframer.feed(part):
                    self._take(payload)
                    if self._scene is not None and self._files.frames_waiting >= _FRAMES_A_WRITE:
                        # Who gathers more than he can write in time falls silent and grows.
                        self._files.write()
                        self._report()
            if self._scene is not None and (ended or time.monotonic() >= next_flush):
                for receiver in self._receivers():
                    receiver.write()
                next_report = time.monotonic()
                next_flush = next_report + self._flush_period_s
            if time.monotonic() >= next_report:
                self._report()
                next_report = time.monotonic() + _REPORT_PERIOD_S
        if self._scene is not None:
            self._files.close()
            if self._live is not None:
                self._live.close()
            self._report()

    @property
    def hangs(self) -> bool:
        """Whether rerun waits for ever for a writer that has died."""
        return self._scene is not None and self._files.hangs

    def _take(self, payload: bytes) -> None:
        if self._scene is None:
            self._scene = scene = msgspec.msgpack.decode(payload, type=Scene)
            self._flush_period_s = scene.settings.flush_period_s
            self._ring = ImageRing.for_camera(
                scene.width_px, scene.height_px, scene.settings.queue_images, self._memory_descriptor
            )
            self._around_ns = round(1e9 * scene.settings.around_alert_s)
            self._moments = Moments(self._around_ns)
            self._before = PictureRing(self._around_ns, scene.settings.ring_bytes)
            self._files = FileSeries(scene) if scene.settings.enabled else NoFiles()
            self._live = None if scene.view is None else LiveStream(scene, scene.view)
            return
        batch = self._decode(payload)
        for receiver in self._receivers():
            receiver.add_events(batch.events)
        for note in batch.frames:
            self._take_frame(note)
        for alert in batch.events.alerts:
            # Its own stamp may be of another clock than the frames'.
            self._heed(alert, alert.seq, alert.stamp_ns, self._newest_ns)

    def _take_frame(self, note: FrameNote) -> None:
        """Around an alert every picture is written; of the others those that are due, the rest waits for an alert."""
        assert self._scene is not None
        record, picture = note.record, None
        self._newest_ns = record.stamp_ns
        for alert in record.alerts:
            self._heed(alert, record.seq, record.stamp_ns, record.stamp_ns)
        if note.image is not None:
            picture = encode_picture(self._ring.get(note.image), self._scene.settings)
            self._images_done += 1
            self._report()  # its slot is free
        self._limits = note.limits or self._limits
        row: AnyRow
        if isinstance(record, FrameRecord):
            row = Row(
                record, picture, note.trace, note.truth_tcp_m, note.jaw_reported_m, note.statistic_share, self._limits
            )
        else:
            row = SpotRow(record, picture)
        if note.lost and not note.due:
            self._without.append(record.stamp_ns)
            self._count_lost()
        if picture is not None and not note.due and not self._is_near(record.stamp_ns):
            self._before.push(row)
            row = replace(row, picture=None)
        for receiver in self._receivers():
            receiver.add_frames([row])

    def _count_lost(self) -> None:
        """Images around an alert that never came here."""
        missed = [stamp_ns for stamp_ns in self._without if self._is_near(stamp_ns)]
        self._images_lost += len(missed)
        for stamp_ns in missed:
            self._without.remove(stamp_ns)

    def _is_near(self, stamp_ns: int) -> bool:
        return self._around_ns > 0 and self._moments.near(stamp_ns)

    def _heed(self, alert: Alert | AlertRecord, seq: int, stamp_ns: int, near_ns: int | None) -> None:
        """Of an alert that is worth it: pin the files around it, and write the pictures before it."""
        if not self._trigger.by(alert):
            return
        self._files.pin(pinned_by(alert, stamp_ns, seq), near_ns)
        if self._around_ns > 0 and near_ns is not None:
            self._moments.add(near_ns)
            self._count_lost()
            pictures = self._before.take(self._moments)
            for receiver in self._receivers():
                receiver.add_pictures(pictures)

    def _receivers(self) -> tuple[FileSeries | NoFiles | LiveStream, ...]:
        return (self._files,) if self._live is None else (self._files, self._live)

    def _report(self) -> None:
        if self._scene is None:
            return
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
                os.write(self._status_descriptor, self._encode(status) + b"\n")
            except BrokenPipeError:
                self._parent_listens = False


def encode_picture(image: NDArray[np.generic], settings: RecordingSettings) -> Picture:
    """Compress an image and measure what tells of its quality (on 8-bit grey values)."""
    shown = to_8_bit(image)
    if settings.image_format == "png":
        exact = image.astype(np.uint16, copy=False) if image.dtype == np.uint16 else shown
        _, blob = cv2.imencode(".png", exact, (cv2.IMWRITE_PNG_COMPRESSION, 1))
    else:
        _, blob = cv2.imencode(".jpg", shown, (cv2.IMWRITE_JPEG_QUALITY, settings.jpeg_quality))
    return measured_picture(blob.tobytes(), f"image/{settings.image_format}", shown)


def measured_picture(blob: bytes, media_type: str, image: NDArray[np.generic]) -> Picture:
    """An encoded image with what tells of the quality of its pixels."""
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


def to_8_bit(image: NDArray[np.generic]) -> NDArray[np.uint8]:
    """uint16 by its upper byte, float from 0..1; for looking only, so values beyond the range, NaN too, are clipped."""
    if image.dtype == np.uint8:
        return image.astype(np.uint8, copy=False)
    if image.dtype == np.uint16:
        return (image.astype(np.uint16, copy=False) >> 8).astype(np.uint8)
    scaled = np.nan_to_num(image.astype(np.float32, copy=False) * np.float32(255.0), nan=0.0)
    return np.clip(np.rint(scaled), 0.0, 255.0).astype(np.uint8)
