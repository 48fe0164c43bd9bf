"""What came over the network and was no use: counted, and said once."""

from __future__ import annotations

import logging
import threading
import time

_log = logging.getLogger(__name__)

REMEMBERED_S = 60.0
"""So long after the last one it is still said; one that comes later is a new occasion."""

CALM_S = 3.0
"""Good ones for so long, and nothing else: it is no longer said."""

_LONGEST_REASON = 200


class Malformed:
    """Counts the payloads on a key that could not be used.

    An occasion ends when none has come for :data:`REMEMBERED_S`; :meth:`fault` is silent sooner, when good ones have
    come for :data:`CALM_S`.  The log gets one line an occasion, and the words of
    :meth:`fault` change only when the count passes a power of ten, so that nobody can fill a log, or keep the network
    busy, by sending rubbish.  Any thread may call.
    """

    def __init__(self, what: str, key: str) -> None:
        """``what`` has been sent, in the singular: ``frame``."""
        self._what, self._key = what, key
        self._lock = threading.Lock()
        self._count = self._here = 0
        self._reason = ""
        self._last_s = self._good_s = 0.0

    @property
    def count(self) -> int:
        """All of them."""
        return self._count

    def add(self, reason: str) -> None:
        """One more; ``reason`` may hold what a stranger sent."""
        now_s = time.monotonic()
        with self._lock:
            begins = self._here == 0 or now_s - self._last_s > REMEMBERED_S
            if begins:
                self._here, self._reason = 0, _for_people(reason)
            self._count += 1
            self._here += 1
            self._last_s = now_s
            said = f"malformed {self._what} on {self._key}: {self._reason}"
        if begins:
            _log.warning("%s (said once)", said)

    def good(self) -> None:
        """One came that could be used."""
        self._good_s = time.monotonic()

    def fault(self) -> str:
        """How many of this occasion, roughly, and the first one's reason, for a person; empty if it is over."""
        with self._lock:
            over = time.monotonic() - self._last_s > REMEMBERED_S or self._good_s - self._last_s > CALM_S
            if self._here == 0 or over:
                return ""
            several = "s" * (self._here > 1)
            return f"{_roughly(self._here)} malformed {self._what}{several} on {self._key}: {self._reason}"


def _roughly(count: int) -> str:
    if count < 10:
        return "1" if count == 1 else "some"
    return f"over {10 ** (len(str(count)) - 1):,}"


def _for_people(reason: str) -> str:
    """One line of a bounded length that can't play tricks on a terminal."""
    line = " ".join(reason[: 2 * _LONGEST_REASON].split())
    return "".join(c if c.isprintable() else "?" for c in line[:_LONGEST_REASON])
