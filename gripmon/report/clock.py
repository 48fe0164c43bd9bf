"""A recording's time, which must not run backwards."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.report.formats import clock_time

SECOND_NS = 1_000_000_000


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
    """Where the clock was set back, time goes on as before by one frame's length; what was done, in words."""
    steps = np.diff(stamp_ns)
    back = np.flatnonzero(steps < 0)
    if not back.size:
        return Clock(seq, stamp_ns), ()
    forward = steps[steps > 0]
    usual = int(np.median(forward)) if forward.size else SECOND_NS // 30
    offset = np.zeros(len(seq), np.int64)
    offset[back + 1] = usual - steps[back]
    out = stamp_ns + np.cumsum(offset)
    return Clock(seq, out), (_told(seq, stamp_ns, back.tolist(), int(offset.sum())),)


def _told(seq: NDArray[np.int64], stamp_ns: NDArray[np.int64], back: Sequence[int], total_ns: int) -> str:
    i = int(back[0])
    by_s = 1e-9 * float(stamp_ns[i] - stamp_ns[i + 1])
    more = f" and {len(back) - 1} more times" if len(back) > 1 else ""
    return (
        f"time runs backwards by {by_s:.3f} s at frame {int(seq[i + 1])} (after {clock_time(int(stamp_ns[i]))}){more}: "
        f"from there on times are shown as if the clock had gone on, at the end {1e-9 * total_ns:.3f} s later than "
        "stamped"
    )
