"""What is kept: images around alerts, pinned files, the disk budget, and the repair of truncated files."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import shutil
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec

from gripmon.model.atomic import write_atomically
from gripmon.model.errors import NoResultError
from gripmon.model.records import Alert, AlertEvent, AlertKind, AlertRecord, Cause, Severity
from gripmon.record.container import is_complete, whole_bytes

PIN_SUFFIX = ".pinned"
_MOMENTS_KEPT = 64
_ALERTS_KEPT = 256
_BUDGET_FREE_FRACTION = 0.1  # kept free when a file begins, or files would become ever smaller


class Moments:
    """Capture times of interest with an interval around each; only the newest are kept."""

    def __init__(self, around_ns: int) -> None:
        self.around_ns = around_ns
        self._stamps_ns: deque[int] = deque(maxlen=_MOMENTS_KEPT)

    def add(self, stamp_ns: int) -> None:
        self._stamps_ns.append(stamp_ns)

    def near(self, first_ns: int, last_ns: int | None = None) -> bool:
        """Whether any part of the interval, ends included, is within ``around_ns`` of a moment."""
        last_ns = first_ns if last_ns is None else last_ns
        return any(first_ns - self.around_ns <= t <= last_ns + self.around_ns for t in self._stamps_ns)


class Trigger:
    """Decides which alerts keep the images around them and pin files: warnings and errors, when they are raised or
    become more severe.

    Alerts about the recording itself don't: they are not about the camera, and a full budget must not pin more files.
    """

    def __init__(self) -> None:
        self._rank: dict[str, int] = {}

    def by(self, alert: Alert | AlertRecord) -> bool:
        rank = alert.severity.rank
        if alert.event is AlertEvent.CLEARED:
            self._rank.pop(alert.alert_id, None)
            return False
        if rank == 0 or alert.kind is AlertKind.RECORDING:
            return False
        if alert.event is AlertEvent.NOTED:
            return True
        before = self._rank.get(alert.alert_id, 0)
        if len(self._rank) >= _ALERTS_KEPT and alert.alert_id not in self._rank:
            del self._rank[next(iter(self._rank))]
        self._rank[alert.alert_id] = max(rank, before)
        return rank > before


class PinnedBy(msgspec.Struct, frozen=True):
    """The alert that pins a file; ``stamp_ns``: its frame's capture time, or Unix time if it belongs to no frame."""

    alert_id: str
    kind: AlertKind
    cause: Cause
    severity: Severity
    stamp_ns: int
    seq: int
    text: str


class Pinned(msgspec.Struct, frozen=True, tag="gripmon.pinned/1"):
    """A ``.pinned`` file, as JSON: ``name-0001.rrd.pinned`` lists the alerts that keep ``name-0001.rrd``.  Deleting it
    unpins the recording.
    """

    alerts: tuple[PinnedBy, ...]


def pin_path(recording: Path) -> Path:
    return recording.with_name(recording.name + PIN_SUFFIX)


def is_pinned(recording: Path) -> bool:
    return pin_path(recording).exists()


def pinned_by(alert: Alert | AlertRecord, stamp_ns: int, seq: int) -> PinnedBy:
    return PinnedBy(alert.alert_id, alert.kind, alert.cause, alert.severity, stamp_ns, seq, alert.text)


class PinBoard:
    """Pins of one process; those that could not be written yet are valid too, and are retried."""

    def __init__(self) -> None:
        self._pinned: dict[Path, tuple[PinnedBy, ...]] = {}
        self._unwritten: set[Path] = set()

    def pin(self, recording: Path, alerts: Sequence[PinnedBy]) -> None:
        before = self._pinned.get(recording, ())
        new = tuple(alert for alert in alerts if alert not in before)
        if new:
            self._pinned[recording] = before + new
            self._unwritten.add(recording)

    def holds(self, recording: Path) -> bool:
        return recording in self._unwritten or is_pinned(recording)

    def write(self) -> None:
        """Write the pending pins.  Raises OSError if one can't be written; the rest stays pending."""
        for recording in sorted(self._unwritten):
            if recording.exists():
                pinned = Pinned(self._pinned[recording])
                write_atomically(pin_path(recording), msgspec.json.format(msgspec.json.encode(pinned), indent=2))
            self._unwritten.discard(recording)

    def forget(self, recording: Path) -> None:
        """Forget a recording that gets no more alerts."""
        if recording not in self._unwritten:
            self._pinned.pop(recording, None)


class _Entry(NamedTuple):
    modified_ns: int
    name: str
    size: int
    path: Path


