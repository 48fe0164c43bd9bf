"""How the monitor ran: rates, latency, noise, fractions of verdicts and states."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gripmon.analyse.affected import runs_of_equal
from gripmon.analyse.content import Noise, Running, Share, Slice, Stretch
from gripmon.analyse.motions import robust_sigma
from gripmon.analyse.track import SECOND_NS, Track
from gripmon.model.geometry import to_vector
from gripmon.model.records import Array, StateRecord
from gripmon.record.recordings import Recording
from gripmon.record.table import FrameTable

_MIN_FRAMES = 30  # of an estimate of noise, or of a slice
_MAX_SLICES = 120
_MAX_STRETCHES = 2000  # of a history
_NEIGHBOURS_NS = SECOND_NS // 2


def dropped_of(source: Recording) -> tuple[str, ...]:
    """The faults about frames that the monitor or its recorder dropped for lack of time, if the files are undamaged."""
    missing = _missing(source.frames)
    by_choice = sum(_most(source.states, name) or 0 for name in ("frames_dropped", "recording_dropped"))
    whole = set(source.faults) <= set(source.gaps)
    return tuple(source.gaps) if whole or missing <= by_choice else ()


def _missing(table: FrameTable) -> int:
    return int(table.seq[-1] - table.seq[0]) + 1 - len(table) if len(table) else 0


def _most(states: Sequence[StateRecord], name: str) -> int | None:
    return max((getattr(state, name) for state in states), default=None)


def running_of(table: FrameTable, track: Track, states: Sequence[StateRecord], dropped: tuple[str, ...]) -> Running:
    """How the monitor ran; ``states`` contain how many frames were dropped, ``dropped`` where."""
    steps_s = 1e-9 * np.diff(track.stamp_ns)
    pauses_s = steps_s[steps_s > 1.0]
    median_s, p99_s = _latency_s(table.latency_ns)
    return Running(
        frames=len(table),
        frames_dropped=_missing(table),
        dropped=dropped,
        frames_refused=int(table.refused.sum()),
        monitor_dropped=_most(states, "frames_dropped"),
        recording_dropped=_most(states, "recording_dropped"),
        frames_per_s=float(1.0 / np.median(steps_s)) if steps_s.size and np.median(steps_s) > 0.0 else None,
        gaps=len(pauses_s),
        longest_gap_s=float(pauses_s.max(initial=0.0)),
        latency_median_s=median_s,
        latency_p99_s=p99_s,
        noise=_noise(table, track),
        verdicts=_shares(table.VERDICTS, table.verdict),
        states=_shares(table.STATES, table.state),
        state_history=_history(table.STATES, table.state, track),
        verdict_history=_history(table.VERDICTS, table.verdict, track),
        slices=_slices(table, track.stamp_ns),
    )


def _latency_s(latency_ns: NDArray[np.int64]) -> tuple[float | None, float | None]:
    """Median and 99 %; None without frames."""
    known = latency_ns[latency_ns > 0]
    if not known.size:
        return None, None
    median, p99 = np.percentile(1e-9 * known, (50.0, 99.0)).tolist()
    return median, p99


def _noise(table: FrameTable, track: Track) -> Noise | None:
    """Noise between successive frames; a motion affects few of the differences, which the median ignores."""
    good = track.measured & (table.verdict == table.VERDICTS.index("valid"))
    pairs = np.flatnonzero(good[1:] & good[:-1] & (np.diff(track.stamp_ns) < _NEIGHBOURS_NS))
    if len(pairs) < _MIN_FRAMES:
        return None
    sigma: Array = robust_sigma(track.against_first[pairs + 1] - track.against_first[pairs]) / np.sqrt(2.0)
    claimed = np.median(track.sigma[pairs], axis=0)
    return Noise(to_vector(sigma[:3]), to_vector(sigma[3:]), to_vector(claimed[:3]), to_vector(claimed[3:]), len(pairs))


def _shares(names: Sequence[str], codes: NDArray[np.int8]) -> tuple[Share, ...]:
    counts = np.bincount(codes, minlength=len(names)).tolist()
    return tuple(Share(name, n, n / len(codes)) for name, n in zip(names, counts, strict=True) if n)


def _slices(table: FrameTable, stamp_ns: NDArray[np.int64]) -> tuple[Slice, ...]:
    if len(table) < 2 or stamp_ns[-1] == stamp_ns[0]:
        return ()
    number = max(min(_MAX_SLICES, len(table) // _MIN_FRAMES), 1)
    length_ns = int(stamp_ns[-1] - stamp_ns[0]) + 1
    # Relative to the first, since a float can't represent Unix nanoseconds exactly.
    edges = stamp_ns[0] + np.linspace(0, length_ns, number + 1).astype(np.int64)
    edges[-1] = stamp_ns[-1] + 1
    cuts = np.searchsorted(stamp_ns, edges)
    out = []
    for i in np.flatnonzero(np.diff(cuts)).tolist():
        part = slice(cuts[i], cuts[i + 1])
        verdicts = table.verdict[part]
        valid, suspect, unknown = (
            float((verdicts == table.VERDICTS.index(name)).mean()) for name in ("valid", "suspect", "unknown")
        )
        (begin_ns, end_ns), latency_s = edges[i : i + 2].tolist(), _latency_s(table.latency_ns[part])
        out.append(Slice(begin_ns, end_ns, len(verdicts), valid, suspect, unknown, *latency_s))
    return tuple(out)


def _history(names: Sequence[str], codes: NDArray[np.int8], track: Track) -> tuple[Stretch, ...]:
    """Successive stretches of equal names, the longest if there are many; a stretch ends where the next begins, or at a
    pause of frames.
    """
    pause = np.cumsum(np.diff(track.stamp_ns, prepend=track.stamp_ns[:1]) > SECOND_NS)
    out = []
    for part in runs_of_equal(codes.astype(np.int64) + 100 * pause):
        follows = part.stop < len(codes) and pause[part.stop] == pause[part.start]
        end_ns = int(track.stamp_ns[part.stop if follows else part.stop - 1])
        out.append(Stretch(names[int(codes[part.start])], int(track.stamp_ns[part.start]), end_ns))
    longest = sorted(range(len(out)), key=lambda i: out[i].start_ns - out[i].end_ns)[:_MAX_STRETCHES]
    return tuple(out[i] for i in sorted(longest))
