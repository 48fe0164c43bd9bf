"""Estimates compared with the simulator's truth: errors of the corrected TCP, and detection of every event."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from gripmon.analyse.content import count
from gripmon.model.records import Alert, AlertEvent, AlertKind, Array, FrameRecord, Origin, Severity, Verdict
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


class _Pair(NamedTuple):
    record: FrameRecord
    truth: FrameTruth
    alarm: bool


class _Alarms:
    """Separates alarms from other alerts, which say that something is over or continues."""

    def __init__(self) -> None:
        self._known: dict[str, tuple[AlertKind, Severity]] = {}

    def among(self, alerts: Iterable[Alert]) -> bool:
        """Whether alerts of one frame report a new fault, or one that changed its kind or became more severe."""
        alarms = [self._is_one(alert) for alert in alerts]  # all of them must be evaluated
        return any(alarms)

    def _is_one(self, alert: Alert) -> bool:
        before = self._known.get(alert.alert_id)
        if alert.event is AlertEvent.CLEARED or alert.kind in NO_ALARMS:
            return False
        if alert.event is AlertEvent.NOTED:
            return alert.severity is not Severity.INFO
        self._known[alert.alert_id] = (alert.kind, alert.severity)
        if before is None:
            return True
        ranks = list(Severity)
        return alert.kind is not before[0] or ranks.index(alert.severity) > ranks.index(before[1])


def compare(records: Iterable[FrameRecord], truth_of: Callable[[int], FrameTruth]) -> Comparison:
    """Compare records of simulated frames with ``truth_of(seq)``.

    ``after_correction`` and ``smoothed`` are over the frames whose verdict is valid: those that a controller would use.
    """
    alarms = _Alarms()
    pairs = [_Pair(record, truth_of(record.seq), alarms.among(record.alerts)) for record in records]
    valid = [pair for pair in pairs if pair.record.verdict is Verdict.VALID]
    verdicts = {verdict.value: sum(p.record.verdict is verdict for p in pairs) for verdict in Verdict}
    return Comparison(
        frames=len(pairs),
        verdicts=verdicts,
        without_correction=_errors([p.truth.tcp_shift_m for p in pairs]),
        after_correction=_errors([error for p in valid if (error := _error(p)) is not None]),
        smoothed=_errors([error for p in valid if (error := _smoothed_error(p)) is not None]),
        events=_events(pairs),
    )


def distribution(values: Array) -> Distribution:
    """Mean, 95th percentile, maximum."""
    if not values.size:
        return Distribution(None, None, None)
    return Distribution(float(values.mean()), float(np.percentile(values, 95.0)), float(values.max()))


def _error(pair: _Pair) -> Array | None:
    """Error (3,) of the TCP in camera axes, m; None for a frame without a measurement of its own."""
    if pair.record.measured_T is None or pair.record.source is Origin.HELD:
        return None
    return np.array(pair.record.measured_T.translation_m) - pair.truth.cam_T_grip[:3, 3]


def _smoothed_error(pair: _Pair) -> Array | None:
    if pair.record.smoothed is None:
        return None
    return np.array(pair.record.smoothed.translation_m) - pair.truth.cam_T_grip[:3, 3]


def _errors(errors_m: Sequence[Array]) -> TcpErrors:
    errors_mm = 1e3 * np.array(errors_m, dtype=float).reshape(-1, 3)
    across_mm = np.hypot(errors_mm[:, 0], errors_mm[:, 1])
    return TcpErrors(len(errors_mm), distribution(across_mm), distribution(np.abs(errors_mm[:, 2])))


def _events(pairs: list[_Pair]) -> tuple[EventReport, ...]:
    """One report per uninterrupted period of a label, ending where the next event begins: each frame counts once."""
    spans: list[tuple[int, int, str]] = []
    for label, name in EVENT_NAMES.items():
        active = [label in pair.truth.events for pair in pairs]
        starts = [i for i, on in enumerate(active) if on and (i == 0 or not active[i - 1])]
        spans += [(i, next((k for k in range(i, len(pairs)) if not active[k]), len(pairs)), name) for i in starts]
    spans.sort()
    following = [start for start, _, _ in spans[1:]] + [len(pairs)]
    origin_s = pairs[0].truth.time_s if pairs else 0.0
    return tuple(
        _event_report(name, pairs[start : min(end, limit)], pairs[start:limit], origin_s)
        for (start, end, name), limit in zip(spans, following, strict=True)
        if start < limit
    )


def _event_report(name: str, during: list[_Pair], until_next: list[_Pair], origin_s: float) -> EventReport:
    valid = [pair for pair in during if pair.record.verdict is Verdict.VALID]
    noticed = next((pair for pair in until_next if pair.alarm), None)
    return EventReport(
        event=name,
        start_s=during[0].truth.time_s - origin_s,
        end_s=during[-1].truth.time_s - origin_s,
        frames=len(during),
        valid=len(valid),
        harmless=name in HARMLESS,
        largest_tcp_shift_mm=1e3 * max(float(np.linalg.norm(p.truth.tcp_shift_m)) for p in during),
        after_correction=_errors([error for p in valid if (error := _error(p)) is not None]),
        noticed_after_s=None if noticed is None else noticed.truth.time_s - during[0].truth.time_s,
        alerts=tuple(_in_short(alert) for p in until_next for alert in p.record.alerts),
    )


def _in_short(alert: Alert) -> str:
    event = "" if alert.event is AlertEvent.NOTED else f" {alert.event}"
    return f"{alert.kind}{event} ({alert.cause})"


_MOST_SHOWN = 3


class Differences:
    """The differences between a recorded run and its replay, counted frame by frame."""

    def __init__(self) -> None:
        self.frames = 0
        self._same = self._verdicts = self._states = 0
        self._first: dict[str, str] = {}
        self._largest_m = 0.0
        self._alerts_then, self._alerts_now = _AlertChanges(), _AlertChanges()

    def add(self, then: FrameRecord, now: FrameRecord) -> None:
        """The same frame, as it was recorded and as it is replayed."""
        self.frames += 1
        self._same += msgspec.structs.replace(then, latency_ns=now.latency_ns) == now
        for what in ("verdict", "state"):
            before, after = getattr(then, what), getattr(now, what)
            if before is not after:
                self._first.setdefault(what, f"frame {now.seq}, {after} instead of {before}")
        self._verdicts += then.verdict is not now.verdict
        self._states += then.state is not now.state
        if then.cam_T_grip is not None and now.cam_T_grip is not None:
            self._largest_m = max(
                self._largest_m, math.dist(now.cam_T_grip.translation_m, then.cam_T_grip.translation_m)
            )
        self._alerts_then.add(then.seq, then.alerts)
        self._alerts_now.add(now.seq, now.alerts)

    def text(self, from_jpeg: bool) -> str:
        """``from_jpeg``: the replayed images were compressed as JPEG, which changes every number."""
        if self._same == self.frames:
            return f"all {self.frames} as they were recorded, every number the same"
        alerts = self._alerts_now.against(self._alerts_then)
        judged = [
            f"{count(number, 'frame')} with another {what} (the first: {self._first[what]})"
            for what, number in (("verdict", self._verdicts), ("state", self._states))
            if number
        ]
        if alerts:
            judged = [*(judged or ["verdicts and states as recorded"]), f"alerts differ: {alerts}"]
        same = f"verdicts, states and alerts of all {self.frames} frames as recorded"
        numbers = f"numbers differ in {self.frames - self._same}, the TCP by up to {in_mm(self._largest_m)} mm"
        why = " (the images were recorded as JPEG)" if from_jpeg else ""
        return f"{'; '.join(judged) or same}; {numbers}{why}"


class _AlertChanges:
    """When alerts began, ended, or changed severity, by kind and change."""

    def __init__(self) -> None:
        self._severity: dict[str, str] = {}  # of open alerts, by id
        self._at: defaultdict[str, list[int]] = defaultdict(list)

    def add(self, seq: int, alerts: tuple[Alert, ...]) -> None:
        for alert in alerts:
            known = self._severity.get(alert.alert_id)
            if alert.event == "cleared":
                self._severity.pop(alert.alert_id, None)
                self._at[f"{alert.kind} cleared"].append(seq)
            elif alert.event == "noted":
                self._at[f"{alert.kind} ({alert.severity})"].append(seq)
            elif known != alert.severity:
                self._severity[alert.alert_id] = alert.severity
                change = "raised as" if alert.event == "raised" else "becomes"
                self._at[f"{alert.kind} {change} {alert.severity}"].append(seq)

    def against(self, then: _AlertChanges) -> str:
        """What is additional, missing, or at another frame than then, in words; empty if nothing."""
        texts = []
        for what in sorted({*self._at, *then._at}, key=lambda w: ((self._at.get(w) or then._at[w])[0], w)):
            now_at, then_at = self._at.get(what, []), then._at.get(what, [])
            if len(now_at) > len(then_at):
                texts.append(f"{what} at frame {now_at[len(then_at)]}, not recorded")
            elif len(now_at) < len(then_at):
                texts.append(f"no {what}, recorded at frame {then_at[len(now_at)]}")
            elif now_at != then_at:
                now_seq, then_seq = next(pair for pair in zip(now_at, then_at, strict=True) if pair[0] != pair[1])
                texts.append(f"{what} at frame {now_seq}, recorded at {then_seq}")
        more = len(texts) - _MOST_SHOWN
        return ", ".join(texts[:_MOST_SHOWN]) + (f" and {more} more" if more > 0 else "")
