"""Whether the edges' blur is another than usual: a lens that lost its focus moves nothing, so no drift shows it."""

from __future__ import annotations

import statistics
from collections import deque

LEARNT, NEWEST = 20, 5
"""Frames from which the usual blur is learnt, and newest ones that are held against it."""

CHANGED_PX, CHANGED = 0.25, 0.3
"""By how much it must differ, px, and part of the usual blur."""


class BlurWatch:
    """A few comparisons a frame.  What has changed is told by :class:`gripmon.causes.CauseJudge`: motion smears edges,
    too.
    """

    def __init__(self) -> None:
        self._first: list[float] = []
        self._newest: deque[float] = deque(maxlen=NEWEST)
        self._usual_px: float | None = None

    def add(self, blur_px: float | None) -> bool:
        """Whether the last frames' blur isn't the usual one; ``blur_px`` of one frame, None where it can't be told."""
        if blur_px is None:
            return False
        self._newest.append(blur_px)
        if self._usual_px is None:
            self._first.append(blur_px)
            if len(self._first) == LEARNT:
                self._usual_px = statistics.median(self._first)
            return False
        differs_px = abs(statistics.median(self._newest) - self._usual_px)
        return differs_px > max(CHANGED_PX, CHANGED * self._usual_px)
