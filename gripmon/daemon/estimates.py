"""One JSON line a frame, or a pulse, in a file."""

from __future__ import annotations

import contextlib
import logging
from pathlib import Path
from typing import IO

from gripmon.records import FrameRecord, SpotRecord, to_json

_log = logging.getLogger(__name__)
_BUFFER_BYTES = 1 << 16


class EstimatesFile:
    """Begins a new file; one of before is kept beside it (``estimates-1.jsonl`` and so on, the newest has the highest
    number).  Without a path it takes records and writes none.

    A disk that fails later must not stop the monitor: ``failure`` then says what is wrong, and writing ends.
    """

    def __init__(self, path: Path | None) -> None:
        """Raises OSError if the file can't be opened."""
        self.failure: str | None = None
        self._path = path
        if path is not None:
            _set_aside(path)
        self._file: IO[bytes] | None = None if path is None else path.open("wb", buffering=_BUFFER_BYTES)

    def write(self, record: FrameRecord | SpotRecord) -> None:
        """Add a line; it is on disk after the next :meth:`flush`."""
        if self._file is not None:
            try:
                self._file.write(to_json(record) + b"\n")
            except OSError as error:
                self._give_up(error)

    def flush(self) -> None:
        if self._file is not None:
            try:
                self._file.flush()
            except OSError as error:
                self._give_up(error)

    def close(self) -> None:
        if self._file is not None:
            file, self._file = self._file, None
            try:
                file.close()
            except OSError as error:
                self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        self.failure = f"{self._path} can't be written: {error.strerror}"
        _log.error("%s", self.failure)
        file, self._file = self._file, None
        if file is not None:
            with contextlib.suppress(OSError):  # the same fault once more; said above
                file.close()


def _set_aside(path: Path) -> None:
    """Keep what an earlier run wrote: what came before a crash is what people look for."""
    if not path.is_file() or path.stat().st_size == 0:
        return
    number = 1
    while (kept := path.with_name(f"{path.stem}-{number}{path.suffix}")).exists():
        number += 1
    path.rename(kept)
    _log.info("%s is kept as %s", path, kept.name)
