"""A file with one JSON line per frame."""

from __future__ import annotations

import contextlib
import logging
import queue
import re
import threading
from pathlib import Path
from typing import IO

from gripmon.model.errors import in_short
from gripmon.model.outputs import Event, Notes, Output, Trace
from gripmon.model.records import Frame, FrameRecord, StateRecord, to_json

_log = logging.getLogger(__name__)
_BUFFER_BYTES = 1 << 16
_FILES = 10  # the budget is for this many files
_WAITING = 4096
"""Most records that wait for the disk: a minute at 60 frames/s."""
_CLOSE_WITHIN_S = 2.0


class EstimatesFile(Output):
    """Begins a new file; an earlier one is kept beside it (``estimates-1.jsonl``, …, the newest has the highest
    number).

    A thread writes, so that a disk that doesn't answer holds no frame up: lines wait, and beyond some thousand are
    dropped and counted.  A file that reaches a tenth of ``budget_bytes`` is kept as one of an earlier run is, and the
    oldest beyond the budget are deleted; 0: one file without limit.  A disk that fails later must not stop the monitor:
    ``failure`` then says what is wrong, and writing ends.
    """

    name = "estimates"

    def __init__(self, path: Path, budget_bytes: int = 0) -> None:
        """Raises OSError if the file can't be opened."""
        self._path, self._budget_bytes = path, budget_bytes
        self._fault: str | None = None
        self._missing = 0
        self._waiting: queue.Queue[FrameRecord | None] = queue.Queue(_WAITING)  # None: flush
        self._ends = False
        self._file = self._begin()
        self._thread = threading.Thread(target=self._run, name="gripmon-estimates", daemon=True)
        self._thread.start()

    @property
    def failure(self) -> str | None:
        """What is wrong, in one line; None while nothing is."""
        if self._fault is not None or not self._missing:
            return self._fault
        return f"{self._path}: the disk doesn't keep up; {self._missing} lines are missing"

    @property
    def has_room(self) -> bool:
        return self._fault is not None or not self._waiting.full()

    def frame(self, frame: Frame, record: FrameRecord, trace: Trace, notes: Notes | None = None) -> None:
        """Add a line; it is on the disk after the next state message at the latest, if the disk answers."""
        if self._fault is None:
            try:
                self._waiting.put_nowait(record)
            except queue.Full:
                self._missing += 1

    def event(self, event: Event) -> None:
        """Write out what was added, with every state message."""
        if isinstance(event, StateRecord) and not self._waiting.full():
            self._waiting.put(None)

    def close(self) -> None:
        """Write what waits, for at most two seconds."""
        self._ends = True
        if not self._waiting.full():
            self._waiting.put(None)
        self._thread.join(_CLOSE_WITHIN_S)
        if self._thread.is_alive():
            _log.error("%s: the disk doesn't answer; %d lines are missing", self._path, self._waiting.qsize())

    def _run(self) -> None:
        file = self._file
        try:
            while not (self._ends and self._waiting.empty()):
                record = self._waiting.get()
                if record is not None:
                    file.write(to_json(record) + b"\n")
                    continue
                file.flush()
                if 0 < self._budget_bytes <= _FILES * file.tell():
                    file.close()
                    file = self._begin()
            file.close()
        except Exception as error:  # noqa: BLE001  said in the state; nothing waits for a thread that has ended
            reason = error.strerror if isinstance(error, OSError) else in_short(error)
            self._fault = f"{self._path} can't be written: {reason}"
            _log.error("%s", self._fault)
            with contextlib.suppress(OSError):  # the same fault once more
                file.close()

    def _begin(self) -> IO[bytes]:
        """Open a new file, after making room for it."""
        _set_aside(self._path)
        if self._budget_bytes > 0:
            _remove_oldest(self._path, self._budget_bytes - self._budget_bytes // _FILES)
        return self._path.open("wb", buffering=_BUFFER_BYTES)


def _set_aside(path: Path) -> None:
    """Keep the file of an earlier run, which is what people look for after a crash."""
    if not path.is_file() or path.stat().st_size == 0:
        return
    number = 1 + max(_kept(path), default=0)
    kept = path.with_name(f"{path.stem}-{number}{path.suffix}")
    path.rename(kept)
    _log.info("%s is kept as %s", path, kept.name)


def _remove_oldest(path: Path, most_bytes: int) -> None:
    """Delete the oldest kept files until the rest takes at most ``most_bytes``."""
    kept = _kept(path)
    size = sum(each.stat().st_size for each in kept.values())
    for number in sorted(kept):
        if size <= most_bytes:
            return
        size -= kept[number].stat().st_size
        kept[number].unlink()
        _log.info("%s is deleted: daemon.estimates_budget_bytes is for newer ones", kept[number])


def _kept(path: Path) -> dict[int, Path]:
    """The kept files by number."""
    numbered = re.compile(rf"{re.escape(path.stem)}-(\d+){re.escape(path.suffix)}").fullmatch
    found = ((numbered(each.name), each) for each in path.parent.iterdir())
    return {int(match[1]): each for match, each in found if match}
