"""Estimates compared with the simulator's truth: errors of the corrected TCP, and detection of every event."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from gripmon.analyse.words import count
from gripmon.model.records import (
    Alert,
    AlertEvent,
    AlertKind,
    Array,
    FrameRecord,
    Origin,
    Severity,
    Smoothed,
    Transform,
    Verdict,
)
from gripmon.model.units import in_mm
from gripmon.simulate import FrameTruth

EVENT_NAMES = {
    "creep": "creep",
    "bumped": "bump",
    "vibration": "vibration",
    "tilting": "tilt",
    "shadow": "shadow",
    "light_step": "light step",
    "defocus": "defocus",
    "hand": "occlusion",
    "sheet": "occlusion",
    "object_between": "grasp",
}
NO_ALARMS = frozenset({AlertKind.RECALIBRATED, AlertKind.RESTORED, AlertKind.RESTARTED, AlertKind.PROPOSED})
HARMLESS = frozenset({"shadow", "light step"})


class Distribution(msgspec.Struct, frozen=True):
    """Mean, 95th percentile and maximum of absolute values; None without values."""

    mean: float | None
    p95: float | None
    max: float | None

    def cells(self) -> str:
        """Table cells of 8 characters."""
        return "".join("       —" if v is None else f"{v:8.4f}" for v in (self.mean, self.p95, self.max))


class TcpErrors(msgspec.Struct, frozen=True):
    """Errors of the TCP's position in the camera frame, mm, across and along the optical axis."""

    frames: int
    across_mm: Distribution
    along_mm: Distribution

    def row(self, name: str) -> str:
        """A row of :meth:`Comparison.table`."""
        return f"{name:<38}{self.frames:>6} {self.across_mm.cells()}  {self.along_mm.cells()}"


class EventReport(msgspec.Struct, frozen=True):
    """One event of the scenario and how the monitor reacted; times from the first frame.

    ``noticed_after_s``: time to the first alarm (an alert that reports a fault); ``alerts``: all until the next event
    begins.  A ``harmless`` event should raise no alarm.
    """

    event: str
    start_s: float
    end_s: float
    frames: int
    valid: int
    harmless: bool
    largest_tcp_shift_mm: float
    after_correction: TcpErrors
    noticed_after_s: float | None
    alerts: tuple[str, ...]

    def text(self) -> str:
        """How far the TCP was off, and what was detected."""
        moved = f"TCP up to {self.largest_tcp_shift_mm:.2f} mm off"
        if self.noticed_after_s is None:
            noticed = "rightly no alarm" if self.harmless else "NOT NOTICED"
        else:
            noticed = f"{'FALSE ALARM' if self.harmless else 'noticed'} after {self.noticed_after_s:.2f} s"
        if self.alerts:
            noticed += f": {', '.join(dict.fromkeys(self.alerts))}"
        return f"{self.event:<10} {moved}; {self.valid} of {self.frames} frames valid; {noticed}"


class Comparison(msgspec.Struct, frozen=True):
    """Everything about a run on simulated frames."""

    frames: int
    verdicts: dict[str, int]
    without_correction: TcpErrors
    after_correction: TcpErrors
    smoothed: TcpErrors
    events: tuple[EventReport, ...]

    def table(self) -> list[str]:
        """The errors with and without correction, overall and for each event."""
        return [
            f"{'TCP error against truth (mm)':<38}      across the optical axis           along it",
            f"{'':<38}{'frames':>6}{'mean':>9}{'95 %':>8}{'max':>8}{'mean':>10}{'95 %':>8}{'max':>8}",
            self.without_correction.row("without correction"),
            self.after_correction.row("after correction"),
            *(e.after_correction.row(f"  {e.event} at {e.start_s:.1f} to {e.end_s:.1f} s") for e in self.events),
            self.smoothed.row("after correction, smoothed"),
        ]


