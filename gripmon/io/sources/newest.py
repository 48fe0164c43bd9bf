"""The newest wins: a slot for one item, and a live source around a reader that may block."""

from __future__ import annotations

import logging
import threading
from typing import Generic, Protocol, TypeVar

from gripmon.io.sources.base import READ_TIMEOUT_S, Waiting
from gripmon.model.records import Frame

_log = logging.getLogger(__name__)
_T = TypeVar("_T")
_SILENT = Waiting("the camera is silent")


class Newest(Generic[_T]):
    """Room for one item: the newest takes the place of one that wasn't taken, which counts as dropped.

    One thread puts, another one takes.  ``dropped_before``: how many were dropped when one was taken last.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._item: _T | None = None
        self.dropped = self.dropped_before = 0
        self.ended = False

    def put(self, item: _T) -> None:
        """Ignored after the end."""
        with self._changed:
            if not self.ended:
                self.dropped += self._item is not None
                self._item = item
                self._changed.notify_all()

    def take(self, wait_s: float) -> _T | None:
        """The item that is there or comes in time; None without one, and after the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._item is not None or self.ended, wait_s)
            item, self._item = self._item, None
            self.dropped_before = self.dropped
            return item

    def end(self, *, discard: bool = False) -> None:
        """Nothing more is put.  ``discard``: nor taken."""
        with self._changed:
            self.ended = True
            self._item = None if discard else self._item
            self._changed.notify_all()


class FrameReader(Protocol):
    """The thread's input; ``read`` may block, and may raise: the consumer gets the exception."""

    @property
    def connected(self) -> bool: ...
    def read(self) -> Frame | Waiting | None: ...
    def close(self) -> None:
        """Called in the reading thread, after its last ``read``."""

    def interrupt(self) -> None:
        """Called from another thread: a ``read`` that only waits should return now."""


class NewestFrame:
    """A live source around a reader that may block: ``read`` gives the newest frame, older ones are counted as dropped.

    An exception in the reader ends the thread; the next ``read`` raises it, after the last frame was handed over.
    """

    live = True

    def __init__(self, reader: FrameReader, *, name: str = "frames", close_within_s: float = 0.5) -> None:
        self._reader = reader
        self._close_within_s = close_within_s
        self._newest: Newest[Frame] = Newest()
        self._waiting = Waiting("nothing has arrived yet")
        self._fault: BaseException | None = None
        self._stopping = False
        # A daemon thread: a driver that never returns must not keep the process alive.
        self._thread = threading.Thread(target=self._run, name=f"gripmon-{name}", daemon=True)
        self._thread.start()

    @property
    def connected(self) -> bool:
        return not self._newest.ended and self._reader.connected

    @property
    def dropped(self) -> int:
        return self._newest.dropped

    def read(self) -> Frame | Waiting | None:
        frame = self._newest.take(READ_TIMEOUT_S)
        if frame is not None or self._stopping:
            return frame
        if self._fault is not None:
            raise self._fault
        return None if self._newest.ended else self._waiting

    def close(self) -> None:
        """Ends the thread; if it hangs in a driver it is left behind after ``close_within_s``."""
        self._stopping = True
        self._newest.end(discard=True)
        self._reader.interrupt()
        if self._thread is not threading.current_thread():
            self._thread.join(self._close_within_s)
            if self._thread.is_alive():
                _log.warning("the camera driver has not returned after %.1f s; left behind", self._close_within_s)

    def _run(self) -> None:
        try:
            while not self._stopping and (item := self._reader.read()) is not None:
                if isinstance(item, Waiting):
                    self._waiting = item
                else:
                    self._newest.put(item)
                    self._waiting = _SILENT
        except BaseException as error:  # noqa: BLE001  not handled here: the consumer raises it
            self._fault = error
        finally:
            self._reader.close()
            self._newest.end()
