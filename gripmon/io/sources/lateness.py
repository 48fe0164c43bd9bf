"""How long a driver's frames wait on their way to the monitor, as far as their stamps tell."""

from __future__ import annotations

MOST_LATE_S = 3.0
"""Stamps further off than this, at best, are of another time or clock: what they say of now is no use."""

WINDOW_S = 60.0
"""The fastest frame of the last one to two windows is what others are held against.  Long enough to have one that did
not wait; a driver's clock that was set is lived with after two of them."""

_FAR_NS = 2**63


class Lateness:
    """Holds each frame's (arrival - stamp) against the smallest of late.

    What it is over that, the frame has waited for certain.  It may be more: the fastest one may have waited, too.
    """

    def __init__(self) -> None:
        self._smallest_ns = self._before_ns = _FAR_NS  # of this window and of the one before
        self._window_ends_ns: int | None = None

    def waited_ns(self, stamp_ns: int, arrived_ns: int, unix_ns: int) -> int:
        """``arrived_ns`` by the monotonic clock, ``unix_ns`` the same by this machine's clock."""
        late_ns = arrived_ns - stamp_ns
        if self._window_ends_ns is None or arrived_ns >= self._window_ends_ns:
            self._before_ns, self._smallest_ns = self._smallest_ns, _FAR_NS
            self._window_ends_ns = arrived_ns + round(1e9 * WINDOW_S)
        self._smallest_ns = min(self._smallest_ns, late_ns)
        waited_ns = late_ns - min(self._smallest_ns, self._before_ns)
        fastest_ns = unix_ns - stamp_ns - waited_ns
        return waited_ns if abs(fastest_ns) < 1e9 * MOST_LATE_S else 0
