"""A file with one JSON line per frame or pulse."""

from __future__ import annotations

import contextlib
import logging
import re
from pathlib import Path
from typing import IO

from gripmon.model.records import FrameRecord, to_json

_log = logging.getLogger(__name__)
_BUFFER_BYTES = 1 << 16
_FILES = 10  # the budget is for this many files


class EstimatesFile:
    """Begins a new file; an earlier one is kept beside it (``estimates-1.jsonl``, …, the newest has the highest
    number). Without a path it writes nothing.

    A file that reaches a tenth of ``budget_bytes`` is kept likewise, and the oldest beyond the budget are deleted,
    including those of earlier runs; 0: one file without limit.

    A disk that fails later must not stop the monitor: ``failure`` then says what is wrong, and writing ends.
    """

    def __init__(self, path: Path | None, budget_bytes: int = 0) -> None:
        """Raises OSError if the file can't be opened."""
        self.failure: str | None = None
        self._path, self._budget_bytes = path, budget_bytes
        self._file: IO[bytes] | None = None if path is None else self._begin(path)

    def write(self, record: FrameRecord) -> None:
        """Add a line; it is written by the next :meth:`flush`."""
        if self._file is not None:
            try:
                self._file.write(to_json(record) + b"\n")
            except OSError as error:
                self._give_up(error)

    def flush(self) -> None:
        """Write what has been added; called between frames, since it also starts a new file when this one is full."""
        if self._file is not None and self._path is not None:
            try:
                self._file.flush()
                if 0 < self._budget_bytes <= _FILES * self._file.tell():
                    self._file.close()
                    self._file = self._begin(self._path)
            except OSError as error:
                self._give_up(error)

    def close(self) -> None:
        if self._file is not None:
            file, self._file = self._file, None
            try:
                file.close()
            except OSError as error:
                self._give_up(error)

    def _begin(self, path: Path) -> IO[bytes]:
        """Open a new file, after making room for it."""
        _set_aside(path)
        if self._budget_bytes > 0:
            _remove_oldest(path, self._budget_bytes - self._budget_bytes // _FILES)
        return path.open("wb", buffering=_BUFFER_BYTES)

    def _give_up(self, error: OSError) -> None:
        self.failure = f"{self._path} can't be written: {error.strerror}"
        _log.error("%s", self.failure)
        file, self._file = self._file, None
        if file is not None:
            with contextlib.suppress(OSError):  # the same fault once more; logged above
                file.close()


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
