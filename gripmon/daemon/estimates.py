"""One JSON line a frame, or a pulse, in a file."""

from __future__ import annotations

import contextlib
import logging
import re
from pathlib import Path
from typing import IO

from gripmon.model.records import FrameRecord, SpotRecord, to_json

_log = logging.getLogger(__name__)
_BUFFER_BYTES = 1 << 16
_FILES = 10  # that the budget is for


class EstimatesFile:
    """Begins a new file; one of before is kept beside it (``estimates-1.jsonl`` and so on, the newest has the highest
    number).  Without a path it takes records and writes none.

    A file of a tenth of ``budget_bytes`` is set aside likewise, and the oldest beyond the budget are deleted, earlier
    runs' too; 0: one file without end.

    A disk that fails later must not stop the monitor: ``failure`` then says what is wrong, and writing ends.
    """

    def __init__(self, path: Path | None, budget_bytes: int = 0) -> None:
        """Raises OSError if the file can't be opened."""
        self.failure: str | None = None
        self._path, self._budget_bytes = path, budget_bytes
        self._file: IO[bytes] | None = None if path is None else self._begin(path)

    def write(self, record: FrameRecord | SpotRecord) -> None:
        """Add a line; it is written by the next :meth:`flush`."""
        if self._file is not None:
            try:
                self._file.write(to_json(record) + b"\n")
            except OSError as error:
                self._give_up(error)

    def flush(self) -> None:
        """Write what has been added; between two frames, since a file that is full is changed here."""
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
        """A new file, and room for it."""
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
    """Keep what an earlier run wrote: what came before a crash is what people look for."""
    if not path.is_file() or path.stat().st_size == 0:
        return
    number = 1 + max(_kept(path), default=0)
    kept = path.with_name(f"{path.stem}-{number}{path.suffix}")
    path.rename(kept)
    _log.info("%s is kept as %s", path, kept.name)


def _remove_oldest(path: Path, most_bytes: int) -> None:
    """Delete files that were set aside until the rest takes ``most_bytes`` at most."""
    kept = _kept(path)
    size = sum(each.stat().st_size for each in kept.values())
    for number in sorted(kept):
        if size <= most_bytes:
            return
        size -= kept[number].stat().st_size
        kept[number].unlink()
        _log.info("%s is deleted: daemon.estimates_budget_bytes is for newer ones", kept[number])


def _kept(path: Path) -> dict[int, Path]:
    """What was set aside, by its number."""
    numbered = re.compile(rf"{re.escape(path.stem)}-(\d+){re.escape(path.suffix)}").fullmatch
    found = ((numbered(each.name), each) for each in path.parent.iterdir())
    return {int(match[1]): each for match, each in found if match}
