"""What came over the network and was no use: counted, and said once."""

from __future__ import annotations

import logging
import re
import threading
import time
from collections import Counter

_log = logging.getLogger(__name__)

REMEMBERED_S = 60.0
"""So long after the last one it is still said; one that comes later is a new occasion."""

CALM_S = 3.0
"""Good ones for so long, and nothing else: it is no longer said."""

_LONGEST_REASON = 200
_MOST_KINDS = 8  # of reasons; a stranger may make up any number
_OTHERS = "any other"
_FIGURES = re.compile(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?")


class Malformed:
    """Counts the payloads on a key that could not be used.

    An occasion ends when none has come for :data:`REMEMBERED_S`; :meth:`fault` is silent sooner, when good ones have
    come for :data:`CALM_S`, and what comes after such a calm is counted anew.  The log gets one line an occasion for
    each of the first few kinds of reasons, and the words of :meth:`fault`, with the most frequent reason, change only
    when the count passes a power of ten, so that nobody can fill a log, or keep the network busy, by sending rubbish.
    Any thread may call.
    """

    def __init__(self, what: str, key: str) -> None:
        """``what`` has been sent, in the singular: ``frame``."""
        self._what, self._key = what, key
        self._lock = threading.Lock()
        self._count = self._here = 0
        self._reason = ""
        self._kinds: Counter[str] = Counter()  # since the last calm: of reasons without their figures
        self._examples: dict[str, str] = {}
        self._logged: set[str] = set()  # kinds, of this occasion
        self._last_s = self._good_s = 0.0

    @property
    def count(self) -> int:
        """All of them."""
        return self._count

    def add(self, reason: str) -> None:
        """One more; ``reason`` may hold what a stranger sent."""
        now_s = time.monotonic()
        with self._lock:
            if now_s - self._last_s > REMEMBERED_S:
                self._logged.clear()
                self._examples.clear()
            if self._is_over(now_s):
                self._here, self._kinds = 0, Counter()
            kind = self._kind(reason)
            before = _roughly(self._here)
            self._count += 1
            self._here += 1
            self._kinds[kind] += 1
            self._last_s = now_s
            if _roughly(self._here) != before:
                self._reason = self._examples[self._kinds.most_common(1)[0][0]]
            is_new = kind not in self._logged
            self._logged.add(kind)
            said = f"malformed {self._what} on {self._key}: {_for_people(reason)}"
        if is_new:
            _log.warning("%s (said once)", said)

    def _kind(self, reason: str) -> str:
        """What is counted together: the reason without figures; the rest, where there are too many."""
        text = _for_people(reason)
        kind = _FIGURES.sub("", text)
        if kind not in self._examples and len(self._examples) >= _MOST_KINDS:
            kind = _OTHERS
        self._examples.setdefault(kind, text)
        return kind

    def _is_over(self, now_s: float) -> bool:
        return now_s - self._last_s > REMEMBERED_S or self._good_s - self._last_s > CALM_S

    def good(self) -> None:
        """One came that could be used."""
        self._good_s = time.monotonic()

    def fault(self) -> str:
        """How many since the last calm, roughly, and the most frequent reason, for a person; empty if it is over."""
        with self._lock:
            if self._here == 0 or self._is_over(time.monotonic()):
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
