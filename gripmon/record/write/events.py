"""What happens: states and verdicts where they change, the log for people, and what is in no frame's record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import rerun as rr

from gripmon.model.records import (
    Alert,
    AlertEvent,
    AlertRecord,
    RecordedCommand,
    Severity,
    State,
    StateRecord,
    Verdict,
    to_json,
)
from gripmon.record.write import palette
from gripmon.record.write.columns import AnyRow, Sender
from gripmon.record.write.wire import Events

_LONGEST_SILENCE_NS = 86_400_000_000_000  # between a frame and what belongs to none: a day
_LEVELS = {Severity.INFO: "INFO", Severity.WARNING: "WARN", Severity.ERROR: "ERROR"}


@dataclass(frozen=True, slots=True)
class Line:
    """One line of the log."""

    stamp_ns: int
    seq: int
    level: str
    text: str


class EventWriter:
    """Writes ``status/…``, ``events``, ``alert``, ``command`` and ``state``."""

    def __init__(self, send: Sender, whose: str = ""):
        """``whose`` begins each line of the log, where there are two."""
        self._send = send
        self._whose = f"{whose}: " if whose else ""
        self._state = ""
        self._verdict = ""
        self._newest_stamp_ns: int | None = None
        send.static("status/state", _configuration(palette.STATES))
        send.static("status/verdict", _configuration(palette.VERDICTS))

    def repeat(self) -> None:
        """Say state and verdict again with the next frame, changed or not."""
        self._state = self._verdict = ""

    def write(self, rows: Sequence[AnyRow], events: Events, more: Sequence[Line]) -> None:
        """``more`` are lines for the log that others have."""
        if rows:
            self._newest_stamp_ns = rows[-1].record.stamp_ns
        lines = [*more, *self._status(rows)]
        lines += [_of_alert(self._on_frames_clock(a.stamp_ns), a.seq, a) for a in events.alerts]
        lines += [_of_command(self._on_frames_clock(c.stamp_ns), c) for c in events.commands]
        if lines:
            columns = rr.TextLog.columns(text=[f"{self._whose}{e.text}" for e in lines], level=[e.level for e in lines])
            self._send.columns("events", [e.stamp_ns for e in lines], [e.seq for e in lines], columns)
        self._whole("alert", events.alerts)
        self._whole("command", events.commands)
        self._whole("state", events.states)
        self._silence(events.states)

    def _on_frames_clock(self, stamp_ns: int) -> int:
        """Frames of old files have old stamps: among them an alert of today, which belongs to no frame, would stretch
        the timeline over years.
        """
        if self._newest_stamp_ns is None or abs(stamp_ns - self._newest_stamp_ns) < _LONGEST_SILENCE_NS:
            return stamp_ns
        return self._newest_stamp_ns

    def _whole(self, path: str, messages: Sequence[AlertRecord | RecordedCommand | StateRecord]) -> None:
        """Messages as JSON; before the first frame they have no place on the timeline of captures."""
        if not messages:
            return
        known = self._newest_stamp_ns is not None
        stamps_ns = [self._on_frames_clock(message.stamp_ns) for message in messages] if known else []
        whole = rr.AnyValues.columns(json=[to_json(message).decode() for message in messages])
        self._send.columns(path, stamps_ns, [message.seq for message in messages], whole)

    def _status(self, rows: Sequence[AnyRow]) -> list[Line]:
        """State and verdict where they change, and what happened as text."""
        lines = []
        for row in rows:
            record = row.record
            if record.state != self._state or record.verdict != self._verdict:
                before = f"{self._state} ({self._verdict}) → " if self._state else ""
                reason = f": {record.reason}" if record.reason else ""
                text = f"{before}{record.state} ({record.verdict}){reason}"
                lines.append(Line(record.stamp_ns, record.seq, "INFO", text))
            self._change(record.stamp_ns, record.seq, record.state, record.verdict)
            lines += [_of_alert(record.stamp_ns, record.seq, alert) for alert in record.alerts]
        return lines

    def _silence(self, states: Sequence[StateRecord]) -> None:
        """Without frames it is the daemon who says what the state is."""
        for said in states:
            if said.state is State.STALE and self._newest_stamp_ns is not None:
                self._change(self._on_frames_clock(said.stamp_ns), said.seq, said.state, said.verdict)

    def _change(self, stamp_ns: int, seq: int, state: State, verdict: Verdict) -> None:
        if state != self._state:
            self._send.columns("status/state", [stamp_ns], [seq], rr.StateChange.columns(state=[state]))
        if verdict != self._verdict:
            self._send.columns("status/verdict", [stamp_ns], [seq], rr.StateChange.columns(state=[verdict]))
        self._state, self._verdict = state, verdict


def _of_alert(stamp_ns: int, seq: int, alert: Alert | AlertRecord) -> Line:
    event = "" if alert.event is AlertEvent.NOTED else f" {alert.event}"
    said = f"{alert.kind}{event} [{alert.cause}] {alert.text}"
    return Line(stamp_ns, seq, _LEVELS[alert.severity], f"{said} ({alert.alert_id})" if alert.alert_id else said)


def _of_command(stamp_ns: int, command: RecordedCommand) -> Line:
    argument = f" {command.argument}" if command.argument else ""
    text = f"command {command.name}{argument} {'done' if command.done else 'refused'}: {command.text}"
    return Line(stamp_ns, command.seq, "INFO" if command.done else "WARN", text)


def _configuration(colours: dict[State, palette.Colour] | dict[Verdict, palette.Colour]) -> rr.StateConfiguration:
    return rr.StateConfiguration(values=[str(value) for value in colours], colors=list(colours.values()))
