"""Frames that waited on the way, told by their pace."""

from __future__ import annotations

import math
import statistics
from collections import deque

GAP_S = 0.1
_USUAL, _FEWEST, _NEWEST = 30, 5, 3


class Backlog:
    """Tells frames that waited in a queue (of the network, the driver, a suspended machine) from those that have just
    been taken: OpenCV gives them no time of capture, and all are read as soon as the silence ends.

    After a silence of three usual periods and :data:`GAP_S`, a frame counts as queued until as many have come as fit
    into the time since, or until the newest three came at the usual rate: then the others were lost, or never taken.
    Where reading a frame takes three quarters of the period or more, the two can't be told apart.
    """

    def __init__(self) -> None:
        self._periods_s: deque[float] = deque(maxlen=_USUAL)
        self._newest_s: deque[float] = deque(maxlen=_NEWEST)
        self._last_s: float | None = None
        self._began_s: float | None = None
        self._count = 0

    def queued(self, now_s: float) -> bool:
        """Whether the frame read at ``now_s`` was taken long before."""
        last_s, self._last_s = self._last_s, now_s
        if last_s is None:
            return False
        period_s = now_s - last_s
        usual_s = statistics.fmean(self._periods_s) if len(self._periods_s) >= _FEWEST else math.inf
        if self._began_s is None:
            if period_s <= max(3.0 * usual_s, GAP_S):
                self._periods_s.append(period_s)
                return False
            self._began_s, self._count = last_s, 0
            self._newest_s.clear()
        else:
            self._newest_s.append(period_s)
        self._count += 1
        at_rate = len(self._newest_s) == _NEWEST and sum(self._newest_s) > 0.75 * _NEWEST * usual_s
        if at_rate or now_s - self._began_s < (self._count + 1) * usual_s:
            self._began_s = None
            self._periods_s.extend(self._newest_s if at_rate else ())
            return False
        return True
