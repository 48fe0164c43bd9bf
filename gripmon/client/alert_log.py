"""All alerts of all monitors, and monitors that appear or vanish: each once, in one file of JSON lines."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from pathlib import Path
from typing import NamedTuple

import msgspec

from gripmon.client.fleet import MonitorStatus
from gripmon.client.network import MonitorName
from gripmon.model.records import AlertRecord

_WAITING_MOST = 100_000  # lines kept while the file or pipe can't be written; beyond it the oldest are lost
_LOOK_BACK_BYTES = 16 << 20


class Event(NamedTuple):
    """``line``: JSON as in the file; ``alert`` None: the monitor appeared or vanished, as ``what`` says."""

    line: bytes
    name: MonitorName
    stamp_ns: int
    what: str
    alert: AlertRecord | None


class AlertLog:
    """Accepts events in any thread (callbacks of :class:`gripmon.client.Fleet`); :meth:`write`, called in one thread,
    appends them to the file.

    The file is opened for every write, so that it may be moved away and the disk may be full temporarily.  Lines that
    are in its last 16 MiB already are not written again: a monitor repeats its last alerts to late subscribers.
    """

    def __init__(self, path: Path | None) -> None:
        """Raises OSError if the file is there and can't be read."""
        self._path = path
        self._lock = threading.Lock()  # guards the next attribute against the callbacks' threads
        self._new: deque[Event] = deque(maxlen=_WAITING_MOST)
        self._waiting: deque[bytes] = deque(maxlen=_WAITING_MOST)
        self._failure = ""
        self._written = set() if path is None or not path.is_file() else set(_last_lines(path))

    def alert(self, name: MonitorName, record: AlertRecord, payload: bytes) -> None:
        """An alert arrived, with its JSON payload."""
        line = msgspec.json.format(payload, indent=-1)
        what = f"{record.kind} {record.event}" if record.alert_id else str(record.kind)
        self._add(Event(line, name, record.stamp_ns, what, record))

    def presence(self, status: MonitorStatus) -> None:
        """A monitor has appeared or vanished, which it can't report itself."""
        stamp_ns = status.gone_since_ns or time.time_ns()
        what = "appeared" if status.gone_since_ns is None else "vanished"
        (robot, camera), schema = status.name, "gripmon.presence/1"
        values = {"schema": schema, "robot": robot, "camera": camera, "stamp_ns": stamp_ns, "event": what}
        self._add(Event(msgspec.json.encode(values), status.name, stamp_ns, what, None))

    def write(self) -> tuple[list[Event], str]:
        """Append all new events; returns them, and why the file can't be written (empty if it can, or if the reason was
        returned before).  What could not be written is retried the next time.
        """
        with self._lock:
            new, self._new = list(self._new), deque(maxlen=_WAITING_MOST)
        if self._path is None:
            return new, ""
        self._waiting.extend(event.line for event in new)
        failure = ""
        try:
            if self._waiting:
                _append(self._path, b"".join(line + b"\n" for line in self._waiting))
            self._waiting.clear()
        except OSError as error:
            failure = error.strerror or str(error)
        known, self._failure = self._failure, failure
        return new, failure if failure != known else ""

    def _add(self, event: Event) -> None:
        with self._lock:
            if event.line not in self._written:
                self._new.append(event)


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


def _last_lines(path: Path) -> list[bytes]:
    with path.open("rb") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - _LOOK_BACK_BYTES))
        return file.read().split(b"\n")
