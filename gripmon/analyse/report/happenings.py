"""Alerts, put together to what they are about: from raised over updated to cleared; with pauses and new references,
everything that happened beside the camera's motions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gripmon.analyse.report.content import Event, Moment, Onset
from gripmon.analyse.report.formats import count, duration
from gripmon.analyse.report.track import SECOND_NS, Clock
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


def happenings_of(lives: Sequence[Life]) -> list[Event]:
    """An event for each alert that is not about the camera's motion."""
    return [_event(life) for life in lives if not life.is_motion]


def _event(life: Life) -> Event:
    said = life.said or life.all
    # What it became at its worst names it: occluded, then lost, is lost.
    gravest = worst(said)
    kind = [each.alert.kind for each in said if each.alert.severity == gravest][-1]
    alert = explained(said) or said[-1].alert
    since_ns = life.since_ns
    noted = not life.first.alert.alert_id
    end_ns = since_ns if noted else None if life.over is None else life.over.stamp_ns
    return Event(
        kind=kind,
        title=TITLES.get(kind, str(kind).replace("_", " ").capitalize()),
        severity=gravest,
        onset=Onset(since_ns, since_ns, since_ns, "alert"),
        noticed_ns=life.first.stamp_ns,
        end_ns=end_ns,
        end_text="" if life.over is None else life.over.alert.text,
        cause=alert.cause,
        cause_probability=probability(alert),
        part=alert.part,
        causes=alert.causes,
        alert_id=alert.alert_id,
        story=tuple(
            Moment(s.stamp_ns, s.alert.text if noted else f"{s.alert.event}: {s.alert.text}") for s in life.all
        ),
    )


def pauses_of(clock: Clock) -> list[Event]:
    """An event for each time without frames, of a second or more."""
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


def with_reference_changes(
    events: list[Event], references: Sequence[ReferenceRecord], in_force_ns: dict[tuple[str, int], int]
) -> list[Event]:
    """An event, too, for each change of the reference that no alert tells of."""
    told = {AlertKind.RECALIBRATED, AlertKind.RESTORED}
    known = [event.onset.stamp_ns for event in events if event.kind in told]
    out = list(events)
    for record in references[1:]:
        start_ns = in_force_ns.get((record.reference_id, record.revision))
        if start_ns is None or any(abs(start_ns - stamp_ns) < SECOND_NS for stamp_ns in known):
            continue
        name = f"reference {record.reference_id}, revision {record.revision}"
        text = f"{name} ({record.origin}), accepted by {record.accepted_by}"
        out.append(
            Event(
                kind="reference",
                title="A new reference",
                severity=Severity.INFO,
                onset=Onset(start_ns, start_ns, start_ns, "frames"),
                end_ns=start_ns,
                cause=record.cause,
                story=(Moment(start_ns, text),),
            )
        )
    return out


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
