"""What recordings may take of the disk: the oldest go first, pinned ones never."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from gripmon.record.write.pins import SUFFIX

_HEADROOM = 0.1  # of the budget is free when a file begins, or files would become ever smaller


class _Entry(NamedTuple):
    modified_ns: int
    name: str
    size: int
    path: Path


class DiskBudget:
    """Keeps the recordings of one robot and camera in one directory within ``budget_bytes`` (0: no limit).

    Its files are those with the default name of robot and camera, whenever they were made, and those of the series
    ``name``.  Files that another process is writing are left alone.
    """

    def __init__(self, directory: Path, robot: str, camera: str, name: str, budget_bytes: int) -> None:
        self._directory = directory
        self._budget_bytes = budget_bytes
        usual = rf"{re.escape(f'{robot}-{camera}')}-\d{{8}}T\d{{6}}Z"
        self._series = f"{name}-"
        self._belongs = re.compile(rf"(?:{usual}|{re.escape(name)})-\d{{4,}}\.rrd").fullmatch
        self._others_bytes = 0

    def exceeded_by(self, current_bytes: int) -> bool:
        """Whether a file that has grown to this size breaks the budget; asks the disk for nothing."""
        return 0 < self._budget_bytes < self._others_bytes + current_bytes

    def make_room(self, pinned: Callable[[Path], bool], current: Path | None = None) -> str:
        """Delete what has to go, never ``current``; returns why there still is no room, empty if there is.

        Without ``current``, before a file begins, a tenth of the budget is made free.  OSError if the directory can't
        be read.
        """
        if self._budget_bytes == 0:
            return ""
        limit = self._budget_bytes * (1.0 if current is not None else 1.0 - _HEADROOM)
        entries = self.recordings()
        total = sum(entry.size for entry in entries)
        trouble = ""
        for entry in entries:
            if total <= limit:
                break
            if entry.path == current or pinned(entry.path) or is_being_written(entry.path):
                continue
            try:
                entry.path.unlink(missing_ok=True)
                total -= entry.size
            except OSError as error:
                trouble = f"; {entry.path} can't be deleted: {error.strerror}"
        self._others_bytes = total - sum(entry.size for entry in entries if entry.path == current)
        if total <= limit:
            return ""
        return (
            f"pinned recordings in {self._directory} leave no room: {total / 1e6:.0f} MB, nine tenths of budget_bytes "
            f"{self._budget_bytes / 1e6:.0f} MB or more; move them away or delete their .pinned files{trouble}"
        )

    def recordings(self) -> list[_Entry]:
        """The oldest first."""
        entries = []
        for found in os.scandir(self._directory):
            if self._belongs(found.name):
                with contextlib.suppress(FileNotFoundError):
                    about = found.stat()
                    entries.append(_Entry(about.st_mtime_ns, found.name, about.st_size, Path(found.path)))
        return sorted(entries)

    def orphaned_pins(self) -> list[Path]:
        """Pins of earlier runs whose recordings somebody has deleted or moved.

        Those of the series ``name`` stay: they keep its numbers from being used again.
        """
        pins = [Path(found.path) for found in os.scandir(self._directory) if found.name.endswith(SUFFIX)]
        recordings = [(pin, pin.with_name(pin.name.removesuffix(SUFFIX))) for pin in pins]
        return [
            pin
            for pin, recording in recordings
            if self._belongs(recording.name) and not recording.name.startswith(self._series) and not recording.exists()
        ]


def space_missing(directory: Path, wanted_bytes: int, factor: float = 1.0) -> str:
    """Why the disk has no room for more, empty if it has."""
    try:
        free = shutil.disk_usage(directory).free
    except OSError as error:
        return f"{directory}: {error.strerror}"
    if free >= wanted_bytes * factor:
        return ""
    return f"{directory} has {free / 1e6:.0f} MB free, min_free_bytes keeps {wanted_bytes / 1e6:.0f} MB"


def claim(path: Path) -> int | None:
    """Lock a file against other recorders, until the descriptor is closed or the process ends; None if that fails."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


def is_being_written(path: Path) -> bool:
    """Whether a recorder that lives has claimed it."""
    descriptor = claim(path)
    if descriptor is None:
        return path.exists()
    os.close(descriptor)
    return False
