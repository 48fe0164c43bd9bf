"""A clock for differences of times between two machines: nobody sets it, and nothing makes it faster or slower."""

from __future__ import annotations

import time

MOST_DRIFT = 1e-3
"""Two such clocks differ by at most this share of the time that passes: 500 ppm each.  An oscillator that is further
off is beyond what NTP can correct (``MAXFREQ`` of Linux), so that machine could not keep any time.  Quartz has some 50.
"""

CLOCK_PARAMETER = "clock"
"""A query for ``…/transform?clock`` asks what such a clock of the monitor shows."""

_CLOCK = getattr(time, "CLOCK_MONOTONIC_RAW", time.CLOCK_MONOTONIC)  # NTP and PTP let the other one gain or lose


def steady_ns() -> int:
    """Nanoseconds since some moment, the same one for all processes of a machine until it is started again."""
    return time.clock_gettime_ns(_CLOCK)
