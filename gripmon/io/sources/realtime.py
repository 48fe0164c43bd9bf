"""A simulated live camera: other processes render, shared memory and pipes bring the frames."""

from __future__ import annotations

import contextlib
import logging
import os
import select
import threading
import time
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any, NamedTuple, Protocol

from gripmon.io.sources.base import READ_TIMEOUT_S, SourceError, Waiting
from gripmon.model.errors import in_short
from gripmon.model.own_process import OwnProcess
from gripmon.model.priority import give_way
from gripmon.model.records import Frame
from gripmon.model.records.values import NS_PER_S
from gripmon.model.shared_images import ImagePlace, SharedImages

_log = logging.getLogger(__name__)
_SLOTS = 12  # a frame stays readable for at least 12 - MOST_PROCESSES frame periods after it was announced
MOST_PROCESSES = 4
_END_WITHIN_S = 0.5
_SLEEP_S = 0.05  # longest sleep of a renderer without checking whether it should end
_START_WITHIN_S = 60.0


class FrameMaker(Protocol):
    """Frames by number; it travels to the rendering processes by pickle."""

    def frame(self, index: int) -> Frame: ...


class SimulatedCamera:
    """A live camera whose frame i is due at ``start + i / fps``.

    A frame's content depends only on ``seq``; ``stamp_ns`` is the Unix time when it was due.  If rendering can't keep
    up, frames are skipped, since a camera would not wait either.  Several processes take turns, so each may take as
    many frame periods for a frame as there are processes.  Images come through shared memory: in this process a frame
    costs one copy and no thread, so the caller keeps the interpreter lock for itself.

    Construction waits until the renderers are ready, and raises :class:`SourceError` when they can't be.
    """

    live = True

    def __init__(
        self,
        maker: FrameMaker,
        *,
        size_px: tuple[int, int],
        fps: float,
        name: str,
        frame_count: int | None = None,
        processes: int = 1,
    ) -> None:
        """``size_px`` is (width, height) of the images, ``frame_count`` None means for ever."""
        assert 1 <= processes <= MOST_PROCESSES
        self._images = SharedImages(_SLOTS, *size_px)
        self._name = name
        self._lock = threading.Lock()  # held while reading, so that close() leaves a read under way its pipes
        self._closing = self._closed = False
        self._last_seq = -1
        self._dropped = 0
        self._running = [
            _Renderer(maker, self._images, _Schedule(fps, first, processes, frame_count)) for first in range(processes)
        ]
        self._all = tuple(self._running)
        self._poll = select.poll()
        try:
            for renderer in self._all:
                renderer.await_ready()
                self._poll.register(renderer.announcements, select.POLLIN)
            start = time.monotonic(), time.time_ns()
            self._stamps_ahead_ns = start[1] - round(NS_PER_S * start[0])  # of the monotonic clock
            for renderer in self._all:
                renderer.commands.send(start)
        except BaseException:
            self.close()
            raise

    @property
    def connected(self) -> bool:
        return not self._closing and bool(self._running)

    @property
    def dropped(self) -> int:
        return self._dropped

    @property
    def pids(self) -> tuple[int, ...]:
        """The rendering processes."""
        return tuple(renderer.pid for renderer in self._all)

    def read(self) -> Frame | Waiting | None:
        deadline_s = time.monotonic() + READ_TIMEOUT_S
        with self._lock:
            while not self._closing and self._running:
                if not self._poll.poll(max(1e3 * (deadline_s - time.monotonic()), 0.0)):
                    return Waiting(f"{self._name}: no frame was due, or none was rendered in time")
                frame = self._take(self._newest())
                if frame is not None:
                    return frame
            return None

    def close(self) -> None:
        self._closing = True
        for renderer in self._all:
            renderer.commands.close()  # the renderer ends when it sees this; the end of its pipe then wakes a read
        for renderer in self._all:
            renderer.end()
        with self._lock:
            for renderer in self._all:
                renderer.announcements.close()
            if not self._closed:
                self._images.close()
            self._closed = True

    def _newest(self) -> _Announcement | None:
        """The newest announcement that has arrived; RuntimeError if a renderer ended early."""
        newest: _Announcement | None = None
        for renderer in tuple(self._running):
            try:
                while renderer.announcements.poll(0.0):
                    item = renderer.announcements.recv()
                    if isinstance(item, str):
                        raise RuntimeError(f"simulated camera: {item}")
                    if item is None:
                        self._poll.unregister(renderer.announcements)
                        self._running.remove(renderer)
                        break
                    if newest is None or item.seq > newest.seq:
                        newest = item
            except EOFError:
                if not self._closing:
                    raise RuntimeError(f"simulated camera: {renderer.how_it_ended()}") from None
        return newest

    def _take(self, announced: _Announcement | None) -> Frame | None:
        """The announced frame; None if a newer one was read before, or if it was overwritten meanwhile."""
        if announced is None or announced.seq <= self._last_seq:
            return None
        image = self._images.copy(announced.place)
        if image is None:
            return None
        self._dropped += announced.seq - self._last_seq - 1
        self._last_seq = announced.seq
        due_ns = announced.stamp_ns - self._stamps_ahead_ns
        return Frame(announced.seq, announced.stamp_ns, image, announced.jaw_opening_m, self._name, arrived_ns=due_ns)


