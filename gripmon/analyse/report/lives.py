"""Alerts, put together to what they are about: from raised over updated to cleared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from gripmon.analyse.report.clock import Clock
from gripmon.model.records import AlertEvent, AlertKind, AlertRecord, Cause, Severity

MOTIONS = (AlertKind.STEP, AlertKind.CREEP, AlertKind.DRIFT)
_RANK = {Severity.INFO: 0, Severity.WARNING: 1, Severity.ERROR: 2}


@dataclass(frozen=True, slots=True)
class Said:
    """An alert and when it was said, by the report's clock."""

    stamp_ns: int
    alert: AlertRecord


@dataclass(frozen=True, slots=True)
class Life:
    """All that was said of one alert, in order; ``over`` is what cleared it, None if nothing did."""

    said: tuple[Said, ...]
    over: Said | None = None

    @property
    def first(self) -> Said:
        return self.all[0]

    @property
    def since_ns(self) -> int:
        """When it was raised, as it says itself where the beginning isn't recorded."""
        alert, stamp_ns = self.first.alert, self.first.stamp_ns
        return stamp_ns if alert.since_ns is None else min(alert.since_ns, stamp_ns)

    @property
    def is_motion(self) -> bool:
        """It is about the camera's motion."""
        return self.first.alert.kind in MOTIONS

    @property
    def all(self) -> tuple[Said, ...]:
        return self.said if self.over is None else (*self.said, self.over)


def lives_of(alerts: Sequence[AlertRecord], clock: Clock) -> list[Life]:
    """In the order in which they began; what is only noted is a life of its own."""
    lives: list[Life] = []
    open_ones: dict[str, int] = {}
    for alert in alerts:
        said = Said(clock.of(alert.seq, alert.stamp_ns), alert)
        at = open_ones.get(alert.alert_id) if alert.alert_id else None
        if alert.event is AlertEvent.CLEARED:
            before = lives[at] if at is not None else Life(())
            life = Life(before.said, said)
            open_ones.pop(alert.alert_id, None)
        else:
            life = Life((*(lives[at].said if at is not None else ()), said))
        if at is None:
            lives.append(life)
            if alert.alert_id and alert.event is not AlertEvent.CLEARED:
                open_ones[alert.alert_id] = len(lives) - 1
        else:
            lives[at] = life
    return lives


def worst(said: Sequence[Said]) -> Severity:
    """The most severe that was said."""
    return max((each.alert.severity for each in said), key=_RANK.__getitem__, default=Severity.INFO)


def explained(said: Sequence[Said]) -> AlertRecord | None:
    """The last one that names a cause; else the last one that weighed any; else the last."""
    alerts = [each.alert for each in said]
    for fits in (lambda a: a.cause != Cause.UNKNOWN, lambda a: bool(a.causes), lambda a: True):
        for alert in reversed(alerts):
            if fits(alert):
                return alert
    return None


def probability(alert: AlertRecord) -> float | None:
    """Of the cause that it names."""
    for each in alert.causes:
        if each.cause == alert.cause and each.part == alert.part:
            return each.probability
    return None
