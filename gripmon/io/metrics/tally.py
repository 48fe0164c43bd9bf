"""What is counted in the loop."""

from __future__ import annotations

from bisect import bisect_left

from gripmon.model.records import (
    AlertEvent,
    AlertKind,
    AlertRecord,
    Cause,
    FrameRecord,
    ReferenceRecord,
    Severity,
    StateRecord,
    Verdict,
)

LATENCY_BOUNDS_S = (0.001, 0.002, 0.003, 0.005, 0.0075, 0.01, 0.015, 0.02, 0.03, 0.05, 0.1, 0.25, 1.0)
"""Upper bounds of the latency's buckets; one more is open."""

_BOUNDS_NS = tuple(round(1e9 * bound) for bound in LATENCY_BOUNDS_S)
_COUNTED = (AlertEvent.RAISED, AlertEvent.NOTED)  # an update or the end is no further alert


class Tally:
    """A publisher that only counts and keeps the newest.  One thread puts; others read, at worst a frame apart."""

    def __init__(self) -> None:
        self.state_record: StateRecord | None = None
        self.record: FrameRecord | None = None
        self.latencies = [0] * (len(_BOUNDS_NS) + 1)
        self.latency_sum_ns = 0
        self.verdicts = dict.fromkeys(Verdict, 0)
        self.alerts: dict[tuple[AlertKind, Cause, Severity], int] = {}

    def transform(self, record: FrameRecord) -> None:
        """Count a frame."""
        self.latencies[bisect_left(_BOUNDS_NS, record.latency_ns)] += 1
        self.latency_sum_ns += record.latency_ns
        self.verdicts[record.verdict] += 1
        self.record = record

    def state(self, record: StateRecord) -> None:
        """Keep the state."""
        self.state_record = record

    def alert(self, record: AlertRecord) -> None:
        """Count an alert that is new."""
        if record.event in _COUNTED:
            key = (record.kind, record.cause, record.severity)
            self.alerts[key] = self.alerts.get(key, 0) + 1

    def reference(self, record: ReferenceRecord) -> None:
        """The state names it."""

    def close(self) -> None:
        """Nothing to let go of."""
