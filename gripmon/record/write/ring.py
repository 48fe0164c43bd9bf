"""Pictures of the last seconds, kept in memory until an alert makes them worth writing."""

from __future__ import annotations

from collections import deque

from gripmon.model.records import Alert, AlertEvent, AlertKind, AlertRecord, Severity
from gripmon.record.write.columns import AnyRow

_RANK = {Severity.INFO: 0, Severity.WARNING: 1, Severity.ERROR: 2}
_MOMENTS_KEPT = 64
_ALERTS_KEPT = 256


class Moments:
    """Capture times that matter, and what lies around them; only the newest ones count."""

    def __init__(self, around_ns: int) -> None:
        self.around_ns = around_ns
        self._stamps_ns: deque[int] = deque(maxlen=_MOMENTS_KEPT)

    def add(self, stamp_ns: int) -> None:
        self._stamps_ns.append(stamp_ns)

    def near(self, first_ns: int, last_ns: int | None = None) -> bool:
        """Whether any of the span, ends included, lies within ``around_ns`` of a moment."""
        last_ns = first_ns if last_ns is None else last_ns
        return any(first_ns - self.around_ns <= t <= last_ns + self.around_ns for t in self._stamps_ns)


class Trigger:
    """Which alerts are worth the images around them, and files that nothing deletes: warnings and errors, when they
    are raised or become worse.

    Not those about the recording itself: they tell nothing about the camera, and a full budget must not pin more.
    """

    def __init__(self) -> None:
        self._rank: dict[str, int] = {}

    def by(self, alert: Alert | AlertRecord) -> bool:
        rank = _RANK[alert.severity]
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


class PictureRing:
    """Rows with pictures of the last ``span_ns`` of capture time, at most ``limit_bytes``; the oldest give way."""

    def __init__(self, span_ns: int, limit_bytes: int) -> None:
        self._span_ns, self._limit_bytes = span_ns, limit_bytes
        self._rows: deque[AnyRow] = deque()
        self.bytes = 0

    def __len__(self) -> int:
        return len(self._rows)

    def push(self, row: AnyRow) -> None:
        rows, stamp_ns = self._rows, row.record.stamp_ns
        if rows and stamp_ns < rows[-1].record.stamp_ns:
            rows.clear()  # a clock that was set back: how old the others are, nobody knows
            self.bytes = 0
        rows.append(row)
        self.bytes += _size(row)
        while rows and (self.bytes > self._limit_bytes or stamp_ns - rows[0].record.stamp_ns > self._span_ns):
            self.bytes -= _size(rows.popleft())

    def take(self, moments: Moments) -> list[AnyRow]:
        """Remove and return what lies around the moments, in order."""
        taken: list[AnyRow] = []
        rest: deque[AnyRow] = deque()
        for row in self._rows:
            (taken if moments.near(row.record.stamp_ns) else rest).append(row)
        self._rows = rest
        self.bytes -= sum(map(_size, taken))
        return taken


def _size(row: AnyRow) -> int:
    return 0 if row.picture is None else len(row.picture.blob)
