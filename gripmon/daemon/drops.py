"""Frames that were dropped because the monitor was still busy: when they are so many that somebody should know."""

from __future__ import annotations

from collections import deque

OVER_S = 10.0
"""So long it is counted: a slow second, as a start has some, is none of anybody's business."""

_LOOK_EVERY_S = 1.0


class Drops:
    """Counts over the last seconds; all times are monotonic seconds."""

    def __init__(self, allowed_share: float) -> None:
        """``allowed_share`` of the camera's frames may be dropped; from there on it is said, until they are half."""
        self._allowed = allowed_share
        self._counts: deque[tuple[float, int, int]] = deque()  # time, frames handled, frames dropped
        self._said = ""

    def look(self, handled: int, dropped: int, now_s: float) -> str:
        """What is wrong and what to change, of the counts since the start; empty if all is well."""
        counts = self._counts
        if counts and now_s - counts[-1][0] < _LOOK_EVERY_S:
            return self._said
        counts.append((now_s, handled, dropped))
        while len(counts) > 1 and now_s - counts[1][0] >= OVER_S:
            counts.popleft()
        since_s, handled_before, dropped_before = counts[0]
        elapsed_s = now_s - since_s
        few, lost = handled - handled_before, dropped - dropped_before
        if elapsed_s >= OVER_S:
            share = lost / max(1, few + lost)
            allowed = self._allowed / 2.0 if self._said else self._allowed
            self._said = _in_words(few / elapsed_s, (few + lost) / elapsed_s, share) if share > allowed else ""
        return self._said


def _in_words(handled_per_s: float, came_per_s: float, share: float) -> str:
    remedy = "lower the camera's rate (source.fps, or its driver's) to that, give smaller images, or free the processor"
    return (
        f"{100.0 * share:.0f} % of the frames were dropped in {OVER_S:g} s: {came_per_s:.3g} a second came, the "
        f"monitor had time for {handled_per_s:.3g}; {remedy} of other work"
    )
