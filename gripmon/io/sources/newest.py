"""The newest wins: a slot for one item."""

from __future__ import annotations

import threading
from typing import Generic, TypeVar

_T = TypeVar("_T")


class Newest(Generic[_T]):
    """Room for one item: the newest takes the place of one that wasn't taken, which counts as dropped.

    One thread puts, another one takes.  ``dropped_before``: how many were dropped when one was taken last.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._item: _T | None = None
        self.dropped = self.dropped_before = 0
        self.ended = False

    def put(self, item: _T) -> None:
        """Ignored after the end."""
        with self._changed:
            if not self.ended:
                self.dropped += self._item is not None
                self._item = item
                self._changed.notify_all()

    def take(self, wait_s: float) -> _T | None:
        """The item that is there or comes in time; None without one, and after the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._item is not None or self.ended, wait_s)
            item, self._item = self._item, None
            self.dropped_before = self.dropped
            return item

    def end(self, *, discard: bool = False) -> None:
        """Nothing more is put.  ``discard``: nor taken."""
        with self._changed:
            self.ended = True
            self._item = None if discard else self._item
            self._changed.notify_all()