class _AlertChanges:
    """What each alert changes: an alert begins, becomes another, or is over."""

    def __init__(self) -> None:
        self._open: dict[str, tuple[AlertKind, Severity]] = {}

    def of(self, alert: Alert) -> tuple[str, bool]:
        """In words, empty if it changes nothing; and whether it is an alarm: a fault that is new, or is worse now."""
        if alert.event is AlertEvent.CLEARED:
            self._open.pop(alert.alert_id, None)
            return f"{alert.kind} cleared", False
        fault = alert.kind not in NO_ALARMS
        if alert.event is AlertEvent.NOTED:
            return f"{alert.kind} ({alert.severity})", fault and alert.severity is not Severity.INFO
        before, now = self._open.get(alert.alert_id), (alert.kind, alert.severity)
        self._open[alert.alert_id] = now
        if before == now:
            return "", False
        ranks = list(Severity)
        worse = before is None or before[0] is not now[0] or ranks.index(now[1]) > ranks.index(before[1])
        how = "raised as" if alert.event is AlertEvent.RAISED else "becomes"
        return f"{alert.kind} {how} {alert.severity}", fault and worse


class _Pair(NamedTuple):
    record: FrameRecord
    truth: FrameTruth
    alarm: bool

    def error_m(self, pose: Transform | Smoothed | None) -> Array | None:
        """Error (3,) of the TCP in camera axes; None where there is no pose, or one that no controller would use."""
        if pose is None or self.record.verdict is not Verdict.VALID:
            return None
        return np.array(pose.translation_m) - self.truth.cam_T_grip[:3, 3]


def compare(records: Iterable[FrameRecord], truth_of: Callable[[int], FrameTruth]) -> Comparison:
    """Compare records of simulated frames with ``truth_of(seq)``.

    ``after_correction`` and ``smoothed`` are over the frames whose verdict is valid: those that a controller would use.
    """
    changes = _AlertChanges()
    pairs = []
    for record in records:
        alarms = [changes.of(alert)[1] for alert in record.alerts]  # all of them must be evaluated
        pairs.append(_Pair(record, truth_of(record.seq), any(alarms)))
    return Comparison(
        frames=len(pairs),
        verdicts={verdict.value: sum(p.record.verdict is verdict for p in pairs) for verdict in Verdict},
        without_correction=_errors([p.truth.tcp_shift_m for p in pairs]),
        after_correction=_corrected(pairs),
        smoothed=_errors([p.error_m(p.record.smoothed) for p in pairs]),
        events=_events(pairs),
    )


def distribution(values: Array) -> Distribution:
    """Mean, 95th percentile, maximum."""
    if not values.size:
        return Distribution(None, None, None)
    return Distribution(float(values.mean()), float(np.percentile(values, 95.0)), float(values.max()))


def _corrected(pairs: Iterable[_Pair]) -> TcpErrors:
    """Of the frames with a measurement of their own."""
    return _errors([p.error_m(None if p.record.source is Origin.HELD else p.record.measured_T) for p in pairs])


def _errors(errors_m: Sequence[Array | None]) -> TcpErrors:
    errors_mm = 1e3 * np.array([e for e in errors_m if e is not None], dtype=float).reshape(-1, 3)
    across_mm = np.hypot(errors_mm[:, 0], errors_mm[:, 1])
    return TcpErrors(len(errors_mm), distribution(across_mm), distribution(np.abs(errors_mm[:, 2])))


def _events(pairs: list[_Pair]) -> tuple[EventReport, ...]:
    """One report per uninterrupted period of a label, ending where the next event begins: each frame counts once."""
    spans: list[tuple[int, int, str]] = []
    for label, name in EVENT_NAMES.items():
        active = np.array([label in pair.truth.events for pair in pairs], bool)
        edges = np.flatnonzero(np.diff(active, prepend=False, append=False)).tolist()
        spans += [(start, end, name) for start, end in zip(edges[::2], edges[1::2], strict=True)]
    spans.sort()
    following = [*(start for start, _, _ in spans), len(pairs)][1:]
    return tuple(
        _event_report(name, pairs, start, min(end, limit), limit)
        for (start, end, name), limit in zip(spans, following, strict=True)
        if start < limit
    )


