"""The daemon's side of a recording: accepts frames without blocking and passes them to the recording process."""

from __future__ import annotations

import datetime
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from gripmon.model.camera import Camera
from gripmon.model.gripper import Gripper
from gripmon.model.outputs import Event, Notes, Trace
from gripmon.model.records import (
    AlertRecord,
    Frame,
    FrameRecord,
    Image,
    Limits,
    RecordedConfiguration,
    ReferenceRecord,
)
from gripmon.model.shared_images import ImagePlace, SharedImages
from gripmon.record.health import SILENT, SILENT_AFTER_S, Health
from gripmon.record.process import Worker
from gripmon.record.recorder import (
    Recorder,
    RecordingSettings,
    Scene,
    Status,
    Then,
    ViewSettings,
    pack_trace,
    those,
)
from gripmon.record.waiting import Beside, Waiting, WaitingFrames

if TYPE_CHECKING:
    from gripmon.record.read import RecordedFrames

_log = logging.getLogger(__name__)

HANDOVER_PERIOD_S = 0.05
LONGEST_RESTART_PAUSE_S = 30.0
_BATCH_FRAMES = 16
_FRAMES_A_TURN = 4  # before the interpreter lock is released
ROOM_POLL_S = 0.002
_STOPPED_TIMEOUT_S = 2.0
_LEFT_AFTER_S = 10.0  # of a process that even a signal doesn't end
_LOSSES_PERIOD_S = 60.0  # between two log lines about losses
_EVENTS_KEPT = 4096  # while there is no process

Truth = Callable[[int], tuple[float, float, float] | None]


