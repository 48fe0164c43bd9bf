"""The report's events besides camera motions: alerts, each from raised to cleared, pauses, and new references."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import msgspec
import numpy as np

from gripmon.analyse.content import Event, Moment, Onset
from gripmon.analyse.track import SECOND_NS, Track
from gripmon.analyse.words import count, span
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
    AlertKind.OCCLUDED: "The gripper was hidden, or nothing proved its place",
    AlertKind.IMAGE: "Bad images",
    AlertKind.STREAM: "The stream of frames was at fault",
    AlertKind.SOURCE: "The camera gave no frames",
}


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
        return (self.alerts or (self.over,))[0]  # type: ignore[return-value]  # one of them is there

    @property
    def is_motion(self) -> bool:
        """Whether it is about a motion of the camera."""
        return self.first.alert.kind in MOTIONS


def histories_of(alerts: Sequence[AlertRecord], track: Track) -> list[AlertHistory]:
    """In the order in which they began; an alert that is only noted has its own history."""
    histories: list[AlertHistory] = []
    open_ones: dict[str, int] = {}
    for alert in alerts:
        timed = TimedAlert(track.time_of(alert.seq, alert.stamp_ns), alert)
        at = open_ones.get(alert.alert_id, len(histories))
        before = histories[at].alerts if at < len(histories) else ()
        cleared = alert.event is AlertEvent.CLEARED
        histories[at : at + 1] = [AlertHistory(before, timed) if cleared else AlertHistory((*before, timed))]
        if cleared:
            open_ones.pop(alert.alert_id, None)
        elif alert.alert_id:
            open_ones[alert.alert_id] = at
    return histories


def alert_event(history: AlertHistory) -> Event:
    """The event of an alert that is not about a motion of the camera: named after its most severe stage, so that what
    was occluded, then lost, is lost.
    """
    alerts = history.alerts or (history.first,)
    kind = [each.alert.kind for each in alerts if each.alert.severity == _worst(alerts)][-1]
    alert, stamp_ns = history.first.alert, history.first.stamp_ns
    since_ns = stamp_ns if alert.since_ns is None else min(alert.since_ns, stamp_ns)  # its beginning isn't recorded
    over_ns = None if history.over is None else history.over.stamp_ns
    return Event(
        kind=kind,
        title=TITLES.get(kind, str(kind).replace("_", " ").capitalize()),
        onset=Onset(since_ns, since_ns, since_ns, "alert"),
        end_ns=over_ns if alert.alert_id else stamp_ns,
        **annotation(alerts, history.over),
    )


def annotation(alerts: Sequence[TimedAlert], over: TimedAlert | None) -> dict[str, Any]:
    """What alerts say of an event: severity, cause, story; ``over``: the one that cleared it."""
    alert = _explained(alerts)
    named = [c.probability for c in alert.causes if (c.cause, c.part) == (alert.cause, alert.part)]
    stages = alerts if over is None or over in alerts else (*alerts, over)
    return {
        "severity": _worst(alerts),
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


def pauses_of(track: Track) -> list[Event]:
    """One event per pause of a second or more without frames."""
    out = []
    for i in np.flatnonzero(np.diff(track.stamp_ns) > SECOND_NS).tolist():
        start_ns, end_ns = track.stamp_ns[i : i + 2].tolist()
        missing, length = int(track.seq[i + 1] - track.seq[i]) - 1, span(start_ns, end_ns)
        why = f"{count(missing, 'frame')} in between are not recorded" if missing else "the camera gave none meanwhile"
        text = f"no frames for {length}; {why}"
        out.append(_found("gap", f"No frames for {length}", Severity.WARNING, start_ns, end_ns, text))
    return out


def reference_changes(events: Sequence[Event], references: Sequence[ReferenceRecord], track: Track) -> list[Event]:
    """One event per change of the reference that no alert reports."""
    known_ns = [e.onset.stamp_ns for e in events if e.kind in (AlertKind.RECALIBRATED, AlertKind.RESTORED)]
    records = {(record.reference_id, record.revision): record for record in references}
    recorded = [(records[key], start_ns) for key, start_ns in track.in_force_ns().items() if key in records]
    out = []
    for record, start_ns in recorded[1:]:
        if all(abs(start_ns - stamp_ns) >= SECOND_NS for stamp_ns in known_ns):
            which = f"reference {record.reference_id}, revision {record.revision} ({record.origin})"
            text = f"{which}, accepted by {record.accepted_by}"
            found = _found("reference", "A new reference", Severity.INFO, start_ns, start_ns, text)
            out.append(msgspec.structs.replace(found, cause=record.cause))
    return out


def _found(kind: str, title: str, severity: Severity, start_ns: int, end_ns: int, text: str) -> Event:
    """What the frames show, without an alert."""
    onset, story = Onset(start_ns, start_ns, start_ns, "frames"), (Moment(start_ns, text),)
    return Event(kind=kind, title=title, severity=severity, onset=onset, end_ns=end_ns, story=story)


def _worst(alerts: Sequence[TimedAlert]) -> Severity:
    """The highest severity among them."""
    return max((each.alert.severity for each in alerts), key=list(Severity).index)


def _explained(alerts: Sequence[TimedAlert]) -> AlertRecord:
    """The last one that names a cause; else the last one with weighed causes; else the last."""
    records = [each.alert for each in reversed(alerts)]
    named = [record for record in records if record.cause != Cause.UNKNOWN]
    return [*named, *(record for record in records if record.causes), *records][0]
