"""Work that takes longer than a frame, done in the background: cause analysis, and the search for a lost gripper.

A replay decides as the daemon did: a result counts from a fixed moment of the frames' own clock on, in whichever thread
it was computed, or from the frame on that its taker has recorded.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

RESULT_AFTER_S = 0.1
"""From the frame that starts a task to the one in which its result counts: a search and an analysis take 20 to 50 ms
(tools/bench latency); a controller notices tenths of a second.
"""

MOST_WAITING = 32
"""Tasks of a live camera whose results aren't there yet, a frame's image each, some 15 MB: beyond that frames wait."""

_T = TypeVar("_T")


@dataclass(slots=True, eq=False)
class _Task(Generic[_T]):
    work: Callable[[], _T]
    due_s: float
    result: _T | Exception | None = None
    done: bool = False


class Backlog(Generic[_T]):
    """Tasks in order.  :meth:`run` may be called from another thread than the rest."""

    def __init__(self) -> None:
        self._tasks: deque[_Task[_T]] = deque()  # whose results haven't been taken
        self._undone: deque[_Task[_T]] = deque()
        self._one_at_a_time = threading.Lock()

    def __len__(self) -> int:
        """Tasks whose results haven't been taken."""
        return len(self._tasks)

    @property
    def undone(self) -> bool:
        """Whether there is something to :meth:`run`."""
        return len(self._undone) > 0

    def add(self, work: Callable[[], _T], now_s: float = -math.inf, after_s: float = RESULT_AFTER_S) -> None:
        """Add a task that starts in the frame of ``now_s``; its result counts ``after_s`` later, or without a time as
        soon as the earlier ones do.  Earlier tasks count no later than this one.
        """
        task = _Task(work, now_s + after_s)
        for earlier in self._tasks if task.due_s > -math.inf else ():
            earlier.due_s = min(earlier.due_s, task.due_s)
        self._tasks.append(task)
        self._undone.append(task)

    def results(self, now_s: float, *, waits: bool = True) -> Iterator[_T | Exception]:
        """The results that are due, in the order of their tasks, computed now if need be, unless nobody ``waits``: then
        those that are there, and more only so that no more than :data:`MOST_WAITING` are left; of a failed task its
        exception.
        """
        while self._tasks and self._tasks[0].due_s <= now_s:
            if not (waits or self._tasks[0].done or len(self._tasks) > MOST_WAITING):
                break
            yield self.next()

    def next(self) -> _T | Exception:
        """The next result, due or not, as of :meth:`results`."""
        task = self._tasks.popleft()
        while not task.done:
            self._do_next(task)
        assert task.result is not None
        return task.result

    def run(self) -> None:
        """Run all waiting tasks, one after the other."""
        while self._undone:
            self._do_next()

    def _do_next(self, wanted: _Task[_T] | None = None) -> None:
        """Run the next task, unless ``wanted`` was done meanwhile: a frame doesn't wait for tasks that aren't due."""
        with self._one_at_a_time:
            if not self._undone or (wanted is not None and wanted.done):
                return
            task = self._undone.popleft()
            try:
                task.result = task.work()
            except Exception as error:  # noqa: BLE001  raised or reported by whoever takes it
                task.result = error
            task.done = True