def _event_report(name: str, pairs: list[_Pair], start: int, end: int, limit: int) -> EventReport:
    """Of the frames up to ``end``; what happens up to ``limit`` is due to it."""
    during, until_next = pairs[start:end], pairs[start:limit]
    begin_s, origin_s = during[0].truth.time_s, pairs[0].truth.time_s
    noticed = next((pair for pair in until_next if pair.alarm), None)
    return EventReport(
        event=name,
        start_s=begin_s - origin_s,
        end_s=during[-1].truth.time_s - origin_s,
        frames=len(during),
        valid=sum(pair.record.verdict is Verdict.VALID for pair in during),
        harmless=name in HARMLESS,
        largest_tcp_shift_mm=1e3 * max(float(np.linalg.norm(p.truth.tcp_shift_m)) for p in during),
        after_correction=_corrected(during),
        noticed_after_s=None if noticed is None else noticed.truth.time_s - begin_s,
        alerts=tuple(_in_short(alert) for p in until_next for alert in p.record.alerts),
    )


def _in_short(alert: Alert) -> str:
    event = "" if alert.event is AlertEvent.NOTED else f" {alert.event}"
    return f"{alert.kind}{event} ({alert.cause})"


_MOST_SHOWN = 3
_Seqs = defaultdict[str, list[int]]
"""Frame numbers of each change of an alert."""


class Differences:
    """The differences between a recorded run and its replay, counted frame by frame."""

    def __init__(self) -> None:
        self.frames = self._other_numbers = 0
        self._judged: dict[str, list[str]] = {"verdict": [], "state": []}
        self._largest_m = 0.0
        self._changes = _AlertChanges(), _AlertChanges()
        self._alerts: tuple[_Seqs, _Seqs] = defaultdict(list), defaultdict(list)

    def add(self, then: FrameRecord, now: FrameRecord) -> None:
        """The same frame, as it was recorded and as it is replayed."""
        self.frames += 1
        self._other_numbers += msgspec.structs.replace(then, latency_ns=now.latency_ns) != now
        for what, differing in self._judged.items():
            before, after = getattr(then, what), getattr(now, what)
            if before is not after:
                differing.append(f"frame {now.seq}, {after} instead of {before}")
        if then.cam_T_grip is not None and now.cam_T_grip is not None:
            away_m = math.dist(now.cam_T_grip.translation_m, then.cam_T_grip.translation_m)
            self._largest_m = max(self._largest_m, away_m)
        for record, changes, seqs in zip((then, now), self._changes, self._alerts, strict=True):
            for alert in record.alerts:
                if what := changes.of(alert)[0]:
                    seqs[what].append(record.seq)

    def text(self, from_jpeg: bool) -> str:
        """``from_jpeg``: the replayed images were compressed as JPEG, which changes every number."""
        if not self._other_numbers:
            return f"all {self.frames} as they were recorded, every number the same"
        judged = [
            f"{count(len(differing), 'frame')} with another {what} (the first: {differing[0]})"
            for what, differing in self._judged.items()
            if differing
        ]
        if alerts := self._other_alerts():
            more = f" and {len(alerts) - _MOST_SHOWN} more" if len(alerts) > _MOST_SHOWN else ""
            judged = judged or ["verdicts and states as recorded"]
            judged.append(f"alerts differ: {', '.join(alerts[:_MOST_SHOWN])}{more}")
        same = f"verdicts, states and alerts of all {self.frames} frames as recorded"
        numbers = f"numbers differ in {self._other_numbers}, the TCP by up to {in_mm(self._largest_m)} mm"
        return f"{'; '.join(judged) or same}; {numbers}{' (the images were recorded as JPEG)' if from_jpeg else ''}"

    def _other_alerts(self) -> list[str]:
        """What is additional, missing, or at another frame, in words and order; of each kind the first."""
        then, now = self._alerts
        texts = []
        for what in {**now, **then}:
            pairs = itertools.zip_longest(now.get(what, ()), then.get(what, ()))
            now_seq, then_seq = next((pair for pair in pairs if pair[0] != pair[1]), (None, None))
            if now_seq is not None:
                recorded = "not recorded" if then_seq is None else f"recorded at {then_seq}"
                texts.append((now_seq, f"{what} at frame {now_seq}, {recorded}"))
            elif then_seq is not None:
                texts.append((then_seq, f"no {what}, recorded at frame {then_seq}"))
        return [text for _, text in sorted(texts)]