class _Announcement(NamedTuple):
    seq: int
    stamp_ns: int
    place: ImagePlace
    jaw_opening_m: float | None


class _Schedule(NamedTuple):
    """Which frames a renderer makes, and when: ``first``, ``first + step``, … below ``end``."""

    fps: float
    first: int
    step: int
    end: int | None

    def following(self, index: int, elapsed_s: float) -> int:
        """The next own frame, without those that are overdue."""
        late = int(elapsed_s * self.fps) - index - self.step
        return index + self.step * (1 + max(-(-late // self.step), 0))


class _Renderer:
    """The parent's end of a rendering process."""

    def __init__(self, maker: FrameMaker, images: SharedImages, schedule: _Schedule) -> None:
        self.announcements, announce = Pipe(duplex=False)
        commands, self.commands = Pipe(duplex=False)
        theirs = announce.fileno(), commands.fileno()
        with announce, commands:
            self._process = OwnProcess(_run, maker, images, schedule, *theirs, inherits=(*theirs, images.descriptor))
        self.pid = self._process.pid

    def await_ready(self) -> None:
        end_s = time.monotonic() + _START_WITHIN_S
        failure: str | None
        try:
            # A signal that another thread takes wakes no poll: Python acts on it between two.
            while not self.announcements.poll(READ_TIMEOUT_S):
                if time.monotonic() >= end_s:
                    took = f"the first image takes more than {_START_WITHIN_S:g} s"
                    raise SourceError(f"scenario: {took}; smaller images, or a machine that is less busy")
            failure = self.announcements.recv()
        except EOFError:
            failure = self.how_it_ended()
        if failure is not None:
            raise SourceError(f"scenario: can't be rendered ({failure}); a scenario that fits camera and gripper")

    def how_it_ended(self) -> str:
        self._process.ended_within(_END_WITHIN_S)
        return f"the rendering process ended with exit code {self._process.returncode}"

    def end(self) -> None:
        if not self._process.ended_within(_END_WITHIN_S):
            self._process.end()


def _run(maker: FrameMaker, images: SharedImages, schedule: _Schedule, announce: int, commands: int) -> None:
    """A rendering process; it is given the descriptors of its ends of the pipes."""
    told: Connection[Any, Any] = Connection(announce, readable=False)
    heard: Connection[Any, Any] = Connection(commands, writable=False)
    _render(_Canvas(maker, images), schedule, told, heard)


class _Canvas(NamedTuple):
    maker: FrameMaker
    images: SharedImages

    def draw(self, index: int) -> tuple[ImagePlace, float | None]:
        """Render a frame into its slot; where it is, and the jaw opening that belongs to it."""
        frame = self.maker.frame(index)
        if not self.images.takes(frame.image):
            raise ValueError(f"image {index} isn't one of the camera's size, or of another type than 8 or 16 bits")
        assert frame.image is not None
        return self.images.put(index, frame.image), frame.jaw_opening_m


def _render(canvas: _Canvas, schedule: _Schedule, announce: Connection, commands: Connection) -> None:
    """A rendering process: announces None when its first frame is ready, then frames, at the end None; or a text."""
    import cv2

    cv2.setNumThreads(1)
    give_way()
    try:
        drawn = canvas.draw(schedule.first)
        announce.send(None)
        os.set_blocking(announce.fileno(), False)
        _deliver(canvas, schedule, announce, commands, drawn)
    except (BrokenPipeError, EOFError):
        return  # the parent has closed the camera, or is gone
    except Exception as error:  # noqa: BLE001  the parent raises it
        _log.exception("rendering failed")
        os.set_blocking(announce.fileno(), True)
        announce.send(in_short(error)[:1000])


def _deliver(
    canvas: _Canvas,
    schedule: _Schedule,
    announce: Connection,
    commands: Connection,
    drawn: tuple[ImagePlace, float | None],
) -> None:
    start_s, start_ns = commands.recv()  # both clocks are the machine's, not the process's
    index = schedule.first
    while schedule.end is None or index < schedule.end:
        if _sleep_until(start_s + index / schedule.fps, commands):
            return
        # A full pipe: it is not being read.  This frame counts as dropped, like the older ones that it overwrote.
        with contextlib.suppress(BlockingIOError):
            announce.send(_Announcement(index, start_ns + round(index * NS_PER_S / schedule.fps), *drawn))
        index = schedule.following(index, time.monotonic() - start_s)
        if schedule.end is None or index < schedule.end:
            drawn = canvas.draw(index)
    os.set_blocking(announce.fileno(), True)
    announce.send(None)


def _sleep_until(due_s: float, commands: Connection) -> bool:
    """Wait; True as soon as the other end of the pipe is closed."""
    while True:
        if commands.poll(0.0):
            return True
        pause_s = due_s - time.monotonic()
        if pause_s <= 0.0:
            return False
        time.sleep(min(pause_s, _SLEEP_S))
