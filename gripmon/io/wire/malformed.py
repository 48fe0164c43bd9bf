"""Malformed messages: counted, and reported in few words, whatever anyone on the network sends."""

from __future__ import annotations

import logging
import re
import threading
import time
from collections import Counter

_log = logging.getLogger(__name__)

REMEMBERED_S = 60.0
"""Time after the last malformed payload during which it is reported; a later one is a new occasion (s)."""

CALM_S = 3.0
"""Time with only good payloads after which malformed ones are no longer reported (s)."""

_LONGEST_REASON = 200
_MOST_KINDS = 8  # of reasons; a sender may cause any number
_OTHERS = "any other"
FIGURES = re.compile(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?")


class Malformed:
    """Counts the payloads on a key that could not be used; ``count``: so far.

    An occasion ends when none has come for :data:`REMEMBERED_S`; :meth:`fault` is empty sooner, when only good ones
    have come for :data:`CALM_S`, and its number then starts again.  The log gets one line per occasion for each of the
    first few kinds of reasons, and the text of :meth:`fault`, with the most frequent reason, changes only when the
    number passes a power of ten, so that malformed payloads can't fill a log or load the network.  Thread-safe.
    """

    def __init__(self, what: str, key: str) -> None:
        """``what``: name of the payload, in the singular: ``frame``."""
        self._what, self._key = what, key
        self._lock = threading.Lock()
        self.count = 0
        self._kinds: Counter[str] = Counter()  # how many since the last calm, by the reason without figures
        self._examples: dict[str, str] = {}  # of each kind on this occasion, logged when it came
        self._reason = ""
        self._last_s = self._good_s = 0.0

    def add(self, reason: str) -> None:
        """Count a malformed payload; ``reason`` may contain data from the sender."""
        now_s, text = time.monotonic(), _for_people(reason)
        with self._lock:
            if self._is_over(now_s):
                self._kinds.clear()
            if now_s - self._last_s > REMEMBERED_S:
                self._examples.clear()
            kind = FIGURES.sub("", text)
            if kind not in self._examples and len(self._examples) >= _MOST_KINDS:
                kind = _OTHERS
            is_new = kind not in self._examples
            self._examples.setdefault(kind, text)
            before = _roughly(self._kinds.total())
            self.count += 1
            self._kinds[kind] += 1
            self._last_s = now_s
            if _roughly(self._kinds.total()) != before:
                self._reason = self._examples[self._kinds.most_common(1)[0][0]]
        if is_new:
            _log.warning("malformed %s on %s: %s (logged once)", self._what, self._key, text)

    def good(self) -> None:
        """Note a good payload."""
        self._good_s = time.monotonic()

    def fault(self) -> str:
        """The rough number since the last calm, and the most frequent reason, for people; empty if it is over."""
        with self._lock:
            number = self._kinds.total()
            if number == 0 or self._is_over(time.monotonic()):
                return ""
            several = "s" * (number > 1)
            return f"{_roughly(number)} malformed {self._what}{several} on {self._key}: {self._reason}"

    def _is_over(self, now_s: float) -> bool:
        return now_s - self._last_s > REMEMBERED_S or self._good_s - self._last_s > CALM_S


def _roughly(count: int) -> str:
    if count < 10:
        return "1" if count == 1 else "some"
    return f"over {10 ** (len(str(count)) - 1):,}"


def _for_people(reason: str) -> str:
    """One line of bounded length, without control characters for a terminal."""
    line = " ".join(reason[: 2 * _LONGEST_REASON].split())
    return "".join(c if c.isprintable() else "?" for c in line[:_LONGEST_REASON])
