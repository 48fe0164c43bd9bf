"""What ``gripmon watch --alerts`` writes: every alert of every monitor, once, in one file."""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING

from gripmon.cli.fleet_table import clock, printable

if TYPE_CHECKING:
    from gripmon.client import MonitorName, MonitorStatus
    from gripmon.model.records import AlertRecord

_WAITING_MOST = 100_000  # lines for a file or a pipe that can't be written for a while; beyond it the oldest are lost
_LOOK_BACK_BYTES = 16 << 20


class AlertLog:
    """Takes events in any thread; :meth:`write`, in one, puts them to stdout and to the end of the file.

    The file is opened for every write, so that it may be moved away and a disk may be full for a while.  What stands
    in its last 16 MiB already is not written again: a monitor repeats its last alerts to whoever comes later.
    """

    def __init__(self, path: Path | None, *, as_json: bool) -> None:
        """Raises OSError if the file is there and can't be read."""
        self._path, self._as_json = path, as_json
        self._lock = threading.Lock()  # guards the next two against the threads that bring events
        self._new_texts: deque[str] = deque(maxlen=_WAITING_MOST)
        self._new_lines: deque[bytes] = deque(maxlen=_WAITING_MOST)
        self._waiting: deque[bytes] = deque(maxlen=_WAITING_MOST)
        self._failure = ""
        self._written = set() if path is None or not path.is_file() else set(_last_lines(path))

    def alert(self, name: MonitorName, record: AlertRecord, payload: bytes) -> None:
        """An alert came, in this payload, JSON."""
        import msgspec

        self._add(msgspec.json.format(payload, indent=-1), _alert_text(name, record))

    def presence(self, status: MonitorStatus) -> None:
        """A monitor has come or vanished, of which it can't tell itself."""
        stamp_ns = status.gone_since_ns or time.time_ns()
        event = "appeared" if status.gone_since_ns is None else "vanished"
        told = {
            "schema": "gripmon.presence/1",
            "robot": status.name.robot,
            "camera": status.name.camera,
            "stamp_ns": stamp_ns,
            "event": event,
        }
        data = json.dumps(told, ensure_ascii=False, separators=(",", ":")).encode()
        self._add(data, f"{clock(stamp_ns)}  {printable(str(status.name))}  {event}")

    def write(self) -> None:
        """Everything that has come since; a fault of the file is said once and tried again with the next call."""
        with self._lock:
            texts, self._new_texts = self._new_texts, deque(maxlen=_WAITING_MOST)
            lines, self._new_lines = self._new_lines, deque(maxlen=_WAITING_MOST)
        for text in texts:
            print(text, flush=True)
        self._waiting.extend(lines)
        if self._path is None or not self._waiting:
            return
        try:
            _append(self._path, b"".join(line + b"\n" for line in self._waiting))
        except OSError as error:
            failure = f"watch: --out {self._path}: {error.strerror or error}; trying again"
            if failure != self._failure:
                print(failure, file=sys.stderr, flush=True)
            self._failure = failure
            return
        self._failure = ""
        self._waiting.clear()

    def _add(self, line: bytes, text: str) -> None:
        with self._lock:
            if line in self._written:
                return
            self._new_texts.append(line.decode() if self._as_json else text)
            if self._path is not None:
                self._new_lines.append(line)


def _append(path: Path, data: bytes) -> None:
    """All of it or nothing, on lines of its own."""
    with path.open("a+b", buffering=0) as file:
        size = file.seek(0, os.SEEK_END)
        if size:
            file.seek(-1, os.SEEK_END)
            data = data if file.read(1) == b"\n" else b"\n" + data  # whoever wrote last was stopped in a line
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


def _alert_text(name: MonitorName, record: AlertRecord) -> str:
    what = f"{record.kind} {record.event}" if record.alert_id else str(record.kind)
    which = f" ({record.alert_id})" if record.alert_id else ""
    return printable(
        f"{clock(record.stamp_ns)}  {name}  {record.severity.value:7}  {what}, revision {record.revision}: "
        f"{record.text}{which}"
    )
