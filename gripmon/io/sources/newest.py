"""Newest frame wins: a thread reads, a slot for one frame forgets what came too late."""

from __future__ import annotations

import logging
import threading
from typing import Protocol

from gripmon.io.sources.base import READ_TIMEOUT_S, Waiting
from gripmon.model.records import Frame

_log = logging.getLogger(__name__)
_SILENT = Waiting("the camera is silent")


class FrameReader(Protocol):
    """What the thread reads from; ``read`` may block, and may raise: the consumer gets the exception."""

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
        self._changed = threading.Condition()
        self._frame: Frame | None = None
        self._waiting = Waiting("nothing has arrived yet")
        self._fault: BaseException | None = None
        self._finished = False
        self._stopping = False
        self._dropped = 0
        # A daemon thread: a driver that never returns must not keep the process alive.
        self._thread = threading.Thread(target=self._run, name=f"gripmon-{name}", daemon=True)
        self._thread.start()

    @property
    def connected(self) -> bool:
        return not self._finished and self._reader.connected

    @property
    def dropped(self) -> int:
        return self._dropped

    def read(self) -> Frame | Waiting | None:
        with self._changed:
            self._changed.wait_for(lambda: self._frame is not None or self._finished, READ_TIMEOUT_S)
            if self._stopping:
                return None
            frame, self._frame = self._frame, None
            if frame is not None:
                return frame
            if self._fault is not None:
                raise self._fault
            return None if self._finished else self._waiting

    def close(self) -> None:
        """Ends the thread; if it hangs in a driver it is left behind after ``close_within_s``."""
        with self._changed:
            self._stopping = self._finished = True
            self._changed.notify_all()
        self._reader.interrupt()
        if self._thread is not threading.current_thread():
            self._thread.join(self._close_within_s)
            if self._thread.is_alive():
                _log.warning("the camera driver has not returned after %.1f s; left behind", self._close_within_s)

    def _run(self) -> None:
        fault: BaseException | None = None
        try:
            while not self._stopping:
                item = self._reader.read()
                if item is None:
                    break
                self._hand_over(item)
        except BaseException as error:  # noqa: BLE001  not handled here: the consumer raises it
            fault = error
        finally:
            self._reader.close()
            with self._changed:
                self._fault = fault
                self._finished = True
                self._changed.notify_all()

    def _hand_over(self, item: Frame | Waiting) -> None:
        with self._changed:
            if isinstance(item, Waiting):
                self._waiting = item
                return
            if self._frame is not None:
                self._dropped += 1
            self._frame = item
            self._waiting = _SILENT
            self._changed.notify_all()
