"""A recording's time, which must not run backwards."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.analyse.report.formats import clock_time

SECOND_NS = 1_000_000_000
_LONGEST_NS = 7 * 86400 * SECOND_NS  # a pause within one run


@dataclass(frozen=True, slots=True)
class Clock:
    """Frames' numbers ``seq`` (n,), ascending, and the times ``stamp_ns`` (n,) that the report gives them."""

    seq: NDArray[np.int64]
    stamp_ns: NDArray[np.int64]

    def of(self, seq: int, stamp_ns: int) -> int:
        """When something was that belongs to a frame, or else to no frame: then as it says itself, brought among the
        frames if it lies far outside.
        """
        i = int(np.searchsorted(self.seq, seq))
        if i < len(self.seq) and self.seq[i] == seq:
            own = int(self.stamp_ns[i])
            return own if abs(stamp_ns - own) > 3600 * SECOND_NS or stamp_ns < own else stamp_ns
        if not len(self.seq):
            return stamp_ns
        first, last = int(self.stamp_ns[0]), int(self.stamp_ns[-1])
        near = first - 3600 * SECOND_NS <= stamp_ns <= last + 3600 * SECOND_NS
        return stamp_ns if near else int(np.clip(stamp_ns, first, last))


def straightened(seq: NDArray[np.int64], stamp_ns: NDArray[np.int64]) -> tuple[Clock, tuple[str, ...]]:
    """Where the clock was set back, or ahead by more than a week, time goes on as before by one frame's length; what
    was done, in words.
    """
    steps_ns = np.diff(stamp_ns.astype(np.float64))  # as integers those of absurd stamps would overflow
    wrong = np.flatnonzero((steps_ns < 0.0) | (steps_ns > _LONGEST_NS))
    absurd = bool(len(stamp_ns)) and not 0 <= int(stamp_ns[0]) < 2**62
    if not wrong.size and not absurd:
        return Clock(seq, stamp_ns), ()
    sound = steps_ns[(steps_ns > 0.0) & (steps_ns <= _LONGEST_NS)]
    steps = np.diff(stamp_ns)
    steps[wrong] = int(np.median(sound)) if sound.size else SECOND_NS // 30
    out = (0 if absurd else int(stamp_ns[0])) + np.concatenate([np.zeros(1, np.int64), np.cumsum(steps)])
    faults = ["the first frame's time is absurd; times are shown from 1970 on"] if absurd else []
    if wrong.size:
        faults.append(_told(seq, stamp_ns, wrong.tolist(), 1e-9 * (float(out[-1]) - float(stamp_ns[-1]))))
    return Clock(seq, out), tuple(faults)


def _told(seq: NDArray[np.int64], stamp_ns: NDArray[np.int64], wrong: Sequence[int], off_s: float) -> str:
    i = wrong[0]
    by_s = 1e-9 * (float(stamp_ns[i + 1]) - float(stamp_ns[i]))
    how = f"runs backwards by {-by_s:.3f} s" if by_s < 0.0 else f"jumps ahead by {by_s:.0f} s"
    more = f" and {len(wrong) - 1} more times" if len(wrong) > 1 else ""
    late = f"{abs(off_s):.3f} s {'later' if off_s > 0.0 else 'earlier'} than stamped"
    return (
        f"time {how} at frame {int(seq[i + 1])} (after {clock_time(int(stamp_ns[i]))}){more}: from there on times are "
        f"shown as if the clock had gone on, at the end {late}"
    )
