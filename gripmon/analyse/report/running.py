"""How the monitor ran: rates, latency, noise, shares of verdicts and states."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gripmon.analyse.report.affected import runs_of_equal
from gripmon.analyse.report.content import Noise, Running, Share, Slice, Stretch
from gripmon.analyse.report.motions import robust_sigma
from gripmon.analyse.report.track import SECOND_NS, Clock, Track
from gripmon.model.records import Array, StateRecord
from gripmon.record.read import Recording

if TYPE_CHECKING:
    from gripmon.record.read import FrameTable

_FEWEST = 30
_SLICES = 120
_MOST_STRETCHES = 2000  # of a history; shorter ones than a part of it are joined
_NEIGHBOURS_NS = SECOND_NS // 2


def dropped_of(source: Recording) -> tuple[str, ...]:
    """Those of the faults that tell of frames which the monitor or its recorder had no time for, or nothing is wrong
    with the files: these are no damage.
    """
    seq = source.frames.seq
    missing = int(seq[-1] - seq[0]) + 1 - len(seq) if len(seq) else 0
    by_choice = sum(
        max((getattr(state, name) for state in source.states), default=0)
        for name in ("frames_dropped", "recording_dropped")
    )
    whole = set(source.faults) <= set(source.gaps)
    return tuple(source.gaps) if whole or missing <= by_choice else ()


def running_of(
    table: FrameTable, clock: Clock, track: Track, states: Sequence[StateRecord], dropped: tuple[str, ...]
) -> Running:
    """Of one recording; ``states`` tell how much the recorder dropped, ``dropped`` where."""
    steps_s = 1e-9 * np.diff(clock.stamp_ns)
    latency_s = 1e-9 * table.latency_ns[table.latency_ns > 0]
    pauses_s = steps_s[steps_s > 1.0]
    return Running(
        frames=len(table),
        frames_dropped=int(table.seq[-1] - table.seq[0]) + 1 - len(table) if len(table) else 0,
        dropped=dropped,
        frames_refused=int(table.refused.sum()),
        monitor_dropped=max((s.frames_dropped for s in states), default=None),
        recording_dropped=max((s.recording_dropped for s in states), default=None),
        frames_per_s=float(1.0 / np.median(steps_s)) if steps_s.size and np.median(steps_s) > 0.0 else None,
        gaps=len(pauses_s),
        longest_gap_s=float(pauses_s.max(initial=0.0)),
        latency_median_s=float(np.median(latency_s)) if latency_s.size else None,
        latency_p99_s=float(np.percentile(latency_s, 99.0)) if latency_s.size else None,
        noise=_noise(table, track),
        verdicts=_shares(table.VERDICTS, table.verdict),
        states=_shares(table.STATES, table.state),
        state_history=_history(table.STATES, table.state, clock),
        verdict_history=_history(table.VERDICTS, table.verdict, clock),
        slices=_slices(table, clock),
    )


def _noise(table: FrameTable, track: Track) -> Noise | None:
    """Between successive frames: a motion adds to few of the differences, and the median passes over them."""
    pairs = np.flatnonzero(track.measured[1:] & track.measured[:-1] & (np.diff(track.stamp_ns) < _NEIGHBOURS_NS))
    valid = table.verdict == table.VERDICTS.index("valid")
    pairs = pairs[valid[pairs] & valid[pairs + 1]]
    if len(pairs) < _FEWEST:
        return None
    sigma = robust_sigma(track.against_first[pairs + 1] - track.against_first[pairs]) / np.sqrt(2.0)
    claimed = np.median(track.sigma[pairs], axis=0)
    return Noise(_vector(sigma[:3]), _vector(sigma[3:]), _vector(claimed[:3]), _vector(claimed[3:]), len(pairs))


def _vector(values: Array) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


def _shares(names: Sequence[str], codes: NDArray[np.int8]) -> tuple[Share, ...]:
    counts = np.bincount(codes, minlength=len(names)).tolist() if len(codes) else [0] * len(names)
    total = max(len(codes), 1)
    return tuple(Share(name, n, n / total) for name, n in zip(names, counts, strict=True) if n)


def _slices(table: FrameTable, clock: Clock) -> tuple[Slice, ...]:
    if len(table) < 2 or clock.stamp_ns[-1] == clock.stamp_ns[0]:
        return ()
    number = max(min(_SLICES, len(table) // _FEWEST), 1)
    length_ns = int(clock.stamp_ns[-1] - clock.stamp_ns[0]) + 1
    # Reckoned from the first: Unix nanoseconds have more digits than a float.
    edges = clock.stamp_ns[0] + np.linspace(0, length_ns, number + 1).astype(np.int64)
    edges[-1] = clock.stamp_ns[-1] + 1
    cuts = np.searchsorted(clock.stamp_ns, edges)
    codes = [table.VERDICTS.index(name) for name in ("valid", "suspect", "unknown")]
    out = []
    for i in range(number):
        part = slice(int(cuts[i]), int(cuts[i + 1]))
        if part.stop == part.start:
            continue
        verdicts = table.verdict[part]
        latency_s = 1e-9 * table.latency_ns[part][table.latency_ns[part] > 0]
        median, p99 = np.percentile(latency_s, (50.0, 99.0)).tolist() if latency_s.size else (None, None)
        valid, suspect, unknown = (float((verdicts == code).mean()) for code in codes)
        out.append(
            Slice(int(edges[i]), int(edges[i + 1]), part.stop - part.start, valid, suspect, unknown, median, p99)
        )
    return tuple(out)


def _history(names: Sequence[str], codes: NDArray[np.int8], clock: Clock) -> tuple[Stretch, ...]:
    """What followed what.  A stretch ends where the next begins, or with a pause of frames."""
    if not len(codes):
        return ()
    pause = np.cumsum(np.concatenate([[0], np.diff(clock.stamp_ns) > SECOND_NS]))
    parts = runs_of_equal(codes.astype(np.int64) + 100 * pause)
    out = []
    for part in parts:
        follows = part.stop < len(codes) and pause[part.stop] == pause[part.start]
        end_ns = int(clock.stamp_ns[part.stop if follows else part.stop - 1])
        out.append(Stretch(names[int(codes[part.start])], int(clock.stamp_ns[part.start]), end_ns))
    if len(out) <= _MOST_STRETCHES:
        return tuple(out)
    # Of a recording that never rests the longest tell the story; the data themselves are in the recording.
    shortest = sorted((s.end_ns - s.start_ns for s in out), reverse=True)[_MOST_STRETCHES - 1]
    return tuple(s for s in out if s.end_ns - s.start_ns >= shortest)
