"""``gripmon watch --alerts``: all alerts, and monitors that appear or vanish, each once, printed and in one file."""

from __future__ import annotations

import os
import time
from collections import deque
from pathlib import Path
from typing import NamedTuple

import msgspec

from gripmon.client import MonitorName, MonitorStatus
from gripmon.model.records import AlertRecord

WAITING_MOST = 100_000
"""Lines kept while the file or pipe can't be written, and read from its end: beyond it the oldest are lost."""


class Event(NamedTuple):
    """``line``: JSON as in the file; ``alert`` None: the monitor appeared or vanished, as ``what`` says."""

    line: bytes
    name: MonitorName
    stamp_ns: int
    what: str
    alert: AlertRecord | None


class AlertLog:
    """Accepts events in any thread; :meth:`write`, called in one thread, appends them to the file as JSON lines.

    The file is opened for every write: it may be moved away (logrotate needs no signal), and its disk full for a while.
    Lines at its end are not written again: a monitor repeats its last alerts to late subscribers.
    """

    def __init__(self, path: Path | None) -> None:
        """Raises OSError if the file is there and can't be read."""
        self._path = path
        self._new: deque[Event] = deque(maxlen=WAITING_MOST)
        self._waiting: deque[bytes] = deque(maxlen=WAITING_MOST)
        self._failure = ""
        self._written: set[bytes] = set()
        if path is not None and path.is_file():
            with path.open("rb") as file:
                self._written = {line.rstrip(b"\n") for line in deque(file, maxlen=WAITING_MOST)}

    def alert(self, name: MonitorName, record: AlertRecord, payload: bytes) -> None:
        """An alert arrived, with its JSON payload."""
        line = msgspec.json.format(payload, indent=-1)
        what = f"{record.kind} {record.event}" if record.alert_id else str(record.kind)
        if line not in self._written:
            self._new.append(Event(line, name, record.stamp_ns, what, record))

    def presence(self, status: MonitorStatus) -> None:
        """A monitor has appeared or vanished, which it can't report itself."""
        stamp_ns = status.gone_since_ns or time.time_ns()
        what = "appeared" if status.gone_since_ns is None else "vanished"
        (robot, camera), schema = status.name, "gripmon.presence/1"
        values = {"schema": schema, "robot": robot, "camera": camera, "stamp_ns": stamp_ns, "event": what}
        self._new.append(Event(msgspec.json.encode(values), status.name, stamp_ns, what, None))

    def write(self) -> tuple[list[Event], str]:
        """Append all new events; returns them, and why the file can't be written (empty if it can, or if the reason was
        returned before).  What could not be written is retried the next time.
        """
        new = [self._new.popleft() for _ in range(len(self._new))]
        if self._path is None:
            return new, ""
        self._waiting.extend(event.line for event in new)
        before, self._failure = self._failure, ""
        try:
            if self._waiting:
                _append(self._path, b"".join(line + b"\n" for line in self._waiting))
            self._waiting.clear()
        except OSError as error:
            self._failure = error.strerror or str(error)
        return new, self._failure if self._failure != before else ""


def _append(path: Path, data: bytes) -> None:
    """Append all of the data or nothing, starting on a new line."""
    with path.open("a+b", buffering=0) as file:
        size = file.seek(0, os.SEEK_END)
        if size:
            file.seek(-1, os.SEEK_END)
            data = data if file.read(1) == b"\n" else b"\n" + data  # the last writer was stopped within a line
        try:
            written = 0
            while written < len(data):
                written += file.write(data[written:]) or 0
        except OSError:
            file.truncate(size)
            raise
