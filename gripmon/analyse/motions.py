"""The camera's motions: when each began, how far it went, and its cause.

The beginning is determined from the frames and from the change points of the whole recording, since an alert comes
later than the motion that it reports.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from gripmon.analyse.affected import excess
from gripmon.analyse.content import Displacement, Event, Limits, Moment, Onset
from gripmon.analyse.correction import ChangePoint, correct
from gripmon.analyse.events import MOTIONS, AlertHistory, TimedAlert, explained, probability, worst
from gripmon.analyse.track import SECOND_NS, Track, displacement
from gripmon.analyse.vectors import MIN_FRAMES
from gripmon.model.records import AlertKind, Array, Severity
from gripmon.record.recordings import Recording

_SIDE_FRAMES = 15  # for the median that gives a level
_SETTLED = 0.95
_RINGING_NS = 2 * SECOND_NS  # a knocked mount swings about its final position
_SURE_SIGMAS = 5.0  # standard deviations
TITLES = {
    AlertKind.STEP: "The camera moved at once",
    AlertKind.CREEP: "The camera crept",
    AlertKind.DRIFT: "The camera drifted",
}


@dataclass(frozen=True, slots=True)
class _Stretch:
    """The alerts about one motion; a step is a separate motion, also within the history of one alert."""

    alerts: tuple[TimedAlert, ...]
    history: AlertHistory
    until_ns: int  # when the next one was detected, the alert was cleared, or the recording ends
    ended: bool  # because it was cleared

    @property
    def kind(self) -> AlertKind:
        """Step or creep if any of its alerts says so, otherwise drift."""
        kinds = [each.alert.kind for each in self.alerts]
        return next((k for k in (AlertKind.STEP, AlertKind.CREEP) if k in kinds), AlertKind.DRIFT)


def motions_of(track: Track, histories: Sequence[AlertHistory], points: Sequence[ChangePoint]) -> list[Event]:
    """One event per step, creep or drift, in order of time."""
    stretches = sorted(
        (s for history in histories if history.is_motion for s in _stretches(history, track)),
        key=lambda s: s.alerts[0].stamp_ns,
    )
    noise = frame_noise(track)
    events: list[Event] = []
    not_before_ns = int(track.stamp_ns[0]) if len(track) else 0
    for i, stretch in enumerate(stretches):
        following = stretches[i + 1] if i + 1 < len(stretches) else None
        event = _event(track, stretch, following, not_before_ns, noise, points)
        if not _is_new(event, events[-1] if events else None):
            events[-1] = msgspec.structs.replace(
                events[-1], story=(*events[-1].story, *event.story), end_text=event.end_text
            )
            continue
        events.append(event)
        not_before_ns = event.onset.latest_ns
    return events


def _stretches(history: AlertHistory, track: Track) -> list[_Stretch]:
    alerts = history.alerts
    if not alerts:
        return []
    starts = [0, *(i for i in range(1, len(alerts)) if _stepped(alerts[i - 1], alerts[i]))]
    end_ns = int(track.stamp_ns[-1]) if len(track) else alerts[-1].stamp_ns
    last_ns = end_ns if history.over is None else history.over.stamp_ns
    out = []
    for start, stop in zip(starts, [*starts[1:], len(alerts)], strict=True):
        until_ns = alerts[stop].stamp_ns if stop < len(alerts) else last_ns
        out.append(_Stretch(alerts[start:stop], history, until_ns, stop == len(alerts) and history.over is not None))
    return out


def _stepped(before: TimedAlert, now: TimedAlert) -> bool:
    """Whether ``now`` reports a new step."""
    if now.alert.kind is not AlertKind.STEP:
        return False
    old_m, new_m = before.alert.tcp_shift_m, now.alert.tcp_shift_m
    if before.alert.kind is not AlertKind.STEP or old_m is None or new_m is None:
        return before.alert.kind is not AlertKind.STEP
    return float(np.linalg.norm(np.subtract(new_m, old_m))) > 0.5 * float(np.linalg.norm(old_m))


def _is_new(event: Event, before: Event | None) -> bool:
    """Whether it is not the same step as before, only measured better."""
    if before is None or event.kind != AlertKind.STEP or before.kind != event.kind or before.alert_id != event.alert_id:
        return True
    return event.moved is None or event.moved.sigma_m is None or event.moved.size_m > _SURE_SIGMAS * event.moved.sigma_m


def _event(
    track: Track,
    stretch: _Stretch,
    following: _Stretch | None,
    not_before_ns: int,
    noise: Array,
    points: Sequence[ChangePoint],
) -> Event:
    kind, noticed_ns = stretch.kind, stretch.alerts[0].stamp_ns
    onset = _onset(track, stretch, not_before_ns, noise)
    until_ns = stretch.until_ns
    if following is not None and following.alerts[0].stamp_ns == until_ns:
        next_onset = step_onset(track, until_ns, onset.latest_ns, noise)
        until_ns = until_ns if next_onset is None else next_onset.earliest_ns
    moved, moved_in_s, at_rest_ns = _size(track, onset, until_ns, kind)
    if kind is AlertKind.STEP:
        onset = _change_point_onset(points, onset, moved) or onset
        at_rest_ns = onset.stamp_ns
    elif (
        kind is AlertKind.DRIFT
        and (at_once := None if moved is None else _change_point_onset(points, onset, moved, _NEARLY_ALL)) is not None
    ):
        # Detected late, since nothing was certain at the time.
        onset, kind = at_once, AlertKind.STEP
        moved, moved_in_s, at_rest_ns = _size(track, onset, until_ns, kind)
    alert = explained(stretch.alerts)
    assert alert is not None, "a stretch has alerts"
    rates = [each.alert.rate_m_per_min for each in stretch.alerts if each.alert.rate_m_per_min is not None]
    over = stretch.history.over if stretch.ended else None
    return Event(
        kind=kind,
        title=TITLES[kind],
        severity=worst(stretch.alerts),
        onset=onset,
        noticed_ns=noticed_ns,
        end_ns=at_rest_ns,
        end_text="" if over is None else over.alert.text,
        cause=alert.cause,
        cause_probability=probability(alert),
        part=alert.part,
        causes=alert.causes,
        moved=moved or _alerted_size(stretch),
        moved_in_s=moved_in_s,
        rate_m_per_min=rates[-1] if rates else None,
        alert_id=alert.alert_id,
        story=tuple(
            Moment(s.stamp_ns, f"{s.alert.event}: {s.alert.text}") for s in (*stretch.alerts, *([over] if over else ()))
        ),
    )


def _onset(track: Track, stretch: _Stretch, not_before_ns: int, noise: Array) -> Onset:
    noticed_ns = stretch.alerts[0].stamp_ns
    if stretch.kind is AlertKind.STEP:
        found = step_onset(track, noticed_ns, not_before_ns, noise)
    else:
        found = drift_onset(track, noticed_ns, not_before_ns, _level_at(track, not_before_ns), noise)
    return found or Onset(noticed_ns, not_before_ns, noticed_ns, "alert")


def _level_at(track: Track, stamp_ns: int) -> Array:
    """(6,) median of the first frames measured from a given time on."""
    start = track.index_at(stamp_ns)
    frames = start + np.flatnonzero(track.measured[start : start + 20 * _SIDE_FRAMES])[:_SIDE_FRAMES]
    return np.median(track.against_first[frames], axis=0) if frames.size else np.zeros(6)


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
        shift = each.alert.tcp_shift_m
        if shift is not None:
            return Displacement(shift, float(np.linalg.norm(shift)), None, each.alert.rotation_rad)
    return None


_COMPARED_FRAMES = 5  # frames on either side of a step that are compared
_BACK_NS = 5 * SECOND_NS  # a step is detected within this time
_CLEAR, _LIKELY = 3.0, 2.0  # robust standard deviations of the axis that is farthest off


def robust_sigma(values: Array) -> Array:
    """(6,) of (n, 6): from the median absolute deviation from the median; 0 for n = 0."""
    if not len(values):
        return np.zeros(6)
    return 1.4826 * np.median(np.abs(values - np.median(values, axis=0)), axis=0)


def frame_noise(track: Track) -> Array:
    """(6,) robust standard deviation from one measured frame to the next, divided by the square root of two."""
    return robust_sigma(np.diff(track.against_first[track.measured], axis=0)) / np.sqrt(2.0)


def step_onset(track: Track, noticed_ns: int, not_before_ns: int, noise: Array) -> Onset | None:
    """The place near ``noticed_ns`` where the frames on both sides differ most.

    None if too few frames were measured there.  Its time is that of the first frame after the step; ``earliest_ns`` is
    that of the last one before it.
    """
    start = track.index_at(max(noticed_ns - _BACK_NS, not_before_ns))
    stop = track.index_at(noticed_ns + SECOND_NS)
    frames = start + np.flatnonzero(track.measured[start:stop])
    if len(frames) < 2 * _COMPARED_FRAMES:
        return None
    medians = np.median(sliding_window_view(track.against_first[frames], _COMPARED_FRAMES, axis=0), axis=-1)
    jumps = (medians[_COMPARED_FRAMES:] - medians[:-_COMPARED_FRAMES]) / np.maximum(noise, 1e-12)
    i = _first_nearer(track.against_first[frames], int(np.argmax((jumps**2).sum(axis=1))) + _COMPARED_FRAMES)
    before, after = (int(track.stamp_ns[frames[k]]) for k in (i - 1, i))
    return Onset(after, before, after, "frames")


def _first_nearer(values: Array, i: int) -> int:
    """Refine index ``i``, which medians give to within a frame or two: the first frame near it that is closer to the
    level after the step than to that before.
    """
    start = max(i - _COMPARED_FRAMES, 0)
    before = np.median(values[start:i], axis=0)
    step = np.median(values[i : i + _COMPARED_FRAMES], axis=0) - before
    way = (values[start : i + _COMPARED_FRAMES] - before)[:, :3] @ step[:3]
    nearer = np.flatnonzero(way > 0.5 * float(step[:3] @ step[:3]))
    return max(start + int(nearer[0]), 1) if nearer.size else i


def drift_onset(track: Track, noticed_ns: int, not_before_ns: int, level: Array, noise: Array) -> Onset | None:
    """The last time before ``noticed_ns`` at the ``level`` (6,) before the motion; None with too few frames."""
    start, stop = track.index_at(not_before_ns), track.index_at(noticed_ns + 1)
    frames = start + np.flatnonzero(track.measured[start:stop])
    if len(frames) < 2 * _COMPARED_FRAMES:
        return None
    medians = np.median(sliding_window_view(track.against_first[frames], _COMPARED_FRAMES, axis=0), axis=-1)
    off = (np.abs(medians - level) / np.maximum(noise / np.sqrt(_COMPARED_FRAMES) * 1.25, 1e-12)).max(axis=1)
    stamps = track.stamp_ns[frames[_COMPARED_FRAMES // 2 : _COMPARED_FRAMES // 2 + len(off)]]
    at_level = np.flatnonzero(off < _CLEAR)
    sure = np.flatnonzero(off < _LIKELY)
    latest = min(noticed_ns, int(stamps[-1]))
    begun = int(stamps[at_level[-1]]) if at_level.size else int(stamps[0])
    earliest = int(stamps[sure[-1]]) if sure.size else int(stamps[0])
    return Onset(begun, min(earliest, begun), max(latest, begun), "frames")


_NEAR_NS = SECOND_NS // 4  # largest distance of an onset in the frames from its change point
_SIZE_RATIO = (0.5, 2.0)  # ratio of sizes
_NEARLY_ALL = 0.8  # fraction of a drift's size: a larger step is that drift

_SHORT_FRAMES = 20_000  # recordings up to this are searched as a whole
_MOST_FRAMES = 60_000  # searched in a long recording
_BLOCK_FRAMES = 30
_MARGIN_NS = 20 * SECOND_NS


def _change_point_onset(
    points: Sequence[ChangePoint], onset: Onset, moved: Displacement | None, least: float = _SIZE_RATIO[0]
) -> Onset | None:
    """The change point of this step, if there is one at its beginning with a similar size, at least ``least`` times as
    large; else None.
    """
    near = [
        p for p in points if p.earliest_ns - _NEAR_NS <= onset.latest_ns and onset.earliest_ns <= p.latest_ns + _NEAR_NS
    ]
    if not near:
        return None
    point = max(near, key=lambda p: float(np.linalg.norm(p.size[:3])))
    size_m = float(np.linalg.norm(point.size[:3]))
    if moved is not None and not least * moved.size_m <= size_m <= _SIZE_RATIO[1] * moved.size_m:
        return None
    return _onset_of(point)


def _onset_of(point: ChangePoint) -> Onset:
    return Onset(point.stamp_ns, point.earliest_ns, max(point.latest_ns, point.stamp_ns), "hindsight")


def unreported(points: Sequence[ChangePoint], events: Sequence[Event], limits: Limits) -> list[Event]:
    """One event per step beyond the limit that no alert reported."""
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


def change_points_of(source: Recording, track: Track, alerted_ns: Sequence[int], limits: Limits) -> list[ChangePoint]:
    """The change points of a recording, in order of time: of all of it or, if it is long, around alerts
    (``alerted_ns``) and around every significant change of the level.  None where too little was measured.
    """
    table = source.frames
    points: list[ChangePoint] = []
    matrices = None
    for part in _parts(track, alerted_ns, limits):
        if track.measured[part].sum() < MIN_FRAMES:
            continue
        matrices = table.matrices() if matrices is None else matrices
        try:
            found = correct(track.stamp_ns[part], matrices[part], table.covariance[part], track.measured[part])
        except ValueError:  # too few frames have a valid covariance
            continue
        points += found.change_points
    return points


def _parts(track: Track, alerted_ns: Sequence[int], limits: Limits) -> list[slice]:
    """Ranges of frames that may contain change points."""
    if len(track) <= _SHORT_FRAMES:
        return [slice(0, len(track))]
    measured = np.flatnonzero(track.measured)
    frames = measured[: len(measured) // _BLOCK_FRAMES * _BLOCK_FRAMES].reshape(-1, _BLOCK_FRAMES)
    levels = np.median(track.against_first[frames], axis=1)
    moved = levels[2:] - levels[:-2]
    size = np.linalg.norm(moved[:, :3], axis=1) / limits.affected_m
    size = np.maximum(size, np.linalg.norm(moved[:, 3:], axis=1) / limits.affected_rad)
    middles = track.stamp_ns[frames[1:-1, _BLOCK_FRAMES // 2]]
    wanted = np.unique(np.concatenate([np.array(alerted_ns, np.int64), middles[size >= 0.5]]))
    parts: list[slice] = []
    for stamp_ns in wanted.tolist():
        start, stop = track.index_at(stamp_ns - _MARGIN_NS), track.index_at(stamp_ns + _MARGIN_NS)
        if parts and start <= parts[-1].stop:
            start = parts.pop().start
        parts.append(slice(start, stop))
        if sum(part.stop - part.start for part in parts) >= _MOST_FRAMES:
            break
    return parts
