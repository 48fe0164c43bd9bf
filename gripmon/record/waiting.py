"""Frames that wait in the daemon until they are handed to the recording process: a bounded queue, the newest win."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from gripmon.model.outputs import Notes, Trace
from gripmon.model.records import Frame, FrameRecord, Image, MeasurementTrace, State, Verdict
from gripmon.record.recorder import Picture, RecordingSettings, Row

Waiting = tuple[Row, Image | None, MeasurementTrace | None]
"""A frame, its image and its trace, None if they aren't kept: whoever takes them has the time to pack them."""
Beside = Callable[[Frame], tuple[FrameRecord, Picture | None]]
"""Of a frame that is replayed: its record of then, and its image as it was recorded."""


class WaitingFrames:
    """Filled by the loop's thread, emptied by another one; neither waits for the other.  Decides which images are due.

    ``offered`` counts all frames, ``dropped`` those that newer ones displaced, ``images_dropped`` images that were due,
    of other frames, for which there was no room.
    """

    def __init__(self, settings: RecordingSettings, beside: Beside | None = None) -> None:
        """``beside``: None if nothing is replayed; else every image is due, and written as it was recorded."""
        self._settings, self._beside = settings, beside
        self._keeps_before = settings.around_alert_s > 0.0
        # Images kept in case of an alert leave room for those that are due.
        self.images_before = max(1, settings.queue_images - settings.queue_images // 4)
        self._image_interval_ns = round(1e9 / settings.image_rate_hz) if settings.image_rate_hz > 0.0 else None
        self._image_stamp_ns: int | None = None
        self._shown: tuple[State, Verdict, str, int] | None = None
        self._frames: deque[Waiting] = deque()
        # Each is written by one of the threads only.
        self.offered = self.dropped = self.images_dropped = self._images_in = 0
        self._images_out = 0

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def has_room(self) -> bool:
        """Whether the next frame and its image would be accepted, and none displaced."""
        images = self.images_before if self._keeps_before else self._settings.queue_images
        return len(self._frames) < self._settings.queue_frames and self._images_in - self._images_out < images

    def offer(self, frame: Frame, record: FrameRecord, trace: Trace, notes: Notes | None) -> None:
        """Add a frame; its image and trace only as configured, and at events."""
        if len(self._frames) >= self._settings.queue_frames:
            self._drop_oldest()
        shown = (record.state, record.verdict, record.reference_id, record.revision)
        due = self._beside is not None or bool(
            self._image_is_due(record.stamp_ns) or record.alerts or shown != self._shown
        )
        self.offered += 1
        self._shown = shown
        # An image that isn't due is kept in case of an alert; its trace would cost the loop more than all else here.
        wanted = due or self._keeps_before
        room = self._settings.queue_images if due else self.images_before
        kept = wanted and self._images_in - self._images_out < room
        lost = wanted and not kept and frame.image is not None
        if kept and frame.image is not None:
            self._images_in += 1
        if kept and due:
            self._image_stamp_ns = record.stamp_ns
        self.images_dropped += due and lost
        measured, noted = trace() if kept and due else None, None if notes is None else notes()
        then, picture = (None, None) if self._beside is None else self._beside(frame)
        row = Row(
            record, picture if kept else None,
            jaw_reported_m=frame.jaw_opening_m, statistic_share=None if noted is None else noted.statistic_share,
            limits=None if noted is None else noted.limits, due=due, lost=lost, then=then,
        )  # fmt: skip
        self._frames.append((row, frame.image if kept else None, measured))

    @property
    def oldest(self) -> Waiting | None:
        """None if there is none."""
        try:
            return self._frames[0]
        except IndexError:
            return None

    def take(self) -> Waiting | None:
        """The oldest, which leaves; None if there is none."""
        try:
            waiting = self._frames.popleft()
        except IndexError:
            return None
        self._images_out += waiting[1] is not None
        return waiting

    def clear(self) -> None:
        self._frames.clear()

    def _drop_oldest(self) -> None:
        try:
            row, image, _ = self._frames.popleft()
        except IndexError:  # the other thread took it meanwhile
            return
        self.dropped += 1
        self._images_in -= image is not None
        self.images_dropped -= row.due and row.lost  # no longer one of another frame

    def _image_is_due(self, stamp_ns: int) -> bool:
        every = self._settings.image_every
        if every > 0 and self.offered % every == 0:
            return True
        if self._image_interval_ns is None:
            return False
        # A capture time that jumps backwards starts a new interval.
        return self._image_stamp_ns is None or not 0 <= stamp_ns - self._image_stamp_ns < self._image_interval_ns
