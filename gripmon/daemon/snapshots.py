"""Replies to ``snapshot``: the loop passes on the newest frame, and a thread encodes its image."""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
import time
from collections.abc import Callable
from typing import NamedTuple

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from gripmon.daemon.mount import at_reference, to_stand_at
from gripmon.daemon.neighbours import Asked
from gripmon.io.publish.presence import CLOSE_WITHIN_S
from gripmon.model.errors import in_short
from gripmon.model.geometry import from_record
from gripmon.model.priority import give_way
from gripmon.model.records import (
    Array,
    CommandError,
    CommandFault,
    CommandReply,
    Frame,
    FrameRecord,
    Outlines,
    Snapshot,
    SnapshotImage,
)

_log = logging.getLogger(__name__)

LARGEST_EXACT_BYTES = 32 << 20
"""Larger images are sent as JPEG with 8 bits: a PNG would take seconds, and is hardly smaller than the pixels."""

_LARGEST_FILE_BYTES = 40 << 20
_JPEG_QUALITY = 95
_WAITING_MOST = 2
_PIXELS = {("uint8", 2): "mono8", ("uint16", 2): "mono16", ("uint8", 3): "bgr8", ("uint16", 3): "bgr16"}


OutlinesOf = Callable[[Array | None, float | None], Outlines]
"""The gripper's visible edges for a ``cam_T_grip`` (4, 4) and a jaw opening (m); none without a transform."""


def no_outlines(_cam_T_grip: Array | None, _jaw_opening_m: float | None) -> Outlines:
    """Where nobody draws."""
    return ()


class Newest(NamedTuple):
    """The newest frame, its record, and when it was judged (monotonic)."""

    frame: Frame
    record: FrameRecord
    judged_s: float


class _Job(NamedTuple):
    asked: Asked
    reply: CommandReply
    newest: Newest
    asked_s: float


class Snapshots:
    """Completes replies in a separate thread, started on demand."""

    def __init__(self, outlines: OutlinesOf = no_outlines) -> None:
        self._outlines = outlines
        self._jobs: queue.Queue[_Job | None] = queue.Queue(_WAITING_MOST)
        self._thread: threading.Thread | None = None

    def answer(self, asked: Asked, reply: CommandReply, newest: Newest | None) -> None:
        """Send the reply with the newest frame and its record, later; refuse if there is no frame."""
        if newest is None:
            asked.answer(msgspec.structs.replace(reply, done=False, text="no frame has come yet", monitor=None))
            return
        try:
            self._jobs.put_nowait(_Job(asked, reply, newest, time.monotonic()))
        except queue.Full:
            text = f"{_WAITING_MOST} snapshots are being made; try again later"
            asked.answer(CommandError(CommandFault.BUSY, text))
            return
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="gripmon-snapshots", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Complete pending replies, within a second each for queue and thread."""
        if self._thread is not None:
            with contextlib.suppress(queue.Full):
                self._jobs.put(None, timeout=CLOSE_WITHIN_S)
            self._thread.join(CLOSE_WITHIN_S)

    def _run(self) -> None:
        give_way()
        while (job := self._jobs.get()) is not None:
            try:
                _complete(job, self._outlines)
            except Exception as error:  # noqa: BLE001  reported to the sender
                _log.debug("snapshot", exc_info=error)
                job.asked.answer(CommandError(CommandFault.INTERNAL, in_short(error)))


def _complete(job: _Job, outlines: OutlinesOf) -> None:
    frame, record, judged_s = job.newest
    image, data, summary = None, None, f"no image ({frame.fault or 'not one that can be kept'})"
    if (encoded := encode(frame.image)) is not None:
        image, data = encoded
        summary = f"{image.width_px} x {image.height_px} px, {image.encoding}, {image.size_bytes} bytes"
    age_s = job.asked_s - judged_s
    measured = None if record.measured_T is None else from_record(record.measured_T)
    wanted = None
    if job.reply.mount is not None and job.reply.monitor is not None:
        wanted = at_reference(record, to_stand_at(job.reply.monitor.references))
    lines, wanted_lines = (outlines(pose, record.jaw_opening_m) for pose in (measured, wanted))
    snapshot = Snapshot(record, age_s, frame.jaw_opening_m, image, lines, wanted_lines)
    text = f"frame {frame.seq}, {age_s:.2f} s old, {record.state}, transform {record.verdict}: {summary}"
    job.asked.answer(msgspec.structs.replace(job.reply, text=text, snapshot=snapshot), data)


def encode(image: object) -> tuple[SnapshotImage, bytes] | None:
    """Encode an image (H, W) or (H, W, 3), BGR, uint8, uint16 or float32 in 0..1; None for anything else.

    PNG with the exact pixels, floats rounded to 16 bits; JPEG above :data:`LARGEST_EXACT_BYTES`, and None if even that
    is too large for a reply.
    """
    pixels = _integers(image)
    if pixels is None:
        return None
    exact = pixels.nbytes <= LARGEST_EXACT_BYTES
    if exact:
        done, file = cv2.imencode(".png", pixels, (cv2.IMWRITE_PNG_COMPRESSION, 1))
    else:
        pixels = (pixels >> 8).astype(np.uint8) if pixels.dtype == np.uint16 else pixels
        done, file = cv2.imencode(".jpg", pixels, (cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY))
    if not done or file.nbytes > _LARGEST_FILE_BYTES:
        return None
    height_px, width_px = pixels.shape[:2]
    layout = _PIXELS[str(pixels.dtype), pixels.ndim]
    data = file.tobytes()
    return SnapshotImage("png" if exact else "jpeg", width_px, height_px, layout, len(data)), data


def _integers(image: object) -> NDArray[np.uint8] | NDArray[np.uint16] | None:
    if not isinstance(image, np.ndarray) or image.size == 0:
        return None
    if not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)):
        return None
    if image.dtype == np.float32:
        scaled = np.nan_to_num(image * np.float32(65535.0), nan=0.0, posinf=65535.0, neginf=0.0)
        return np.clip(np.rint(scaled), 0.0, 65535.0).astype(np.uint16)
    return image if image.dtype in (np.uint8, np.uint16) else None
