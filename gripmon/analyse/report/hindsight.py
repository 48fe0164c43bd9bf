"""What all that came later says of when the camera moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gripmon.analyse.report.content import Displacement, Event, Limits, Moment, Onset
from gripmon.analyse.report.happenings import MOTIONS
from gripmon.analyse.report.limits import excess
from gripmon.analyse.report.track import SECOND_NS, Track, displacement
from gripmon.analyse.smoother import LEAST_FRAMES, ChangePoint, correct
from gripmon.model.records import AlertKind, Severity
from gripmon.record.read import Recording

_NEAR_NS = SECOND_NS // 4  # an onset in the frames and its change point are no farther apart
_ALIKE = (0.5, 2.0)  # times as large
_NEARLY_ALL = 0.8  # of a drift's size: what one step must make up for it to be that step
_SURE = 5.0  # standard deviations
_SHORT_FRAMES = 20_000  # a whole recording of so many is looked at
_MOST_FRAMES = 60_000  # of a long one: a recording that never rests is told by its frames alone from there on
_BLOCK_FRAMES = 30
_MARGIN_NS = 20 * SECOND_NS


@dataclass(frozen=True, slots=True)
class Hindsight:
    """Change points of a recording, in order of time; none where too little was measured."""

    points: tuple[ChangePoint, ...] = ()

    def onset(self, onset: Onset, moved: Displacement | None, *, least: float = _ALIKE[0]) -> Onset:
        """The change point that is this step's, if one lies where it began and is as large, at least a share ``least``
        of it; else the onset as it is.
        """
        near = [
            p
            for p in self.points
            if p.earliest_ns - _NEAR_NS <= onset.latest_ns and onset.earliest_ns <= p.latest_ns + _NEAR_NS
        ]
        if not near:
            return onset
        point = max(near, key=lambda p: float(np.linalg.norm(p.size[:3])))
        size_m = float(np.linalg.norm(point.size[:3]))
        if moved is not None and not least * moved.size_m <= size_m <= _ALIKE[1] * moved.size_m:
            return onset
        return Onset(point.stamp_ns, point.earliest_ns, max(point.latest_ns, point.stamp_ns), "hindsight")

    def step_of(self, onset: Onset, moved: Displacement | None) -> Onset | None:
        """The one change point that nearly all of a drift was; None: it was no step."""
        found = self.onset(onset, moved, least=_NEARLY_ALL)
        return None if moved is None or found is onset else found

    def unsaid(self, events: Sequence[Event], limits: Limits) -> list[Event]:
        """Steps past the limit that were never an alert: an event for each."""
        told = [(e.onset.earliest_ns, max(e.end_ns or 0, e.onset.latest_ns)) for e in events if e.kind in MOTIONS]
        out = []
        for point in self.points:
            moved = displacement(point.size, np.sqrt(np.maximum(point.size_covariance.diagonal(), 0.0)))
            sure = moved.sigma_m is not None and moved.size_m > _SURE * moved.sigma_m
            known = any(a - SECOND_NS <= point.stamp_ns <= b + SECOND_NS for a, b in told)
            if known or not sure or excess(moved.size_m, 0.0, limits) < 1.0:
                continue
            stamp_ns = point.stamp_ns
            out.append(
                Event(
                    kind=AlertKind.STEP,
                    title="The camera moved at once; found afterwards",
                    severity=Severity.WARNING,
                    onset=Onset(stamp_ns, point.earliest_ns, max(point.latest_ns, stamp_ns), "hindsight"),
                    end_ns=stamp_ns,
                    moved=moved,
                    moved_in_s=0.0,
                    story=(Moment(stamp_ns, "a change that no alert told of, found from the whole recording"),),
                )
            )
        return out


def look_back(source: Recording, track: Track, said_ns: Sequence[int], limits: Limits) -> Hindsight:
    """The change points of a recording: of all of it, or, where it is long, of the minutes around what was said
    (``said_ns``) and around every place where the level changes by what matters.
    """
    table = source.frames
    points: list[ChangePoint] = []
    matrices = None
    for part in _parts(track, said_ns, limits):
        if track.measured[part].sum() < LEAST_FRAMES:
            continue
        matrices = table.matrices() if matrices is None else matrices
        try:
            found = correct(track.stamp_ns[part], matrices[part], table.covariance[part], track.measured[part])
        except ValueError:  # too few of the frames have a covariance that is one
            continue
        points += found.change_points
    return Hindsight(tuple(points))


def _parts(track: Track, said_ns: Sequence[int], limits: Limits) -> list[slice]:
    """Frames that are worth the time."""
    if len(track) <= _SHORT_FRAMES:
        return [slice(0, len(track))]
    measured = np.flatnonzero(track.measured)
    frames = measured[: len(measured) // _BLOCK_FRAMES * _BLOCK_FRAMES].reshape(-1, _BLOCK_FRAMES)
    levels = np.median(track.against_first[frames], axis=1)
    moved = levels[2:] - levels[:-2]
    size = np.linalg.norm(moved[:, :3], axis=1) / limits.affected_m
    size = np.maximum(size, np.linalg.norm(moved[:, 3:], axis=1) / limits.affected_rad)
    middles = track.stamp_ns[frames[1:-1, _BLOCK_FRAMES // 2]]
    wanted = np.unique(np.concatenate([np.array(said_ns, np.int64), middles[size >= 0.5]]))
    parts: list[slice] = []
    for stamp_ns in wanted.tolist():
        start, stop = track.index_at(stamp_ns - _MARGIN_NS), track.index_at(stamp_ns + _MARGIN_NS)
        if parts and start <= parts[-1].stop:
            start = parts.pop().start
        parts.append(slice(start, stop))
        if sum(part.stop - part.start for part in parts) >= _MOST_FRAMES:
            break
    return parts
