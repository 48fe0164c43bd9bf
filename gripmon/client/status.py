"""What is known of one monitor among many, and how bad that is."""

from __future__ import annotations

import enum
import math

import msgspec

from gripmon.client.names import MonitorName
from gripmon.model.records import Severity, StandingAlert, StateRecord, Verdict

SILENT_AFTER_S = 5.0
"""A monitor says its state once a second; one that hasn't for so long, though its session stands, hangs."""

_RANK = {Severity.ERROR: 0, Severity.WARNING: 1, Severity.INFO: 2}


class Condition(enum.StrEnum):
    """How a monitor is, the worst first."""

    GONE = "gone"
    STOPPED = "stopped"
    SILENT = "silent"
    SEVERAL = "several"
    UNKNOWN = "unknown"
    STARTING = "starting"
    SUSPECT = "suspect"
    VALID = "valid"


_CONDITIONS = list(Condition)


class MonitorStatus(msgspec.Struct, frozen=True, kw_only=True):
    """One monitor as it stood when it was asked for.

    ``state`` is its last state message, None before the first; ``state_age_s`` the time since that arrived, or since
    the monitor was first seen.  ``gone_since_ns``: when its liveliness token vanished, by our clock; None while it is
    there.  ``monitor_id`` is that of its start, empty before it is known; ``several``: another start of the same
    name is there, too, so that neither may be used.  ``transforms_per_s`` and ``transform_age_s`` (since the last one
    arrived, however long it was on its way: to move by it ask a TransformClient) are None unless transforms are
    listened to and came.
    """

    name: MonitorName
    state: StateRecord | None
    state_age_s: float
    gone_since_ns: int | None = None
    transforms_per_s: float | None = None
    transform_age_s: float | None = None
    monitor_id: str = ""
    several: bool = False

    @property
    def condition(self) -> Condition:
        """By its token, its silence, and the verdict on its last transform; starting before its first state message."""
        if self.gone_since_ns is not None:
            # What else was wrong may follow.
            said_so = self.state is not None and self.state.message.partition(";")[0] == "stopped"
            return Condition.STOPPED if said_so else Condition.GONE
        if self.state_age_s > SILENT_AFTER_S:
            return Condition.SILENT
        if self.several:
            return Condition.SEVERAL
        if self.state is None:
            return Condition.STARTING
        return {
            Verdict.UNKNOWN: Condition.UNKNOWN,
            Verdict.SUSPECT: Condition.SUSPECT,
            Verdict.VALID: Condition.VALID,
        }[self.state.verdict]

    @property
    def drift_m(self) -> float | None:
        """How far the TCP is from where the reference has it, m; None if that isn't known."""
        if self.state is None or self.state.tcp_shift_m is None:
            return None
        return math.hypot(*self.state.tcp_shift_m)

    @property
    def alerts(self) -> tuple[StandingAlert, ...]:
        """Those that are open: the worst first, of these what nobody has acknowledged, then the newest."""
        alerts = () if self.state is None else self.state.open_alerts
        return tuple(sorted(alerts, key=lambda a: (_RANK[a.severity], a.acknowledged, -(a.since_ns or 0))))


def trouble(status: MonitorStatus) -> tuple[object, ...]:
    """Sorts the worst first: by condition, then the severest alert that is open, then the drift, then the name."""
    severest = min((_RANK[alert.severity] for alert in status.alerts), default=len(_RANK))
    return _CONDITIONS.index(status.condition), severest, -(status.drift_m or 0.0), status.name
