"""Estimates against the simulator's truth: how far the corrected TCP is off, and what was noticed of every event."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from gripmon.records import Array, FrameRecord, Origin, State, Verdict
from gripmon.simulator import FrameTruth

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


class Distribution(msgspec.Struct, frozen=True):
    """Mean, 95th percentile and maximum of absolute values; None where there are none."""

    mean: float | None
    p95: float | None
    max: float | None


class TcpErrors(msgspec.Struct, frozen=True):
    """Errors of the TCP's position in the camera frame, mm, across and along the optical axis."""

    frames: int
    across_mm: Distribution
    along_mm: Distribution


class EventReport(msgspec.Struct, frozen=True):
    """One event of the scenario and what the monitor made of it; times from the first frame."""

    event: str
    start_s: float
    end_s: float
    frames: int
    valid: int
    largest_tcp_shift_mm: float
    after_correction: TcpErrors
    noticed_after_s: float | None
    noticed_as: str | None
    alerts: tuple[str, ...]


class Comparison(msgspec.Struct, frozen=True):
    """Everything about a run on simulated frames."""

    frames: int
    verdicts: dict[str, int]
    without_correction: TcpErrors
    after_correction: TcpErrors
    smoothed: TcpErrors
    events: tuple[EventReport, ...]


class _Pair(NamedTuple):
    record: FrameRecord
    truth: FrameTruth


def compare(records: Iterable[FrameRecord], truth_of: Callable[[int], FrameTruth]) -> Comparison:
    """Compare records of simulated frames with ``truth_of(seq)``.

    ``after_correction`` and ``smoothed`` are over the frames whose verdict is valid: those that a controller would use.
    """
    pairs = [_Pair(record, truth_of(record.seq)) for record in records]
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
    if pair.record.cam_T_grip is None or pair.record.source is Origin.HELD:
        return None
    return np.array(pair.record.cam_T_grip.translation_m) - pair.truth.cam_T_grip[:3, 3]


def _smoothed_error(pair: _Pair) -> Array | None:
    if pair.record.smoothed is None:
        return None
    return np.array(pair.record.smoothed.translation_m) - pair.truth.cam_T_grip[:3, 3]


def _errors(errors_m: Sequence[Array]) -> TcpErrors:
    errors_mm = 1e3 * np.array(errors_m, dtype=float).reshape(-1, 3)
    across_mm = np.hypot(errors_mm[:, 0], errors_mm[:, 1])
    return TcpErrors(len(errors_mm), distribution(across_mm), distribution(np.abs(errors_mm[:, 2])))


def _events(pairs: list[_Pair]) -> tuple[EventReport, ...]:
    """One report for each uninterrupted time of a label; a bump lasts until the next event, as its shift stays."""
    spans: list[tuple[str, int, int]] = []
    for label in EVENT_NAMES:
        active = [label in pair.truth.events for pair in pairs]
        starts = [i for i, on in enumerate(active) if on and (i == 0 or not active[i - 1])]
        for start in starts:
            end = next((i for i in range(start, len(pairs)) if not active[i]), len(pairs))
            spans.append((label, start, end))
    spans.sort(key=lambda span: span[1])
    onsets = [start for _, start, _ in spans]
    reports = []
    for label, start, end in spans:
        if label == "bumped":
            end = min((onset for onset in onsets if onset > start), default=end)
        following = min((onset for onset in onsets if onset > start), default=len(pairs))
        reports.append(
            _event_report(
                EVENT_NAMES[label], pairs[start:end], pairs[start : max(end, following)], pairs[0].truth.time_s
            )
        )
    return tuple(reports)


def _event_report(name: str, during: list[_Pair], until_next: list[_Pair], start_s: float) -> EventReport:
    valid = [pair for pair in during if pair.record.verdict is Verdict.VALID]
    noticed = next((p for p in until_next if p.record.alerts or p.record.state is not State.TRACKING), None)
    how = None
    if noticed is not None:
        alert = noticed.record.alerts[0] if noticed.record.alerts else None
        how = f"state {noticed.record.state}" if alert is None else f"alert {alert.kind} ({alert.cause})"
    return EventReport(
        event=name,
        start_s=during[0].truth.time_s - start_s,
        end_s=during[-1].truth.time_s - start_s,
        frames=len(during),
        valid=len(valid),
        largest_tcp_shift_mm=1e3 * max(float(np.linalg.norm(p.truth.tcp_shift_m)) for p in during),
        after_correction=_errors([error for p in valid if (error := _error(p)) is not None]),
        noticed_after_s=None if noticed is None else noticed.truth.time_s - during[0].truth.time_s,
        noticed_as=how,
        alerts=tuple(f"{alert.kind} ({alert.cause})" for p in until_next for alert in p.record.alerts),
    )
