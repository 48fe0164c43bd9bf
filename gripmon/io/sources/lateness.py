"""How late frames of a network are, by their stamps and arrivals, and what is wrong with a driver's clock."""

from __future__ import annotations

from gripmon.io.wire import MOST_DRIFT

MOST_LATE_S = 3.0
"""Stamps that are always further off than this are of another time or clock, and useless for the age."""

WINDOW_S = 60.0
"""Delays are compared by the fastest frame of each window: long enough to contain one without a queue before it (s)."""

SURE_FRAMES = 3
"""Frames in a row with stamps below an earlier one, or ahead of all before, from which on the driver's clock was set:
of frames that overtook each other the next one is above it, and one wrong stamp has right ones after it.
"""

_AHEAD_NS = 100_000_000
"""A frame that is faster than all before by more than this has to be confirmed by others."""

_FAR_NS = 2**63


class Lateness:
    """Compares each frame's (arrival - stamp) with the smallest one so far.

    The difference is a lower bound on the frame's delay: the fastest one may have been delayed, too.  The smallest one
    rises with the fastest frames of the windows as far as clocks may drift apart (:data:`MOST_DRIFT`), and where stamps
    show that the driver's clock was set back; a delay that lasts is never forgotten.  What rises by less can't be told
    from drift.
    """

    def __init__(self) -> None:
        self._smallest_ns = _FAR_NS
        self._window_ns = self._before_ns = _FAR_NS  # the smallest of this window and of the one before
        self._window_ends_ns: int | None = None
        self._latest_stamp_ns = -_FAR_NS
        self._late_ns = (-_FAR_NS, -_FAR_NS)  # how late the frame with the latest stamp was, and the one before it
        self._below = self._ahead = 0  # frames in a row with earlier stamps; that are faster than all before
        self._of_this_time = False

    @property
    def lasting_s(self) -> float:
        """By how much the fastest frame of the last whole window was slower than the fastest one, s; 0 if unknown."""
        if self._before_ns == _FAR_NS or not self._of_this_time:
            return 0.0
        return 1e-9 * (self._before_ns - self._smallest_ns)

    def waited_ns(self, stamp_ns: int, arrived_ns: int, unix_ns: int) -> int:
        """``arrived_ns`` by the monotonic clock, ``unix_ns`` the same by this machine's clock."""
        late_ns = arrived_ns - stamp_ns
        self._ahead = self._ahead + 1 if late_ns < self._smallest_ns - _AHEAD_NS and self._smallest_ns < _FAR_NS else 0
        if 0 < self._ahead < SURE_FRAMES:
            return 0
        self._follow_the_clock(stamp_ns, late_ns)
        if self._window_ends_ns is None or arrived_ns >= self._window_ends_ns:
            self._follow_the_drift()
            self._window_ends_ns = arrived_ns + round(1e9 * WINDOW_S)
        self._window_ns = min(self._window_ns, late_ns)
        self._smallest_ns = min(self._smallest_ns, late_ns)
        waited_ns = late_ns - self._smallest_ns
        fastest_ns = unix_ns - stamp_ns - waited_ns
        self._of_this_time = abs(fastest_ns) < 1e9 * MOST_LATE_S
        return waited_ns if self._of_this_time else 0

    def _follow_the_clock(self, stamp_ns: int, late_ns: int) -> None:
        """No link makes stamps go back, except for frames that overtake each other."""
        if stamp_ns < self._latest_stamp_ns:
            self._below += 1
            if self._below < SURE_FRAMES:
                return
            # By the slower one of both: the latest stamp may be the wrong one, and a delay is forgotten by nothing.
            self._smallest_ns += max(late_ns - max(self._late_ns), 0)
            self._window_ns = self._before_ns = _FAR_NS
            self._late_ns = (late_ns, late_ns)
        self._latest_stamp_ns, self._late_ns, self._below = stamp_ns, (late_ns, self._late_ns[0]), 0

    def _follow_the_drift(self) -> None:
        """At a window's end."""
        window_ns, self._window_ns = self._window_ns, _FAR_NS
        if self._before_ns < _FAR_NS and abs(window_ns - self._before_ns) <= 1e9 * MOST_DRIFT * WINDOW_S:
            self._smallest_ns += window_ns - self._before_ns  # both ways: what comes and goes leaves nothing behind
        self._before_ns = window_ns


def clock_fault(key: str, stamp_ns: int, unix_ns: int) -> str:
    """By how much a driver's stamp is off, in coarse words that rarely change; empty if it may be right.

    Controllers compute a transform's age from it.
    """
    late_s = 1e-9 * (unix_ns - stamp_ns)
    for limit_s, words in (
        (86_400.0, "a day"),
        (3_600.0, "an hour"),
        (60.0, "a minute"),
        (MOST_LATE_S, "some seconds"),
    ):
        if abs(late_s) >= limit_s:
            return (
                f"stamps on {key} are {words} or more {'behind' if late_s > 0.0 else 'ahead of'} this machine's clock"
            )
    return ""


def lasting_fault(key: str, lasting_s: float) -> str:
    """What is said of a delay that lasts, in coarse words that rarely change; empty if there is none."""
    for limit_s, words in ((MOST_LATE_S, "some seconds"), (1.0, "a second"), (0.1, "a tenth of a second")):
        if lasting_s >= limit_s:
            why = "a slow link, or the driver's clock was set back (restart the monitor after that)"
            return f"frames on {key} come {words} or more later than they did: {why}"
    return ""
