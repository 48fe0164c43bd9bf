"""A daemon's interface to a service manager: its log, and whether it is ready, alive, or stopping."""

from __future__ import annotations

import contextlib
import logging
import math
import os
import select
import socket
import stat
import sys
from typing import TextIO

import msgspec


class JsonLines(logging.Formatter):
    """One JSON object per line: ``time`` (Unix time, s), ``level``, ``logger``, ``text``; for errors also ``trace``."""

    def format(self, record: logging.LogRecord) -> str:
        """The record as one line."""
        line: dict[str, object] = {
            "time": round(record.created, 3),
            "level": record.levelname.lower(),
            "logger": record.name,
            "text": record.getMessage(),
        }
        if record.exc_info:
            line["trace"] = self.formatException(record.exc_info)
        return msgspec.json.encode(line).decode()


def log_to_stderr(*, verbose: bool = False, as_json: bool = False) -> None:
    """Let the ``gripmon`` loggers write lines to stderr, as text or ``as_json``; ``verbose`` adds tracebacks of
    recovered errors.
    """
    handler = _Unhurried(sys.stderr)
    handler.setFormatter(JsonLines() if as_json else logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    logger = logging.getLogger("gripmon")
    logger.handlers = [handler]
    logger.setLevel(logging.DEBUG if verbose else logging.INFO)
    logger.propagate = False


class _Unhurried(logging.StreamHandler[TextIO]):
    """Writes where somebody reads: a stopped terminal or pager must not stop the loop.  Lines for which there is no
    room are counted, and how many were lost is the first line when there is.
    """

    def __init__(self, stream: TextIO) -> None:
        super().__init__(stream)
        self._lost, self._rest = 0, b""
        self._own = _opened_again(stream)

    def emit(self, record: logging.LogRecord) -> None:
        """Write the record if that doesn't wait."""
        lost = f"{self._lost} lines of this log are missing: nobody read it"
        before = logging.LogRecord(record.name, logging.WARNING, __file__, 0, lost, (), None)
        try:
            if self._lost and self._written(before):
                self._lost = 0
            if self._lost or not self._written(record):
                self._lost += 1
        except Exception:  # noqa: BLE001 - as every handler's: a log that fails ends nothing
            self.handleError(record)

    def _written(self, record: logging.LogRecord) -> bool:
        """Whether there was room for its line, of which a part may wait."""
        text = self.format(record) + self.terminator
        if self._own is None:
            if room := self._has_room():
                self.stream.write(text)
                self.flush()
            return room
        with contextlib.suppress(BlockingIOError):
            self._rest = self._rest[os.write(self._own, self._rest) :] if self._rest else b""
            if not self._rest:
                data = text.encode(errors="backslashreplace")
                self._rest = data[os.write(self._own, data) :]
                return True
        return False

    def _has_room(self) -> bool:
        """Whether a line can be written to a socket without waiting."""
        try:
            return bool(select.select((), (self.stream,), (), 0.0)[1])
        except (OSError, ValueError):  # not a file: there is always room
            return True


def _opened_again(stream: TextIO) -> int | None:
    """A descriptor of the same pipe or terminal that never waits: both say that there is room, and then wait, if a line
    is longer than that.  The stream's own is shared with other programs, which such a flag would confuse.  None for
    anything else.
    """
    try:
        number = stream.fileno()
        if stat.S_ISFIFO(os.fstat(number).st_mode) or os.isatty(number):
            return os.open(f"/proc/self/fd/{number}", os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    except (OSError, ValueError):  # no file, or a terminal of another user's
        pass
    return None


class ServiceManager:
    """Notifies systemd, or any other setter of ``NOTIFY_SOCKET``, by sd_notify(3); does nothing without one.

    With a watchdog (``WATCHDOG_USEC``), four signs of life are sent per period from the thread that calls
    :meth:`alive`: if that hangs, the service is restarted.
    """

    def __init__(self) -> None:
        """Raises nothing: an unreachable manager is ignored."""
        address = os.environ.get("NOTIFY_SOCKET", "")
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        waits_us = os.environ.get("WATCHDOG_USEC", "")
        asked = waits_us.isdecimal() and os.environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self._period_s = int(waits_us) * 1e-6 / 4.0 if self._address and asked else math.inf
        self._due_s = -math.inf if math.isfinite(self._period_s) else math.inf

    def ready(self) -> None:
        """The start-up is complete."""
        self._send("READY=1")

    def alive(self, now_s: float) -> None:
        """The loop is running; ``now_s``: monotonic time."""
        if now_s >= self._due_s:
            self._due_s = now_s + self._period_s
            self._send("WATCHDOG=1")

    def status(self, text: str) -> None:
        """One line for ``systemctl status``."""
        self._send(f"STATUS={text}")

    def stopping(self) -> None:
        """The shutdown has begun."""
        self._send("STOPPING=1")

    def _send(self, text: str) -> None:
        if not self._address:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as notify:
                notify.sendto(text.encode(), self._address)
        except OSError as error:
            logging.getLogger(__name__).warning("NOTIFY_SOCKET %s: %s", self._address, error.strerror)
            self._address, self._due_s = "", math.inf
