"""The daemon's side: take frames without blocking, hand them over to the recording process."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, TypeVar

import msgspec

from gripmon.model.records import (
    AlertRecord,
    Frame,
    FrameRecord,
    Image,
    MeasurementTrace,
    MonitorNotes,
    RecordedCommand,
    ReferenceRecord,
    SpotRecord,
    State,
    StateRecord,
    Verdict,
)
from gripmon.record.write.health import Health
from gripmon.record.write.process import WorkerProcess
from gripmon.record.write.recorder import Notes, Trace
from gripmon.record.write.wire import (
    EncodedBatch,
    Events,
    FrameNote,
    ImageNote,
    ImageRing,
    Scene,
    pack_trace,
)

_log = logging.getLogger(__name__)

HANDOVER_PERIOD_S = 0.05
BATCH_FRAMES = 16
LONGEST_RESTART_PAUSE_S = 30.0
_ROOM_POLL_S = 0.002
_STOPPED_TIMEOUT_S = 2.0
_FRAMES_A_TURN = 4
_SAY_LOSSES_EVERY_S = 60.0
_EVENTS_KEPT = 256

Vector = tuple[float, float, float]
Truth = Callable[[int], Vector | None]


class _Waiting(NamedTuple):
    """A frame in the queue; ``counted`` among the images that wait, ``due`` its image, not only around an alert;
    ``lost`` its image, for want of room.
    """

    record: FrameRecord | SpotRecord
    counted: bool
    image: Image | None
    trace: MeasurementTrace | None
    jaw_reported_m: float | None
    notes: MonitorNotes | None
    due: bool
    lost: bool = False


_T = TypeVar("_T")


class ProcessRecorder:
    """Records through a process of its own.

    ``offer`` costs the same for every image size: it keeps a reference to the frame's array (which nobody changes after
    hand-over) and leaves copying to a thread that wakes every 50 ms.  That thread moves images into shared memory and
    everything else, a batch at a time, into a pipe.  When the recording process can't follow, first images and then
    frames are dropped and counted.  When it dies, it is started again and begins a new file.
    """

    def __init__(self, scene: Scene, truth_tcp_m: Truth | None = None, patience_s: float = 0.0):
        settings = scene.settings
        self._scene = scene
        self._truth_tcp_m = truth_tcp_m
        self._patience_s = patience_s
        self._queue_frames = settings.queue_frames
        self._queue_images = settings.queue_images
        self._image_every = settings.image_every
        self._ring_wanted = settings.around_alert_s > 0.0
        # Images that may only be wanted later leave room for those that are.
        self._ring_images = max(1, settings.queue_images - settings.queue_images // 4)
        self._image_interval_ns = round(1e9 / settings.image_rate_hz) if settings.image_rate_hz > 0.0 else None
        # Written by the loop's thread only.
        self._queued = 0
        self._not_queued = 0
        self._images_offered = 0
        self._images_not_queued = 0
        self._image_stamp_ns: int | None = None
        self._shown: tuple[State, Verdict, str, int] | None = None
        # Appended to by the loop's thread, emptied by the hand-over thread.
        self._frames: deque[_Waiting] = deque()
        self._alerts: deque[AlertRecord] = deque(maxlen=_EVENTS_KEPT)
        self._references: deque[ReferenceRecord] = deque(maxlen=_EVENTS_KEPT)
        self._commands: deque[RecordedCommand] = deque(maxlen=_EVENTS_KEPT)
        self._states: deque[StateRecord] = deque(maxlen=_EVENTS_KEPT)
        # Written by the hand-over thread only.
        self._images_taken = 0
        self._images_without_slot = 0
        self._images_lost_earlier = 0
        self._losses_said = (0, 0)
        self._losses_said_s = -math.inf
        self._slot_waited_from: float | None = None
        self._lost_earlier = 0
        self._left_writing = 0  # frames that a process still writes when this object is closed
        self._written_earlier = 0
        self._newest_reference = scene.reference
        self._own_failure: str | None = None
        self._stopped: str | None = None
        self._health = Health(time.monotonic())
        self._restart_pause_s = 1.0
        self._restart_at = 0.0
        self._encode = msgspec.msgpack.Encoder().encode
        self._ring = ImageRing.for_camera(scene.width_px, scene.height_px, settings.queue_images)
        self._worker: WorkerProcess | None = WorkerProcess(scene, self._ring)
        self._status = self._worker.status
        self._closing = threading.Event()
        self._close_before = 0.0
        self._thread = threading.Thread(target=self._run, name="recording", daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> int:
        """Frames that are not in the recording: the queue was full, the process died, or nothing could be written."""
        return self._not_queued + self._lost_earlier + self._status.frames_lost

    @property
    def images_dropped(self) -> int:
        """Images that were due, or around an alert, but had no room: their frames are recorded without."""
        earlier = self._images_not_queued + self._images_without_slot + self._images_lost_earlier
        return earlier + self._status.images_lost

    @property
    def has_room(self) -> bool:
        """Whether the next frame and its image would be taken.  Nobody need wait for a recording that fails."""
        images = self._ring_images if self._ring_wanted else self._queue_images
        waiting = self._images_offered - self._images_taken
        return self.failure is not None or (len(self._frames) < self._queue_frames and waiting < images)

    @property
    def frames_written(self) -> int:
        """Frames that are on disk."""
        return self._written_earlier + self._status.frames

    @property
    def failure(self) -> str | None:
        return self._own_failure or self._health.fault or self._status.failure

    @property
    def path(self) -> Path | None:
        """The file that is being written, None before the first and while recording fails."""
        return None if self._status.path is None else Path(self._status.path)

    @property
    def process_id(self) -> int | None:
        worker = self._worker
        return None if worker is None else worker.pid

    def spot(self, record: SpotRecord, image: Image | None) -> None:
        """Record a pulse of a second camera's laser, from the loop's thread."""
        self.offer(Frame(record.seq, record.stamp_ns, image), record, lambda: None)

    def offer(self, frame: Frame, record: FrameRecord | SpotRecord, trace: Trace, notes: Notes | None = None) -> None:
        """Record a frame, from the loop's thread; its image and trace only as often as configured, and at events."""
        if self._patience_s > 0.0:
            self._wait_for_room()
        if len(self._frames) >= self._queue_frames:
            self._not_queued += 1
            return
        shown = (record.state, record.verdict, record.reference_id, record.revision)
        self._queued += 1
        due = self._image_is_due(record.stamp_ns) or record.alerts or shown != self._shown
        self._shown = shown
        noted = None if notes is None else notes()
        waiting = self._images_offered - self._images_taken
        if due and waiting < self._queue_images:
            self._images_offered += 1
            self._image_stamp_ns = record.stamp_ns
            item = _Waiting(record, True, frame.image, trace(), frame.jaw_opening_m, noted, True)
        elif self._ring_wanted and not due and waiting < self._ring_images:
            # Kept in case of an alert.  Its trace would cost the loop more than all the rest of this.
            self._images_offered += 1
            item = _Waiting(record, True, frame.image, None, frame.jaw_opening_m, noted, False)
        else:
            self._images_not_queued += bool(due and frame.image is not None)
            lost = frame.image is not None and (bool(due) or self._ring_wanted)
            item = _Waiting(record, False, None, None, frame.jaw_opening_m, noted, bool(due), lost)
        self._frames.append(item)

    def alert(self, alert: AlertRecord) -> None:
        """Record an alert that belongs to no frame, such as a lost camera; those in a frame's record come with it."""
        self._alerts.append(alert)

    def reference(self, reference: ReferenceRecord) -> None:
        """Record a new reference; the first one was given at the start."""
        self._references.append(reference)

    def command(self, command: RecordedCommand) -> None:
        """Record a command and what became of it."""
        self._commands.append(command)

    def state(self, state: StateRecord) -> None:
        """Record a state message."""
        self._states.append(state)

    def close(self, timeout_s: float = 2.0) -> None:
        """Write what is waiting, finish the file, release everything; at most ``timeout_s``, then by force."""
        if self._closing.is_set():
            return
        self._close_before = time.monotonic() + timeout_s
        self._closing.set()
        self._thread.join()
        self._frames.clear()
        self._lost_earlier = self._queued - self.frames_written - self._left_writing - self._status.frames_lost
        self._say_losses()

    def _wait_for_room(self) -> None:
        end = time.monotonic() + self._patience_s
        while not self.has_room and time.monotonic() < end:
            time.sleep(_ROOM_POLL_S)

    def _image_is_due(self, stamp_ns: int) -> bool:
        if self._image_every > 0 and (self._queued - 1) % self._image_every == 0:
            return True
        if self._image_interval_ns is None:
            return False
        # A capture time that jumps backwards starts a new count.
        return self._image_stamp_ns is None or not 0 <= stamp_ns - self._image_stamp_ns < self._image_interval_ns

    def _run(self) -> None:
        try:
            while not self._closing.wait(HANDOVER_PERIOD_S if self._patience_s == 0.0 else _ROOM_POLL_S):
                self._hand_over()
            self._hand_over_rest()
        except Exception as error:  # noqa: BLE001 - a recording that fails must not take the monitor with it
            _log.exception("recording stopped")
            self._stopped = f"internal error: {error!r}"
            self._close_before = time.monotonic() + _STOPPED_TIMEOUT_S
        self._finish()

    def _hand_over(self) -> None:
        worker = self._running_worker()
        if worker is None:
            return
        worker.pump()
        worker.read_reports()
        if worker.status.view_failure is not None and worker.status.view_failure != self._status.view_failure:
            _log.warning("%s; the monitor and its recording go on", worker.status.view_failure)
        if worker.status.notice is not None and self._status.notice is None:
            _log.info("%s", worker.status.notice)
        self._status = worker.status
        while worker.ready:
            batch = self._next_batch(worker)
            if not (batch.frames or batch.events):
                break
            worker.send(self._encode(batch))
        self._look(worker)
        if worker.gone:
            ended = worker.reap(0.0) or "the recording process ended by itself"
            self._bury(worker, (worker.status.failure or ended).removeprefix("recording failed: "))

    def _look(self, worker: WorkerProcess) -> None:
        if not worker.gone:
            images = self.images_dropped
            explained = worker.status.failure is not None
            now_s = time.monotonic()
            self._health.look(now_s, worker.heard_s, worker.heard, worker.pid, self.dropped, images, explained)
            if now_s - self._losses_said_s >= _SAY_LOSSES_EVERY_S:
                self._say_losses(now_s)

    def _say_losses(self, now_s: float = math.inf) -> None:
        """One line when something more is missing than was said last."""
        losses = (self.dropped, self.images_dropped)
        if losses != self._losses_said:
            self._losses_said, self._losses_said_s = losses, now_s
            _log.warning("missing in the recording so far: %d frames; %d images of others", *losses)

    def _running_worker(self) -> WorkerProcess | None:
        if self._worker is None and time.monotonic() >= self._restart_at:
            scene = msgspec.structs.replace(self._scene, reference=self._newest_reference)
            self._worker = WorkerProcess(scene, self._ring)
        elif self._worker is not None and self._own_failure is not None and self._worker.status.frames > 0:
            self._own_failure = None
            self._restart_pause_s = 1.0
            _log.warning("recording goes on: %s", self._worker.status.path)
        return self._worker

    def _bury(self, worker: WorkerProcess, failure: str) -> None:
        """Count what a dead process took with it and plan the next one."""
        self._lost_earlier += worker.frames_sent - worker.status.frames
        self._written_earlier += worker.status.frames
        self._images_lost_earlier += worker.status.images_lost
        none = {"path": None, "failure": None, "frames": 0, "frames_lost": 0, "images_lost": 0}
        self._status = msgspec.structs.replace(worker.status, **none)
        self._own_failure = failure
        self._worker = None
        self._restart_at = time.monotonic() + self._restart_pause_s
        _log.error("recording failed: %s; next try in %.0f s", failure, self._restart_pause_s)
        self._restart_pause_s = min(2.0 * self._restart_pause_s, LONGEST_RESTART_PAUSE_S)

    def _next_batch(self, worker: WorkerProcess) -> EncodedBatch:
        frames: list[msgspec.Raw] = []
        while self._frames and len(frames) < BATCH_FRAMES and not self._wait_for_slot(worker, self._frames[0]):
            record, counted, image, trace, jaw_reported_m, noted, due, lost = self._frames.popleft()
            self._images_taken += counted
            note = None
            if image is not None and self._ring.takes(image):  # else a refused frame: its record says why
                note = self._share(worker, image, due)
                lost = note is None
            packed = None if trace is None else pack_trace(trace)
            truth_tcp_m = None if self._truth_tcp_m is None else self._truth_tcp_m(record.seq)
            limits = None if noted is None or noted.limits is worker.limits_sent else noted.limits
            worker.limits_sent = limits or worker.limits_sent
            share = None if noted is None else noted.statistic_share
            whole = FrameNote(record, note, packed, truth_tcp_m, jaw_reported_m, share, limits, due, lost)
            frames.append(msgspec.Raw(self._encode(whole)))
            if packed is not None or len(frames) % _FRAMES_A_TURN == 0:
                time.sleep(0)  # lets the interpreter lock go: the loop waits for tens of microseconds at most
        worker.frames_sent += len(frames)
        events = Events(_drain(self._alerts), _drain(self._references), _drain(self._commands), _drain(self._states))
        if events.references:
            self._newest_reference = events.references[-1]
        return EncodedBatch(frames, events)

    def _wait_for_slot(self, worker: WorkerProcess, head: _Waiting) -> bool:
        """Whether the next frame stays in the queue because its image has no room yet and patience is left."""
        if self._patience_s == 0.0 or head.image is None or self._slot_free(worker, head.due):
            self._slot_waited_from = None
            return False
        now = time.monotonic()
        self._slot_waited_from = self._slot_waited_from or now
        return now - self._slot_waited_from < self._patience_s

    def _slot_free(self, worker: WorkerProcess, due: bool) -> bool:
        slots = self._ring.slots if due else self._ring_images
        if worker.images_sent - worker.status.images_done >= slots:
            worker.read_reports()
        return worker.images_sent - worker.status.images_done < slots

    def _share(self, worker: WorkerProcess, image: Image, due: bool) -> ImageNote | None:
        if not self._slot_free(worker, due):
            self._images_without_slot += due
            return None
        note = self._ring.put(worker.images_sent % self._ring.slots, image)
        worker.images_sent += 1
        return note

    def _hand_over_rest(self) -> None:
        self._hand_over()
        while self._frames and self._worker is not None and time.monotonic() < self._close_before:
            time.sleep(0.002)
            self._hand_over()

    def _finish(self) -> None:
        worker, self._worker = self._worker, None
        if worker is not None and self._queued == 0 and not worker.heard:
            worker.discard()  # it hasn't even begun, and there is nothing that it could record
        elif worker is not None:
            failure = worker.finish(self._close_before)
            self._status = worker.status
            self._own_failure = failure
            if worker.still_writes:
                self._left_writing = worker.frames_sent - worker.status.frames - worker.status.frames_lost
                _log.info("the recording process still writes the end of the last file, and ends by itself")
            if failure is not None:
                _log.error("recording incomplete: %s", failure)
        self._own_failure = self._stopped or self._own_failure
        self._health.fault = None
        self._ring.close()


def _drain(waiting: deque[_T]) -> list[_T]:
    out: list[_T] = []
    while waiting:
        out.append(waiting.popleft())
    return out
