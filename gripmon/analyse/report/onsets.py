"""When did it begin?  In the frames themselves: an alert comes later than what it is about."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from gripmon.analyse.report.clock import SECOND_NS
from gripmon.analyse.report.content import Onset
from gripmon.analyse.report.track import Track
from gripmon.model.records import Array

_SIDE = 5  # frames on either side of a step that are compared
_BACK_NS = 5 * SECOND_NS  # a step is noticed within this time
_CLEAR, _LIKELY = 3.0, 2.0  # robust standard deviations of the axis that is farthest off


def robust_sigma(values: Array) -> Array:
    """(6,) of (n, 6): from the median absolute deviation from the median; 0 for n = 0."""
    if not len(values):
        return np.zeros(6)
    return 1.4826 * np.median(np.abs(values - np.median(values, axis=0)), axis=0)


def frame_noise(track: Track, among: NDArray[np.intp] | None = None) -> Array:
    """(6,) standard deviation from one measured frame to the next, over the square root of two; robust."""
    values = track.against_first[np.flatnonzero(track.measured) if among is None else among]
    return robust_sigma(np.diff(values, axis=0)) / np.sqrt(2.0)


def step_onset(track: Track, noticed_ns: int, not_before_ns: int, noise: Array) -> Onset | None:
    """The place near ``noticed_ns`` where the frames on both sides differ most.

    None if too few frames were measured there.  The time is that of the first frame that shows it; ``earliest_ns`` that
    of the last one that doesn't.
    """
    start = track.index_at(max(noticed_ns - _BACK_NS, not_before_ns))
    stop = track.index_at(noticed_ns + SECOND_NS)
    frames = start + np.flatnonzero(track.measured[start:stop])
    if len(frames) < 2 * _SIDE:
        return None
    medians = np.median(sliding_window_view(track.against_first[frames], _SIDE, axis=0), axis=-1)
    jumps = (medians[_SIDE:] - medians[:-_SIDE]) / np.maximum(noise, 1e-12)
    i = _first_nearer(track.against_first[frames], int(np.argmax((jumps**2).sum(axis=1))) + _SIDE)
    before, after = (int(track.stamp_ns[frames[k]]) for k in (i - 1, i))
    return Onset(after, before, after, "frames")


def _first_nearer(values: Array, i: int) -> int:
    """Medians are the same one or two frames off: of those around index ``i`` the first one that is nearer to the level
    after than to that before.
    """
    start = max(i - _SIDE, 0)
    before = np.median(values[start:i], axis=0)
    step = np.median(values[i : i + _SIDE], axis=0) - before
    way = (values[start : i + _SIDE] - before)[:, :3] @ step[:3]
    nearer = np.flatnonzero(way > 0.5 * float(step[:3] @ step[:3]))
    return max(start + int(nearer[0]), 1) if nearer.size else i


def drift_onset(track: Track, noticed_ns: int, not_before_ns: int, level: Array, noise: Array) -> Onset | None:
    """Back from ``noticed_ns`` to where the motion was still at its ``level`` (6,) before; None with too few frames."""
    start, stop = track.index_at(not_before_ns), track.index_at(noticed_ns + 1)
    frames = start + np.flatnonzero(track.measured[start:stop])
    if len(frames) < 2 * _SIDE:
        return None
    medians = np.median(sliding_window_view(track.against_first[frames], _SIDE, axis=0), axis=-1)
    off = (np.abs(medians - level) / np.maximum(noise / np.sqrt(_SIDE) * 1.25, 1e-12)).max(axis=1)
    stamps = track.stamp_ns[frames[_SIDE // 2 : _SIDE // 2 + len(off)]]
    at_level = np.flatnonzero(off < _CLEAR)
    sure = np.flatnonzero(off < _LIKELY)
    latest = min(noticed_ns, int(stamps[-1]))
    begun = int(stamps[at_level[-1]]) if at_level.size else int(stamps[0])
    earliest = int(stamps[sure[-1]]) if sure.size else int(stamps[0])
    return Onset(begun, min(earliest, begun), max(latest, begun), "frames")
