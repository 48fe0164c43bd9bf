"""The life of alerts: raised once, updated when they change, cleared when what they are about has been over for long
enough, acknowledged by people.
"""

from __future__ import annotations

import enum
import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import msgspec

from gripmon.model.records import Alert, AlertEvent, Cause, OpenAlert, Severity


@dataclass(frozen=True, slots=True)
class _Open:
    """The alert as last published, when (seconds of the frames' time), and since when its condition has been absent."""

    alert: Alert
    said_s: float
    absent_since_s: float | None = None


class Topic(enum.StrEnum):
    """What alerts are about; of each there is one open at a time."""

    MOTION = "motion"
    VIBRATION = "vibration"
    VIEW = "view"
    IMAGE = "image"
    GRIPPER = "gripper"
    RENEWAL = "renewal"
    STREAM = "stream:"
    """And what is wrong with the stream, behind the colon."""


class AlertBook:
    """The open alerts, one for each topic at a time.

    Deterministic: time is passed in, as seconds of the frames.
    """

    def __init__(self, update_s: float, clear_s: float):
        """An alert is updated once in ``update_s`` at most, unless it becomes more severe or its cause becomes known,
        and cleared when its condition has been absent for ``clear_s``.
        """
        self._update_s, self._clear_s = update_s, clear_s
        self._open: dict[str, _Open] = {}
        self._raised = 0
        self._changes = 0

    @property
    def changes(self) -> int:
        """How often what is open has changed."""
        return self._changes

    @property
    def open(self) -> tuple[OpenAlert, ...]:
        """What is raised and not cleared, the oldest first."""
        return tuple(OpenAlert(topic, entry.alert) for topic, entry in self._open.items())

    @property
    def any(self) -> bool:
        """Whether something is raised and not cleared."""
        return bool(self._open)

    @property
    def raised(self) -> int:
        """How many alerts there were."""
        return self._raised

    def restore(self, alerts: tuple[OpenAlert, ...], raised: int, now_s: float) -> None:
        """Go on after a restart: open alerts stay open and keep their ids."""
        self._raised = raised
        self._open = {each.topic: _Open(each.alert, now_s) for each in alerts}

    def about(self, topic: str) -> Alert | None:
        """The open alert about a topic."""
        entry = self._open.get(topic)
        return None if entry is None else entry.alert

    def present(
        self,
        topic: str,
        alert: Alert,
        now_s: float,
        stamp_ns: int,
        *,
        news: bool = False,
        text: Callable[[], str] | None = None,
    ) -> tuple[Alert, ...]:
        """The condition holds, as ``alert`` says now; returns the events to publish: one or none.

        ``news``: the text alone says something new to a person; else only another cause, severity or size does.
        ``text``: makes the alert's text, which is asked for where it is published alone.
        """
        entry = self._open.get(topic)
        since_ns: int | None = stamp_ns
        if entry is None:
            self._raised += 1
            event, alert_id, acknowledged = AlertEvent.RAISED, self._new_id(topic, stamp_ns), False
        else:
            known = entry.alert
            explained = known.cause is Cause.UNKNOWN and alert.cause is not Cause.UNKNOWN
            if alert.cause is Cause.UNKNOWN:  # a doubt later on takes nothing back
                alert = msgspec.structs.replace(alert, cause=known.cause, part=known.part, causes=known.causes)
            worse = alert.severity.rank > known.severity.rank
            due = (explained or now_s - entry.said_s >= self._update_s) and not known.acknowledged
            if not (worse or (due and (news or _differ(known, alert)))):
                if entry.absent_since_s is not None:
                    self._open[topic] = replace(entry, absent_since_s=None)
                return ()
            event, alert_id, since_ns = AlertEvent.UPDATED, known.alert_id, known.since_ns
            acknowledged = known.acknowledged and not worse
        told = msgspec.structs.replace(
            alert,
            text=alert.text if text is None else text(),
            event=event,
            alert_id=alert_id,
            since_ns=since_ns,
            acknowledged=acknowledged,
        )
        self._keep(topic, told, now_s)
        return (told,)

    def absent(self, topic: str, text: str, now_s: float, *, at_once: bool = False) -> tuple[Alert, ...]:
        """The condition doesn't hold: its alert is cleared when it hasn't for long enough, or ``at_once``."""
        entry = self._open.get(topic)
        if entry is None:
            return ()
        since_s = now_s if entry.absent_since_s is None else entry.absent_since_s
        if not at_once and now_s - since_s < self._clear_s:
            self._open[topic] = replace(entry, absent_since_s=since_s)
            return ()
        del self._open[topic]
        self._changes += 1
        return (msgspec.structs.replace(entry.alert, event=AlertEvent.CLEARED, severity=Severity.INFO, text=text),)

    def acknowledge(self, alert_id: str = "") -> tuple[Alert, ...]:
        """A person has seen it (``alert_id`` empty: all of them): no more updates unless it becomes more severe.

        Empty if there is no such alert that isn't acknowledged yet.
        """
        out = []
        for topic, entry in list(self._open.items()):
            if entry.alert.acknowledged or alert_id not in ("", entry.alert.alert_id):
                continue
            seen = msgspec.structs.replace(entry.alert, event=AlertEvent.UPDATED, acknowledged=True)
            self._open[topic] = replace(entry, alert=seen)  # what is over doesn't begin to be over again
            self._changes += 1
            out.append(seen)
        return tuple(out)

    def _keep(self, topic: str, alert: Alert, now_s: float) -> None:
        self._open[topic] = _Open(alert, now_s)
        self._changes += 1

    def _new_id(self, topic: str, stamp_ns: int) -> str:
        """Unique for this monitor, also when the numbering starts again because its state was lost."""
        digest = hashlib.sha256(f"{topic} {stamp_ns}".encode()).hexdigest()[:6]
        return f"{self._raised}-{digest}"


def _differ(before: Alert, after: Alert) -> bool:
    """Whether an update says something new to a person; the text's own figures change with every frame."""
    if any(getattr(before, name) != getattr(after, name) for name in ("kind", "cause", "part", "severity")):
        return True
    return _grown(before.tcp_shift_m, after.tcp_shift_m) or _grown((before.rate_m_per_min,), (after.rate_m_per_min,))


def _grown(before: tuple[float | None, ...] | None, after: tuple[float | None, ...] | None) -> bool:
    """By half, or halved."""
    if before is None or after is None:
        return (before is None) != (after is None)
    sizes = [sum((v or 0.0) ** 2 for v in values) ** 0.5 for values in (before, after)]
    return not 2.0 / 3.0 * sizes[0] <= sizes[1] <= 1.5 * sizes[0]
