"""Stopping: SIGINT and SIGTERM, from the first import to the last file closed."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType

EXIT_DONE, EXIT_FAILED, EXIT_INTERRUPTED = 0, 3, 130

_AGAIN_S = 0.01
"""Seconds after which a dropped interrupt is raised again: destructors take less, and nobody waits that notices."""

_Handler = Callable[[int, FrameType | None], None]


class StopRequest:
    """Asks the loop to stop; a signal handler or any thread may call it.  Only the first request counts."""

    def __init__(self) -> None:
        self.exit_code: int | None = None
        self.requested_s: float | None = None

    def request(self, exit_code: int) -> None:
        if self.exit_code is None:
            self.requested_s = time.monotonic()
            self.exit_code = exit_code


@contextlib.contextmanager
def signals_exit() -> Iterator[StopRequest]:
    """For start-up: SIGINT raises KeyboardInterrupt and SIGTERM SystemExit(0), so that open resources are closed.

    Python drops an exception that a handler raises while a destructor or a weak reference's callback runs, as happens
    during every import.  The request object keeps the signal anyway, for the loop that follows.  As in the loop itself,
    SIGINT is handled even if a shell started this background job with SIGINT ignored.
    """
    stop = StopRequest()

    def handle(number: int, frame: FrameType | None) -> None:
        _take(stop, number)
        raise KeyboardInterrupt if number == signal.SIGINT else SystemExit(EXIT_DONE)

    with _handling(handle):
        yield stop


@contextlib.contextmanager
def interrupts_kept() -> Iterator[None]:
    """For a command that polls nothing: a KeyboardInterrupt that Python drops, because it was raised while a destructor
    or a weak reference's callback ran, is raised once more a moment later.
    """
    former, waiting = sys.unraisablehook, list[threading.Timer]()

    def again(dropped: sys.UnraisableHookArgs) -> None:
        if dropped.exc_type is not KeyboardInterrupt:
            former(dropped)
            return
        # Later, and from a thread: here it would be dropped as well.
        waiting.append(threading.Timer(_AGAIN_S, signal.raise_signal, (signal.SIGINT,)))
        waiting[-1].start()

    sys.unraisablehook = again
    try:
        yield
    finally:
        sys.unraisablehook = former
        for timer in waiting:
            timer.cancel()


@contextlib.contextmanager
def signals_request(stop: StopRequest) -> Iterator[None]:
    """For a loop that polls ``stop``: nothing is raised."""
    with _handling(lambda number, _frame: _take(stop, number)):
        yield


def _take(stop: StopRequest, number: int) -> None:
    stop.request(EXIT_INTERRUPTED if number == signal.SIGINT else EXIT_DONE)


@contextlib.contextmanager
def _handling(handler: _Handler) -> Iterator[None]:
    """Install a signal handler temporarily; only the main thread may: elsewhere nothing is changed."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)
