"""Work that takes the time of many frames, beside them: what moved, and where a lost gripper is.

No frame waits for it, and yet a replay decides as the daemon did: the result of what begins with one frame counts from
a fixed moment of the frames' own clock on, whoever has done the work until then.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

RESULT_AFTER_S = 0.1
"""From the frame that work begins with to the one that its result counts in: a search and an analysis take 20 to 50 ms
(tools/bench latency); a controller notices tenths of a second.
"""

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
        """Begin something in the frame of ``now_s``, to count ``after_s`` later; without a time its result counts as
        soon as those before do.  What came before counts no later than it.
        """
        task = _Task(work, now_s + after_s)
        for earlier in self._tasks if task.due_s > -math.inf else ():
            earlier.due_s = min(earlier.due_s, task.due_s)
        self._tasks.append(task)
        self._undone.append(task)

    def results(self, now_s: float) -> Iterator[_T | Exception]:
        """What is due, in the order in which it was begun; done now where that hasn't been.  What has failed is its
        exception.
        """
        while self._tasks and self._tasks[0].due_s <= now_s:
            task = self._tasks.popleft()
            while not task.done:
                self._do_next(task)
            assert task.result is not None
            yield task.result

    def run(self) -> None:
        """Do what is waiting, one task after the other."""
        while self._undone:
            self._do_next()

    def _do_next(self, wanted: _Task[_T] | None = None) -> None:
        """The next task; nothing if what is ``wanted`` was done meanwhile: a frame doesn't pay for what isn't due."""
        with self._one_at_a_time:
            if not self._undone or (wanted is not None and wanted.done):
                return
            task = self._undone.popleft()
            try:
                task.result = task.work()
            except Exception as error:  # noqa: BLE001  raised or reported by whoever takes it
                task.result = error
            task.done = True
