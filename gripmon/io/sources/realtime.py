"""A simulated live camera: other processes render, shared memory and pipes bring the frames."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import select
import signal
import threading
import time
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from gripmon.io.sources.base import READ_TIMEOUT_S, SourceError, Waiting
from gripmon.model.errors import in_short
from gripmon.model.priority import give_way
from gripmon.model.records import Frame, Image
from gripmon.model.records.values import NS_PER_S

_log = logging.getLogger(__name__)
_SLOTS = 12  # a frame stays readable for at least 12 - MOST_PROCESSES frame periods after it was announced
MOST_PROCESSES = 4
_WRITING = -1
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
        """``size_px`` is (width, height) of the 8-bit grey images, ``frame_count`` None means for ever."""
        assert 1 <= processes <= MOST_PROCESSES
        context = multiprocessing.get_context("spawn")
        width, height = size_px
        memory = context.RawArray("B", _SLOTS * height * width)
        self._ring = _Ring(memory, context.RawArray("q", _SLOTS), (height, width))
        self._name = name
        self._lock = threading.Lock()  # held while reading, so that close() leaves a read under way its pipes
        self._closing = False
        self._last_seq = -1
        self._dropped = 0
        self._running = [
            _Renderer(context, maker, self._ring, _Schedule(fps, first, processes, frame_count))
            for first in range(processes)
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
        image = self._ring.copy(announced.seq)
        if image is None:
            return None
        self._dropped += announced.seq - self._last_seq - 1
        self._last_seq = announced.seq
        due_ns = announced.stamp_ns - self._stamps_ahead_ns
        return Frame(announced.seq, announced.stamp_ns, image, announced.jaw_opening_m, self._name, arrived_ns=due_ns)


class _Announcement(NamedTuple):
    seq: int
    stamp_ns: int
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

    def __init__(self, context: Any, maker: FrameMaker, ring: _Ring, schedule: _Schedule) -> None:
        self.announcements, announce = context.Pipe(duplex=False)
        commands, self.commands = context.Pipe(duplex=False)
        self._process = context.Process(
            target=_render,
            args=(maker, ring, schedule, announce, commands),
            name=f"gripmon-simulator-{schedule.first}",
            daemon=True,
        )
        _start_with_signals_blocked(self._process)
        announce.close()
        commands.close()

    @property
    def pid(self) -> int:
        assert self._process.pid is not None
        return int(self._process.pid)

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
        self._process.join(_END_WITHIN_S)
        return f"the rendering process ended with exit code {self._process.exitcode}"

    def end(self) -> None:
        self._process.join(_END_WITHIN_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


class _Ring:
    """Shared images; a slot's mark names the frame that lies in it whole."""

    def __init__(self, memory: Any, marks: Any, shape: tuple[int, int]) -> None:
        self._shared = (memory, marks, shape)
        self._marks: NDArray[np.int64] = np.frombuffer(marks, np.int64)
        self._images: NDArray[np.uint8] = np.frombuffer(memory, np.uint8).reshape(_SLOTS, *shape)

    def __reduce__(self) -> tuple[type[_Ring], tuple[Any, Any, tuple[int, int]]]:
        return _Ring, self._shared

    def put(self, index: int, image: Image) -> None:
        if image.shape != self._images.shape[1:] or image.dtype != np.uint8:
            raise ValueError(f"the image is {image.shape} {image.dtype}, not {self._images.shape[1:]} uint8")
        slot = index % _SLOTS
        self._marks[slot] = _WRITING
        self._images[slot] = image
        self._marks[slot] = index

    def copy(self, index: int) -> Image | None:
        slot = index % _SLOTS
        if self._marks[slot] != index:
            return None
        image = self._images[slot].copy()
        return image if self._marks[slot] == index else None


def _start_with_signals_blocked(process: Any) -> None:
    """Ctrl-C reaches the whole process group, but only the parent may end a renderer."""
    resource_tracker.ensure_running()  # starting it later would undo the mask
    former = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, former)


def _render(maker: FrameMaker, ring: _Ring, schedule: _Schedule, announce: Connection, commands: Connection) -> None:
    """A rendering process: announces None when its first frame is ready, then frames, at the end None; or a text."""
    import cv2

    cv2.setNumThreads(1)
    give_way()
    try:
        opening_m = _draw(maker, ring, schedule.first)
        announce.send(None)
        os.set_blocking(announce.fileno(), False)
        _deliver(maker, ring, schedule, announce, commands, opening_m)
    except (BrokenPipeError, EOFError):
        return  # the parent has closed the camera, or is gone
    except Exception as error:  # noqa: BLE001  the parent raises it
        _log.exception("rendering failed")
        os.set_blocking(announce.fileno(), True)
        announce.send(in_short(error)[:1000])


def _deliver(
    maker: FrameMaker,
    ring: _Ring,
    schedule: _Schedule,
    announce: Connection,
    commands: Connection,
    opening_m: float | None,
) -> None:
    start_s, start_ns = commands.recv()  # both clocks are the machine's, not the process's
    index = schedule.first
    while schedule.end is None or index < schedule.end:
        if _sleep_until(start_s + index / schedule.fps, commands):
            return
        # A full pipe: it is not being read.  This frame counts as dropped, like the older ones that it overwrote.
        with contextlib.suppress(BlockingIOError):
            announce.send(_Announcement(index, start_ns + round(index * NS_PER_S / schedule.fps), opening_m))
        index = schedule.following(index, time.monotonic() - start_s)
        if schedule.end is None or index < schedule.end:
            opening_m = _draw(maker, ring, index)
    os.set_blocking(announce.fileno(), True)
    announce.send(None)


def _draw(maker: FrameMaker, ring: _Ring, index: int) -> float | None:
    """Render a frame into its slot; the jaw opening that belongs to it."""
    frame = maker.frame(index)
    assert frame.image is not None
    ring.put(index, frame.image)
    return frame.jaw_opening_m


def _sleep_until(due_s: float, commands: Connection) -> bool:
    """Wait; True as soon as the other end of the pipe is closed."""
    while True:
        if commands.poll(0.0):
            return True
        pause_s = due_s - time.monotonic()
        if pause_s <= 0.0:
            return False
        time.sleep(min(pause_s, _SLEEP_S))