class DiskBudget:
    """Keeps the recordings of one robot and camera in one directory within ``budget_bytes`` (0: no limit): the oldest
    are deleted first, pinned ones never.

    It counts files with the default name of robot and camera, of any run, and those of the series ``name``.  Files that
    another process is writing are never deleted.
    """

    def __init__(self, directory: Path, robot: str, camera: str, name: str, budget_bytes: int) -> None:
        self._directory = directory
        self._budget_bytes = budget_bytes
        usual = rf"{re.escape(f'{robot}-{camera}')}-\d{{8}}T\d{{6}}Z"
        self._series = f"{name}-"
        self._belongs = re.compile(rf"(?:{usual}|{re.escape(name)})-\d{{4,}}\.rrd").fullmatch
        self._others_bytes = 0

    def exceeded_by(self, current_bytes: int) -> bool:
        """Whether a current file of this size exceeds the budget; no disk access."""
        return 0 < self._budget_bytes < self._others_bytes + current_bytes

    def make_room(self, pinned: Callable[[Path], bool], current: Path | None = None) -> str:
        """Delete recordings as needed, never ``current``; returns why there is still no room, empty if there is.

        Without ``current``, before a file begins, a tenth of the budget is freed.  Raises OSError if the directory
        can't be read.
        """
        if self._budget_bytes == 0:
            return ""
        limit = self._budget_bytes * (1.0 if current is not None else 1.0 - _BUDGET_FREE_FRACTION)
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
        """All of them, the oldest first."""
        entries = []
        for found in os.scandir(self._directory):
            if self._belongs(found.name):
                with contextlib.suppress(FileNotFoundError):
                    about = found.stat()
                    entries.append(_Entry(about.st_mtime_ns, found.name, about.st_size, Path(found.path)))
        return sorted(entries)

    def orphaned_pins(self) -> list[Path]:
        """Pins of earlier runs whose recordings were deleted or moved.

        Pins of the series ``name`` are not included: they keep its numbers from being reused.
        """
        orphaned = []
        for pin in self._directory.glob(f"*{PIN_SUFFIX}"):
            recording = pin.with_name(pin.name.removesuffix(PIN_SUFFIX))
            ours = self._belongs(recording.name) and not recording.name.startswith(self._series)
            if ours and not recording.exists():
                orphaned.append(pin)
        return orphaned


def space_missing(directory: Path, wanted_bytes: int, factor: float = 1.0) -> str:
    """Why the disk has too little free space, empty if it has enough."""
    try:
        free = shutil.disk_usage(directory).free
    except OSError as error:
        return f"{directory}: {error.strerror}"
    if free >= wanted_bytes * factor:
        return ""
    return f"{directory} has {free / 1e6:.0f} MB free, min_free_bytes keeps {wanted_bytes / 1e6:.0f} MB"


def claim(path: Path) -> int | None:
    """Lock a file against other recorders until the descriptor is closed or the process ends; None if that fails."""
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
    """Whether a running recorder has locked it."""
    descriptor = claim(path)
    if descriptor is None:
        return path.exists()
    os.close(descriptor)
    return False


def repair(path: Path) -> int:
    """Cut off an incomplete last message, left by a killed writer: readers would reject the whole file because of it.

    Does nothing to a file that is being written.  Returns the number of bytes cut off.  Raises OSError.
    """
    lock = claim(path)
    if lock is None:
        return 0
    try:
        about, whole = path.stat(), whole_bytes(path)
        if whole < about.st_size:
            os.truncate(path, whole)
            os.utime(path, ns=(about.st_atime_ns, about.st_mtime_ns))  # its age decides when it is deleted
        return about.st_size - whole
    finally:
        os.close(lock)


def mend(budget: DiskBudget) -> str | None:
    """Repair earlier files whose writer was killed, and delete pins without a file; advice about what has no footer.

    Errors of the directory are left to whoever begins the first file.
    """
    with contextlib.suppress(OSError):
        paths = [entry.path for entry in budget.recordings()]
        for path in paths:
            repair(path)
        for pin in budget.orphaned_pins():
            pin.unlink(missing_ok=True)
        lacking = [path for path in paths if not is_complete(path) and not is_being_written(path)]
        if lacking:
            return (
                f"{len(lacking)} earlier recordings have no footer, as their recorder was killed, the newest "
                f"{lacking[-1]}; gripmon and rerun's viewer read them; for tools that need one: "
                "rerun rrd optimize FILE.rrd -o WHOLE.rrd"
            )
    return None


def keep_whole(written: Sequence[Path], path: Path, failure: str | None, *, whole: bool = True) -> None:
    """Move a finished recording to ``path``; an earlier file there stays until then.

    One that isn't ``whole``, lacks its footer, or was split into several files because writing failed in between, is
    removed, and :class:`~gripmon.model.errors.NoResultError` is raised.  ``failure`` is the recorder's own.
    """
    reason = failure
    try:
        if whole and len(written) == 1 and is_complete(written[0]):
            written[0].replace(path)
            return
    except OSError as error:
        reason = error.strerror
    # rerun only reports that its thread has ended: the free space explains the rest.
    with contextlib.suppress(OSError):
        reason = f"{_cause(reason)}; its disk has {1e-6 * shutil.disk_usage(path.parent).free:.1f} MB free"
    for part in written:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
    raise NoResultError(f"--recording {path}: writing failed ({_cause(reason)})")


def _cause(failure: str | None) -> str:
    """The last part of a failure's text, without the temporary path before it."""
    return " ".join((failure or "it was not finished").rpartition(": ")[2].split())
