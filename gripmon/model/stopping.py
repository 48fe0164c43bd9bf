"""Ends: requests by SIGINT and SIGTERM, from the first import to the last file that is closed, and a parent's end."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType

EXIT_DONE, EXIT_FAILED, EXIT_INTERRUPTED = 0, 3, 130

_Handler = Callable[[int, FrameType | None], None]


class StopRequest:
    """Asks the loop to end; a signal handler or any thread may do so.  The first request counts."""

    def __init__(self) -> None:
        self.exit_code: int | None = None
        self.requested_s: float | None = None

    def request(self, exit_code: int) -> None:
        if self.exit_code is None:
            self.requested_s = time.monotonic()
            self.exit_code = exit_code


@contextlib.contextmanager
def signals_exit() -> Iterator[StopRequest]:
    """Around a start-up: SIGINT raises KeyboardInterrupt and SIGTERM SystemExit(0), which close what is open.

    Python drops an exception that a handler raises while a destructor or a weak reference's callback runs, as they do
    during every import.  The request that this gives stands all the same, for the loop that follows.  SIGINT is heard
    also where a shell's background job began with ignoring it, as in the loop itself.
    """
    stop = StopRequest()

    def handle(number: int, frame: FrameType | None) -> None:
        _take(stop, number)
        raise KeyboardInterrupt if number == signal.SIGINT else SystemExit(EXIT_DONE)

    with _handling(handle):
        yield stop


@contextlib.contextmanager
def signals_request(stop: StopRequest) -> Iterator[None]:
    """Around a loop that looks at ``stop``: nothing is raised."""
    with _handling(lambda number, _frame: _take(stop, number)):
        yield


def end_with_parent() -> None:
    """In a worker that :mod:`multiprocessing` spawned: ends it when its parent ends, also by SIGKILL or for want of
    memory.  By itself it would wait for work for ever, with all of its memory.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None, "only a spawned process has a parent to follow"

    def follow() -> None:
        parent.join()
        os._exit(EXIT_FAILED)

    threading.Thread(target=follow, name="parent", daemon=True).start()


def _take(stop: StopRequest, number: int) -> None:
    stop.request(EXIT_INTERRUPTED if number == signal.SIGINT else EXIT_DONE)


@contextlib.contextmanager
def _handling(handler: _Handler) -> Iterator[None]:
    """A handler for a while.  Python allows that in the main thread only; elsewhere signals are left alone."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)
