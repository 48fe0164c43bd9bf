"""A daemon's interface to a service manager: its log, and whether it is ready, alive, or stopping."""

from __future__ import annotations

import logging
import math
import os
import select
import socket
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

    _lost = 0

    def emit(self, record: logging.LogRecord) -> None:
        """Write the record if that doesn't wait."""
        if not self._has_room():
            self._lost += 1
            return
        if self._lost:
            lost, self._lost = self._lost, 0
            text = f"{lost} lines of this log are missing: nobody read it"
            super().emit(logging.LogRecord(record.name, logging.WARNING, __file__, 0, text, (), None))
        super().emit(record)

    def _has_room(self) -> bool:
        """Whether a line can be written without waiting, for pipes, sockets and terminals."""
        try:
            return bool(select.select((), (self.stream,), (), 0.0)[1])
        except (OSError, ValueError):  # not a file: there is always room
            return True


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