class ProcessRecorder(Recorder):
    """Records through a separate process.

    ``frame`` costs the same for every image size: it keeps a reference to the frame's array (which must not change
    afterwards) and leaves copying images to a thread that wakes every 50 ms.  That thread copies images into shared
    memory and sends everything else, in batches.  If the recording process can't keep up, first images and then the
    oldest frames are dropped and counted.  If it dies, it is started again and begins a new file.
    """

    def __init__(
        self, scene: Scene, truth_tcp_m: Truth | None = None, patience_s: float = 0.0, beside: Beside | None = None
    ) -> None:
        self._scene, self._truth_tcp_m, self._patience_s = scene, truth_tcp_m, patience_s
        settings = scene.settings
        # Filled by the loop's thread, emptied by the hand-over thread.
        self._frames = WaitingFrames(settings, beside)
        self._newest_record: FrameRecord | None = None
        self._events: deque[Event] = deque(maxlen=_EVENTS_KEPT)
        # Written by the hand-over thread only.
        self._images_without_slot = self._images_lost_earlier = 0
        self._losses_logged, self._losses_logged_s = (0, 0), -math.inf
        self._lost_earlier = self._written_earlier = 0
        self._left_writing = 0  # frames that the process is still writing when this object is closed
        self._newest_reference = scene.reference
        self._own_failure: str | None = None
        self._stopped: str | None = None
        self._health = Health(time.monotonic())
        self._restart_pause_s, self._restart_at = 1.0, 0.0
        self._encode = msgspec.msgpack.Encoder().encode
        self._images = SharedImages(settings.queue_images, scene.lens.width_px, scene.lens.height_px)
        self._worker: Worker | None = None
        self._status = Status()
        self._closing = threading.Event()
        self._close_before = 0.0
        self._thread = threading.Thread(target=self._run, name="recording", daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> int:
        """Frames missing from the recording: the queue was full, the process died, or nothing could be written."""
        return self._frames.dropped + self._lost_earlier + self._status.frames_lost

    @property
    def images_dropped(self) -> int:
        """Images that were due, or around an alert, for which there was no room; their frames are recorded."""
        earlier = self._frames.images_dropped + self._images_without_slot + self._images_lost_earlier
        return earlier + self._status.images_lost

    @property
    def has_room(self) -> bool:
        """Whether the next frame and its image would be accepted; also true while recording fails."""
        return self.failure is not None or self._frames.has_room

    @property
    def frames_written(self) -> int:
        """Frames that are on disk."""
        return self._written_earlier + self._status.frames

    @property
    def failure(self) -> str | None:
        worker = self._worker
        sending_from_s = None if worker is None else worker.sending_from_s
        if worker is None or not worker.heard:  # it is still starting
            sending_from_s = None
        if sending_from_s is not None and time.monotonic() - sending_from_s > SILENT_AFTER_S:
            return SILENT
        return self._own_failure or self._health.fault or self._status.failure

    @property
    def path(self) -> Path | None:
        """The file that is being written, None before the first and while recording fails."""
        return None if self._status.path is None else Path(self._status.path)

    @property
    def process_id(self) -> int | None:
        """Of the recording process, None while there is none."""
        worker = self._worker
        return None if worker is None else worker.pid

    def frame(self, frame: Frame, record: FrameRecord, trace: Trace, notes: Notes | None = None) -> None:
        """Record a frame, from the loop's thread; its image and trace only as configured, and at events."""
        self._newest_record = record
        if self._patience_s > 0.0:
            self._wait_for_room()
        self._frames.offer(frame, record, trace, notes)

    def event(self, event: Event) -> None:
        """Record what is neither in the scene nor in a frame's record."""
        if not (isinstance(event, AlertRecord) and self._is_in_record(event)) and event != self._scene.reference:
            self._events.append(event)

    def _is_in_record(self, alert: AlertRecord) -> bool:
        """Whether it is one of the newest frame's own alerts, to whose text the loop may have added."""
        record = self._newest_record
        return record is not None and (alert.seq, alert.stamp_ns) == (record.seq, record.stamp_ns) and any(
            (own.kind, own.event, own.alert_id) == (alert.kind, alert.event, alert.alert_id)
            and alert.text.startswith(own.text)
            for own in record.alerts
        )

    def close(self, timeout_s: float = 2.0) -> None:
        if self._closing.is_set():
            return
        self._close_before = time.monotonic() + timeout_s
        self._closing.set()
        self._thread.join(timeout_s)
        if self._thread.is_alive() and (worker := self._worker) is not None and worker.sending_from_s is not None:
            worker.kill()  # it doesn't take what it is sent
        self._thread.join(timeout_s + _LEFT_AFTER_S)
        if self._thread.is_alive():
            _log.error("recording incomplete: its process hangs in a disk that doesn't answer, and was left there")
            return
        self._frames.clear()
        handed = self._frames.offered - self._frames.dropped
        self._lost_earlier = handed - self.frames_written - self._left_writing - self._status.frames_lost
        self._log_losses()

    def _wait_for_room(self) -> None:
        end = time.monotonic() + self._patience_s
        while not self.has_room and time.monotonic() < end:
            time.sleep(ROOM_POLL_S)

    def _run(self) -> None:
        period_s = HANDOVER_PERIOD_S if self._patience_s == 0.0 else ROOM_POLL_S
        try:
            while True:
                self._hand_over()
                if self._closing.wait(period_s):
                    break
            self._hand_over()
            while len(self._frames) and self._worker is not None and time.monotonic() < self._close_before:
                time.sleep(ROOM_POLL_S)
                self._hand_over()
        except Exception as error:  # noqa: BLE001 - a failing recording must not end the monitor
            _log.exception("recording stopped")
            self._stopped = f"internal error: {error!r}"
            self._close_before = time.monotonic() + _STOPPED_TIMEOUT_S
        self._finish()

    def _hand_over(self) -> None:
        worker = self._running_worker()
        if worker is None:
            return
        self._take_reports(worker)
        while not worker.gone:
            frames, events = self._next_frames(worker), self._next_events()
            if not (frames or events):
                break
            worker.send(self._encode((frames, events)))  # a Batch
        if worker.gone:
            self._count_dead(worker)
            return
        now_s, explained = time.monotonic(), worker.status.failure is not None
        losses = self.dropped, self.images_dropped
        self._health.look(now_s, worker.heard_s, worker.heard, *losses, explained)
        if now_s - self._losses_logged_s >= _LOSSES_PERIOD_S:
            self._log_losses(now_s)

    def _take_reports(self, worker: Worker) -> None:
        worker.look()
        before, self._status = self._status, worker.status
        if self._status.view_failure not in (None, before.view_failure):
            _log.warning("%s; the monitor and its recording go on", self._status.view_failure)
        if self._status.notice is not None and before.notice is None:
            _log.info("%s", self._status.notice)

    def _log_losses(self, now_s: float = math.inf) -> None:
        """Log one line if losses have grown since the last one."""
        losses = (self.dropped, self.images_dropped)
        if losses != self._losses_logged:
            self._losses_logged, self._losses_logged_s = losses, now_s
            _log.warning("missing in the recording so far: frames: %d; images of other frames: %d", *losses)

    def _running_worker(self) -> Worker | None:
        if self._worker is None and time.monotonic() >= self._restart_at:
            try:
                scene = msgspec.structs.replace(self._scene, reference=self._newest_reference)
                self._worker = Worker(scene, self._images)
            except OSError as error:
                self._pause(f"no process can be started ({error})")
        elif self._worker is not None and self._own_failure is not None and self._worker.status.frames > 0:
            self._own_failure = None
            self._restart_pause_s = 1.0
            _log.warning("recording goes on: %s", self._worker.status.path)
        return self._worker

    def _count_dead(self, worker: Worker) -> None:
        """Count what was lost with a dead process and schedule the next one."""
        ended = worker.reap() or "the recording process ended by itself"
        last = self._status = worker.status
        self._lost_earlier += worker.frames_sent - last.frames
        self._written_earlier += last.frames
        self._images_lost_earlier += last.images_lost
        self._status = Status(images_done=last.images_done, view_failure=last.view_failure, notice=last.notice)
        self._worker = None
        self._pause((last.failure or ended).removeprefix("recording failed: "))

    def _pause(self, failure: str) -> None:
        self._own_failure = failure
        self._restart_at = time.monotonic() + self._restart_pause_s
        _log.error("recording failed: %s; next try in %.0f s", failure, self._restart_pause_s)
        self._restart_pause_s = min(2.0 * self._restart_pause_s, LONGEST_RESTART_PAUSE_S)

    def _next_events(self) -> list[Event]:
        events: list[Event] = []
        while self._events:
            events.append(self._events.popleft())
        self._newest_reference = [self._newest_reference, *those(ReferenceRecord, events)][-1]
        return events

    def _next_frames(self, worker: Worker) -> list[msgspec.Raw]:
        """The frames of the next batch, each encoded separately; as many as the process may hold."""
        frames: list[msgspec.Raw] = []
        room = min(_BATCH_FRAMES, self._scene.settings.queue_frames - worker.frames_unwritten)
        while len(frames) < room and (waiting := self._next_waiting(worker)) is not None:
            row, image, trace = waiting
            place, lost = None, row.lost
            if row.picture is None and image is not None and self._images.takes(image):  # else its record says why
                place = self._share(worker, image, row.due)
                lost = place is None
            truth_tcp_m = None if self._truth_tcp_m is None else self._truth_tcp_m(row.record.seq)
            packed = None if trace is None else pack_trace(trace)
            whole = msgspec.structs.replace(row, image=place, lost=lost, truth_tcp_m=truth_tcp_m, trace=packed)
            frames.append(msgspec.Raw(self._encode(whole)))
            if trace is not None or len(frames) % _FRAMES_A_TURN == 0:
                time.sleep(0)  # releases the interpreter lock: the loop waits for tens of microseconds at most
        worker.frames_sent += len(frames)
        return frames

    def _next_waiting(self, worker: Worker) -> Waiting | None:
        """The next frame; None while there is none, or a source that can wait does so for a slot for its image."""
        oldest = self._frames.oldest
        if oldest is not None and self._patience_s > 0.0:
            row, image, _ = oldest
            if row.picture is None and image is not None and not self._slot_free(worker, row.due):
                return None
        return self._frames.take()

    def _slot_free(self, worker: Worker, due: bool) -> bool:
        slots = self._images.slots if due else self._frames.images_before
        if worker.images_sent - worker.status.images_done >= slots:
            worker.look()
        return worker.images_sent - worker.status.images_done < slots

    def _share(self, worker: Worker, image: Image, due: bool) -> ImagePlace | None:
        if not self._slot_free(worker, due):
            self._images_without_slot += due
            return None
        place = self._images.put(worker.images_sent, image)
        worker.images_sent += 1
        return place

    def _finish(self) -> None:
        worker, self._worker = self._worker, None
        if worker is not None and self._frames.offered == 0 and worker.status.path is None:
            worker.reap()  # it hasn't started yet, and there is nothing to record
        elif worker is not None:
            self._own_failure = failure = worker.finish(self._close_before, complete=not len(self._frames))
            self._status = worker.status
            if worker.still_writes:
                self._left_writing = worker.frames_unwritten
                _log.info("the recording process still writes the end of the last file, and ends by itself")
            if failure is not None:
                _log.error("recording incomplete: %s", failure)
        self._own_failure = self._stopped or self._own_failure
        self._health.fault = None
        self._images.close()


def open_recorder(
    settings: RecordingSettings,
    *,
    robot: str,
    camera_name: str,
    camera: Camera,
    gripper: Gripper,
    reference: ReferenceRecord,
    directory: Path | None = None,
    name: str | None = None,
    truth_tcp_m: Truth | None = None,
    patience_s: float = 0.0,
    configuration: RecordedConfiguration | None = None,
    view: ViewSettings | None = None,
    replayed: RecordedFrames | None = None,
    limits_then: Limits | None = None,
) -> Recorder:
    """A recorder as configured; files are ``directory/name-0001.rrd`` and so on, and are never overwritten.

    ``directory`` replaces that of the settings, ``name`` the default, made of robot, camera and
    time of day.  ``truth_tcp_m``, from a simulator, maps a frame's ``seq`` to the TCP's true position in the camera
    frame, whose shift from the reference is drawn beside the estimate; it is called in another thread than the loop's.
    ``patience_s``: how long ``frame`` may wait for room before it drops a frame, for input that can wait, such as a
    folder; 0 for a camera.  ``configuration`` is written into every file.  ``view``: viewers may connect and see frames
    as they are recorded, also if recording itself is off.  ``replayed``: the recorded run that the frames are read
    from, drawn beside what is made of them now, with its limits (None: unknown).  Raises OSError if the directory can't
    be made.
    """
    if not settings.enabled and view is None:
        return Recorder()
    where = Path(settings.directory) if directory is None else directory
    if settings.enabled:
        where.mkdir(parents=True, exist_ok=True)
    if name is None:
        name = f"{robot}-{camera_name}-{datetime.datetime.now(datetime.UTC):%Y%m%dT%H%M%SZ}"
    scene = Scene(
        name=name, directory=str(where.resolve()), settings=settings, robot=robot, camera=camera_name,
        lens=camera.settings, gripper=gripper.model, reference=reference, has_truth=truth_tcp_m is not None,
        configuration=configuration, view=view,
        then=None if replayed is None else Then(limits=limits_then, commands=replayed.commands),
    )  # fmt: skip
    return ProcessRecorder(scene, truth_tcp_m, patience_s, None if replayed is None else replayed.beside)
