"""The report's events besides camera motions: alerts, each from raised to cleared, pauses, and new references."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from gripmon.analyse.content import Event, Moment, Onset, count, duration
from gripmon.analyse.track import SECOND_NS, Clock
from gripmon.model.records import AlertEvent, AlertKind, AlertRecord, Cause, ReferenceRecord, Severity

TITLES = {
    AlertKind.VIBRATION: "The camera vibrated",
    AlertKind.GRIPPER: "The gripper is not as it should be",
    AlertKind.LENS: "Focus or zoom changed",
    AlertKind.RECALIBRATED: "Recalibrated: a new reference",
    AlertKind.PROPOSED: "A new reference waits for an operator",
    AlertKind.REFUSED: "Recalibration refused",
    AlertKind.RESTORED: "An earlier reference was brought back",
    AlertKind.RESTARTED: "The monitor restarted",
    AlertKind.LOST: "The gripper was out of sight",
    AlertKind.OCCLUDED: "The view was blocked for a moment",
    AlertKind.IMAGE: "Bad images",
    AlertKind.STREAM: "The stream of frames was at fault",
    AlertKind.SOURCE: "The camera gave no frames",
}
_PAUSE_S = 1.0


def alert_events(histories: Sequence[AlertHistory]) -> list[Event]:
    """One event per alert that is not about a motion of the camera."""
    return [_event(history) for history in histories if not history.is_motion]


def _event(history: AlertHistory) -> Event:
    alerts = history.alerts or history.all
    # It is named after its most severe stage: occluded, then lost, is lost.
    gravest = worst(alerts)
    kind = [each.alert.kind for each in alerts if each.alert.severity == gravest][-1]
    since_ns = history.since_ns
    noted = not history.first.alert.alert_id
    return Event(
        kind=kind,
        title=TITLES.get(kind, str(kind).replace("_", " ").capitalize()),
        onset=Onset(since_ns, since_ns, since_ns, "alert"),
        end_ns=history.first.stamp_ns if noted else None if history.over is None else history.over.stamp_ns,
        **annotation(alerts, history.over),
    )


def annotation(alerts: Sequence[TimedAlert], over: TimedAlert | None) -> dict[str, Any]:
    """What alerts say of an event: severity, cause, story; ``over``: the one that cleared it."""
    alert = _explained(alerts)
    named = [c.probability for c in alert.causes if (c.cause, c.part) == (alert.cause, alert.part)]
    stages = alerts if over is None or over in alerts else (*alerts, over)
    return {
        "severity": worst(alerts),
        "noticed_ns": alerts[0].stamp_ns,
        "end_text": "" if over is None else over.alert.text,
        "cause": alert.cause,
        "cause_probability": named[0] if named else None,
        "part": alert.part,
        "causes": alert.causes,
        "alert_id": alert.alert_id,
        "story": tuple(
            Moment(at_ns, f"{each.event}: {each.text}" if alerts[0].alert.alert_id else each.text)
            for at_ns, each in stages
        ),
    }


def pauses_of(clock: Clock) -> list[Event]:
    """One event per pause of a second or more without frames."""
    out = []
    for i in np.flatnonzero(np.diff(clock.stamp_ns) > _PAUSE_S * SECOND_NS).tolist():
        start_ns, end_ns = int(clock.stamp_ns[i]), int(clock.stamp_ns[i + 1])
        missing = int(clock.seq[i + 1] - clock.seq[i]) - 1
        length = duration(1e-9 * (end_ns - start_ns))
        why = f"{count(missing, 'frame')} in between are not recorded" if missing else "the camera gave none meanwhile"
        out.append(
            Event(
                kind="gap",
                title=f"No frames for {length}",
                severity=Severity.WARNING,
                onset=Onset(start_ns, start_ns, start_ns, "frames"),
                end_ns=end_ns,
                story=(Moment(start_ns, f"no frames for {length}; {why}"),),
            )
        )
    return out


def reference_changes(
    events: Sequence[Event], references: Sequence[ReferenceRecord], in_force_ns: dict[tuple[str, int], int]
) -> list[Event]:
    """One event per change of the reference that no alert reports; ``in_force_ns`` in order of time."""
    alerted = (AlertKind.RECALIBRATED, AlertKind.RESTORED)
    known_ns = [event.onset.stamp_ns for event in events if event.kind in alerted]
    records = {(record.reference_id, record.revision): record for record in references}
    recorded = [(records[key], start_ns) for key, start_ns in in_force_ns.items() if key in records]
    return [
        Event(
            kind="reference",
            title="A new reference",
            severity=Severity.INFO,
            onset=Onset(start_ns, start_ns, start_ns, "frames"),
            end_ns=start_ns,
            cause=record.cause,
            story=(
                Moment(
                    start_ns,
                    f"reference {record.reference_id}, revision {record.revision} ({record.origin}), accepted by "
                    f"{record.accepted_by}",
                ),
            ),
        )
        for record, start_ns in recorded[1:]
        if all(abs(start_ns - stamp_ns) >= SECOND_NS for stamp_ns in known_ns)
    ]


MOTIONS = (AlertKind.STEP, AlertKind.CREEP, AlertKind.DRIFT)


class TimedAlert(NamedTuple):
    """An alert and its time by the report's clock."""

    stamp_ns: int
    alert: AlertRecord


@dataclass(frozen=True, slots=True)
class AlertHistory:
    """All records of one alert, in order; ``over``: the one that cleared it, None if none did."""

    alerts: tuple[TimedAlert, ...]
    over: TimedAlert | None = None

    @property
    def first(self) -> TimedAlert:
        return self.all[0]

    @property
    def since_ns(self) -> int:
        """When it was raised; by its own record if the beginning isn't recorded."""
        alert, stamp_ns = self.first.alert, self.first.stamp_ns
        return stamp_ns if alert.since_ns is None else min(alert.since_ns, stamp_ns)

    @property
    def is_motion(self) -> bool:
        """Whether it is about a motion of the camera."""
        return self.first.alert.kind in MOTIONS

    @property
    def all(self) -> tuple[TimedAlert, ...]:
        return self.alerts if self.over is None else (*self.alerts, self.over)


def histories_of(alerts: Sequence[AlertRecord], clock: Clock) -> list[AlertHistory]:
    """In the order in which they began; an alert that is only noted has its own history."""
    histories: list[AlertHistory] = []
    open_ones: dict[str, int] = {}
    for alert in alerts:
        timed = TimedAlert(clock.of(alert.seq, alert.stamp_ns), alert)
        at = open_ones.get(alert.alert_id) if alert.alert_id else None
        before = () if at is None else histories[at].alerts
        cleared = alert.event is AlertEvent.CLEARED
        history = AlertHistory(before, timed) if cleared else AlertHistory((*before, timed))
        if at is not None:
            histories[at] = history
        else:
            histories.append(history)
            if alert.alert_id and not cleared:
                open_ones[alert.alert_id] = len(histories) - 1
        if cleared:
            open_ones.pop(alert.alert_id, None)
    return histories


def worst(alerts: Sequence[TimedAlert]) -> Severity:
    """The highest severity among them."""
    return max((each.alert.severity for each in alerts), key=list(Severity).index, default=Severity.INFO)


def _explained(alerts: Sequence[TimedAlert]) -> AlertRecord:
    """The last one that names a cause; else the last one with weighed causes; else the last."""
    records = [each.alert for each in reversed(alerts)]
    named = [record for record in records if record.cause != Cause.UNKNOWN]
    return [*named, *(record for record in records if record.causes), *records][0]
