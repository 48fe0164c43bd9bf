"""Files that nothing deletes: a small file beside the recording names the alerts that pinned it.

``name-0001.rrd.pinned`` belongs to ``name-0001.rrd``.  Whoever deletes it unpins the recording.
"""

from __future__ import annotations

from pathlib import Path

import msgspec

from gripmon.model.atomic import write_atomically
from gripmon.model.records import Alert, AlertKind, AlertRecord, Cause, Severity

SUFFIX = ".pinned"


class PinnedBy(msgspec.Struct, frozen=True):
    """The alert: ``stamp_ns`` its frame's capture time, or Unix time for one that belongs to no frame."""

    alert_id: str
    kind: AlertKind
    cause: Cause
    severity: Severity
    stamp_ns: int
    seq: int
    text: str


class Pinned(msgspec.Struct, frozen=True, tag="gripmon.pinned/1"):
    """What a ``.pinned`` file holds, as JSON."""

    alerts: tuple[PinnedBy, ...]


def pin_path(recording: Path) -> Path:
    return recording.with_name(recording.name + SUFFIX)


def is_pinned(recording: Path) -> bool:
    return pin_path(recording).exists()


def pinned_by(alert: Alert | AlertRecord, stamp_ns: int, seq: int) -> PinnedBy:
    return PinnedBy(alert.alert_id, alert.kind, alert.cause, alert.severity, stamp_ns, seq, alert.text)


class PinBoard:
    """Pins of one process; those that could not be written yet count as well, and are tried again."""

    def __init__(self) -> None:
        self._pinned: dict[Path, tuple[PinnedBy, ...]] = {}
        self._unwritten: set[Path] = set()

    def pin(self, recording: Path, alerts: tuple[PinnedBy, ...]) -> None:
        before = self._pinned.get(recording, ())
        new = tuple(alert for alert in alerts if alert not in before)
        if new:
            self._pinned[recording] = before + new
            self._unwritten.add(recording)

    def holds(self, recording: Path) -> bool:
        return recording in self._unwritten or is_pinned(recording)

    def write(self) -> None:
        """Write what is due.  OSError if that can't be; what is left is due still."""
        for recording in sorted(self._unwritten):
            if recording.exists():
                pinned = Pinned(self._pinned[recording])
                write_atomically(pin_path(recording), msgspec.json.format(msgspec.json.encode(pinned), indent=2))
            self._unwritten.discard(recording)

    def forget(self, recordings: set[Path]) -> None:
        """No more alerts come to these."""
        for recording in recordings - self._unwritten:
            self._pinned.pop(recording, None)
