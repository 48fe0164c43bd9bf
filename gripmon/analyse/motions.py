"""The camera's motions: when each began, how far it went, and its cause.

Change points of the whole recording decide when the camera moved at once, since an alert comes later than the motion
that it reports; alerts add cause, severity and story, and say of slow motions that there were any.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from gripmon.analyse.affected import excess
from gripmon.analyse.content import Displacement, Event, Limits, Moment, Onset
from gripmon.analyse.correction import ChangePoint
from gripmon.analyse.events import MOTIONS, AlertHistory, TimedAlert, annotation
from gripmon.analyse.track import SECOND_NS, Track, displacement
from gripmon.model.records import AlertKind, Array, Severity

_SIDE_FRAMES = 15  # for the median that gives a level
_SETTLED = 0.95
_RINGING_NS = 2 * SECOND_NS  # a knocked mount swings about its final position
_SURE_SIGMAS = 5.0  # standard deviations
_NOTICED_NS = 5 * SECOND_NS  # a step is noticed within this time
_NEARLY_ALL, _AT_MOST = 0.8, 2.0  # a change of this part of a drift's size is that drift
_COMPARED_FRAMES = 5  # for the median that tells whether a creep has begun
_CLEAR, _LIKELY = 3.0, 2.0  # robust standard deviations of the axis that is farthest off
_TITLES = {
    AlertKind.STEP: "The camera moved at once",
    AlertKind.CREEP: "The camera crept",
    AlertKind.DRIFT: "The camera drifted",
}


@dataclass(frozen=True, slots=True)
class _Stretch:
    """The alerts about one motion; a step is a separate motion, also within the history of one alert."""

    alerts: tuple[TimedAlert, ...]
    over: TimedAlert | None  # the one that cleared it, if it is the history's last stretch
    until_ns: int  # when the next one was noticed, the alert was cleared, or the recording ends

    @property
    def kind(self) -> AlertKind:
        """Step or creep if any of its alerts says so, otherwise drift."""
        kinds = [each.alert.kind for each in self.alerts]
        return next((k for k in (AlertKind.STEP, AlertKind.CREEP) if k in kinds), AlertKind.DRIFT)

    @property
    def noticed_ns(self) -> int:
        return self.alerts[0].stamp_ns


def motions_of(
    track: Track, histories: Sequence[AlertHistory], points: Sequence[ChangePoint], limits: Limits
) -> list[Event]:
    """One event per step, creep or drift that an alert reports, in order of time; then one per step beyond the limits
    that none does.
    """
    stretches = sorted(
        (s for history in histories if history.is_motion for s in _stretches(history, track)),
        key=lambda s: s.noticed_ns,
    )
    noise = frame_noise(track)
    events: list[Event] = []
    not_before_ns = int(track.stamp_ns[0]) if len(track) else 0
    for stretch, following in itertools.zip_longest(stretches, stretches[1:]):
        event = _event(track, stretch, following, not_before_ns, noise, points)
        if events and _is_same(events[-1], event):
            events[-1] = msgspec.structs.replace(
                events[-1], story=(*events[-1].story, *event.story), end_text=event.end_text
            )
            continue
        events.append(event)
        not_before_ns = event.onset.latest_ns
    return events + _unreported(points, events, limits)


def _stretches(history: AlertHistory, track: Track) -> list[_Stretch]:
    alerts = history.alerts
    if not alerts:
        return []
    starts = [0, *(i for i in range(1, len(alerts)) if _stepped(alerts[i - 1], alerts[i])), len(alerts)]
    end_ns = int(track.stamp_ns[-1]) if len(track) else alerts[-1].stamp_ns
    last_ns = end_ns if history.over is None else history.over.stamp_ns
    out = [_Stretch(alerts[a:b], None, alerts[b].stamp_ns) for a, b in itertools.pairwise(starts[:-1])]
    return [*out, _Stretch(alerts[starts[-2] :], history.over, last_ns)]


def _stepped(before: TimedAlert, now: TimedAlert) -> bool:
    """Whether ``now`` reports a new step."""
    if now.alert.kind is not AlertKind.STEP:
        return False
    old_m, new_m = before.alert.tcp_shift_m, now.alert.tcp_shift_m
    if before.alert.kind is not AlertKind.STEP or old_m is None or new_m is None:
        return before.alert.kind is not AlertKind.STEP
    return float(np.linalg.norm(np.subtract(new_m, old_m))) > 0.5 * float(np.linalg.norm(old_m))


def _is_same(before: Event, event: Event) -> bool:
    """Whether it is the same step as before, only measured better."""
    if event.kind != AlertKind.STEP or (before.kind, before.alert_id) != (event.kind, event.alert_id):
        return False
    moved = event.moved
    return moved is not None and moved.sigma_m is not None and moved.size_m <= _SURE_SIGMAS * moved.sigma_m


def _event(
    track: Track,
    stretch: _Stretch,
    following: _Stretch | None,
    not_before_ns: int,
    noise: Array,
    points: Sequence[ChangePoint],
) -> Event:
    kind, until_ns = stretch.kind, stretch.until_ns
    if following is not None and following.noticed_ns == until_ns:
        next_point = _largest(points, until_ns - _NOTICED_NS, until_ns + SECOND_NS, stretch.noticed_ns)
        until_ns = until_ns if next_point is None else next_point.earliest_ns
    onset = Onset(stretch.noticed_ns, min(not_before_ns, stretch.noticed_ns), stretch.noticed_ns, "alert")
    if kind is AlertKind.STEP:
        begin_ns, end_ns = stretch.noticed_ns - _NOTICED_NS, stretch.noticed_ns + SECOND_NS
        at_once = _largest(points, begin_ns, end_ns, not_before_ns)
    else:
        onset = _drift_onset(track, stretch.noticed_ns, not_before_ns, noise) or onset
        moved = _size(track, onset, until_ns, kind)[0]
        at_once = _largest(points, onset.earliest_ns - SECOND_NS // 4, onset.latest_ns, not_before_ns)
        if at_once is not None and moved is not None:
            ratio = float(np.linalg.norm(at_once.size[:3])) / max(moved.size_m, 1e-12)
            # Noticed late, since nothing was certain at the time.
            at_once = at_once if _NEARLY_ALL <= ratio <= _AT_MOST else None
    if at_once is not None:
        onset, kind = _onset_of(at_once), AlertKind.STEP
    moved, moved_in_s, at_rest_ns = _size(track, onset, until_ns, kind)
    rates = [each.alert.rate_m_per_min for each in stretch.alerts if each.alert.rate_m_per_min is not None]
    return Event(
        kind=kind,
        title=_TITLES[kind],
        onset=onset,
        end_ns=at_rest_ns,
        moved=moved or _alerted_size(stretch),
        moved_in_s=moved_in_s,
        rate_m_per_min=rates[-1] if rates else None,
        **annotation(stretch.alerts, stretch.over),
    )


def _largest(points: Sequence[ChangePoint], begin_ns: int, end_ns: int, not_before_ns: int) -> ChangePoint | None:
    """The largest change that may have happened in a time, after another motion."""
    near = [p for p in points if begin_ns <= p.latest_ns and p.earliest_ns <= end_ns and p.stamp_ns > not_before_ns]
    return max(near, key=lambda p: float(np.linalg.norm(p.size[:3])), default=None)


def _onset_of(point: ChangePoint) -> Onset:
    return Onset(point.stamp_ns, point.earliest_ns, max(point.latest_ns, point.stamp_ns), "hindsight")


def _size(track: Track, onset: Onset, until_ns: int, kind: AlertKind) -> tuple[Displacement | None, float | None, int]:
    """How far it went, in which time (s), and when it had settled."""
    measured = np.flatnonzero(track.measured)
    stamps = track.stamp_ns[measured]
    before = measured[stamps <= onset.earliest_ns][-_SIDE_FRAMES:]
    since = measured[(stamps >= onset.stamp_ns) & (stamps <= max(until_ns, onset.stamp_ns))]
    if kind is AlertKind.STEP:  # what follows may be another motion
        after = since[track.stamp_ns[since] <= onset.stamp_ns + _RINGING_NS]
    else:
        after = since[-_SIDE_FRAMES:]
    if not before.size or not after.size:
        return None, None, onset.stamp_ns
    level = np.median(track.against_first[before], axis=0)
    vector = np.median(track.against_first[after], axis=0) - level
    # The systematic part of the error is the same before and after, so that the sum is conservative.
    sigma = np.hypot(np.median(track.sigma[before], axis=0), np.median(track.sigma[after], axis=0))
    moved = displacement(vector, sigma)
    if kind is AlertKind.STEP:
        return moved, 0.0, onset.stamp_ns
    along = (track.against_first[since] - level)[:, :3] @ vector[:3]
    reached = np.flatnonzero(along < _SETTLED * float(vector[:3] @ vector[:3]))
    settled = since[min(int(reached[-1]) + 1, len(since) - 1)] if reached.size else since[0]
    settled_ns = int(track.stamp_ns[settled])
    return moved, 1e-9 * (settled_ns - onset.stamp_ns), settled_ns


def _alerted_size(stretch: _Stretch) -> Displacement | None:
    """Shift from the reference by the last alert that has one; without an uncertainty."""
    for each in reversed(stretch.alerts):
        if (shift := each.alert.tcp_shift_m) is not None:
            return Displacement(shift, float(np.linalg.norm(shift)), None, each.alert.rotation_rad)
    return None


def robust_sigma(values: Array) -> Array:
    """(6,) of (n, 6): from the median absolute deviation from the median; 0 for n = 0."""
    if not len(values):
        return np.zeros(6)
    return 1.4826 * np.median(np.abs(values - np.median(values, axis=0)), axis=0)


def frame_noise(track: Track) -> Array:
    """(6,) robust standard deviation from one measured frame to the next, divided by the square root of two."""
    return robust_sigma(np.diff(track.against_first[track.measured], axis=0)) / np.sqrt(2.0)


def _drift_onset(track: Track, noticed_ns: int, not_before_ns: int, noise: Array) -> Onset | None:
    """The last time before ``noticed_ns`` at the level of the first frames; None with too few frames."""
    start, stop = track.index_at(not_before_ns), track.index_at(noticed_ns + 1)
    frames = start + np.flatnonzero(track.measured[start:stop])
    if len(frames) < 2 * _COMPARED_FRAMES:
        return None
    level = np.median(track.against_first[frames[:_SIDE_FRAMES]], axis=0)
    medians = np.median(sliding_window_view(track.against_first[frames], _COMPARED_FRAMES, axis=0), axis=-1)
    off = (np.abs(medians - level) / np.maximum(noise / np.sqrt(_COMPARED_FRAMES) * 1.25, 1e-12)).max(axis=1)
    stamps = track.stamp_ns[frames[_COMPARED_FRAMES // 2 : _COMPARED_FRAMES // 2 + len(off)]]

    def last(within: float) -> int:
        at = np.flatnonzero(off < within)
        return int(stamps[at[-1]] if at.size else stamps[0])

    begun = last(_CLEAR)
    return Onset(begun, min(last(_LIKELY), begun), max(min(noticed_ns, int(stamps[-1])), begun), "frames")


def _unreported(points: Sequence[ChangePoint], events: Sequence[Event], limits: Limits) -> list[Event]:
    known = [(e.onset.earliest_ns, max(e.end_ns or 0, e.onset.latest_ns)) for e in events if e.kind in MOTIONS]
    out = []
    for point in points:
        moved = displacement(point.size, np.sqrt(np.maximum(point.size_covariance.diagonal(), 0.0)))
        sure = moved.sigma_m is not None and moved.size_m > _SURE_SIGMAS * moved.sigma_m
        alerted = any(a - SECOND_NS <= point.stamp_ns <= b + SECOND_NS for a, b in known)
        if alerted or not sure or excess(moved.size_m, 0.0, limits) < 1.0:
            continue
        out.append(
            Event(
                kind=AlertKind.STEP,
                title="The camera moved at once; found afterwards",
                severity=Severity.WARNING,
                onset=_onset_of(point),
                end_ns=point.stamp_ns,
                moved=moved,
                moved_in_s=0.0,
                story=(Moment(point.stamp_ns, "a change without an alert, found from the whole recording"),),
            )
        )
    return out
