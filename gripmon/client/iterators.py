"""Readings one after another, for a thread or for asyncio."""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections import deque
from typing import Protocol, Self

from gripmon.client.inbox import Entry
from gripmon.client.reading import Policy, Reading
from gripmon.model.records import Verdict

_LATE_S = 1e-3  # to be past the end of a time and not just before it

FIRST_WITHIN_S = 2.0
"""A monitor that is there has sent a transform by then; else it is said that none comes, and who is there instead."""

_LOOK_AROUND_S = 0.5  # of these, for the answers to who is there


class Judge(Protocol):
    """What the iterators need of the client."""

    @property
    def policy(self) -> Policy: ...
    @property
    def closed(self) -> bool: ...
    def latest(self) -> Reading: ...
    def look_around(self) -> None: ...
    def judge(self, entry: Entry) -> Reading: ...


class _Queue:
    """What one reader has not had yet: the newest ``depth`` messages, older ones are dropped.

    Besides, once, a reading of verdict ``unknown`` when the last one given holds no longer: the monitor vanished, or
    nothing newer came in time; and, once, one that says why when no first message comes.  So whoever only waits for the
    next reading stops in time, too.
    """

    def __init__(self, judge: Judge, depth: int) -> None:
        self._judge = judge
        self._entries: deque[Entry] = deque(maxlen=depth)
        self._given = judge.latest()
        waits = self._given.verdict is Verdict.UNKNOWN
        self._look_s = time.monotonic() + FIRST_WITHIN_S - _LOOK_AROUND_S if waits else None
        self._say_s: float | None = None

    def _take(self) -> Reading | None:
        """The next reading if there is one."""
        if self._entries:
            self._look_s = self._say_s = None
            self._given = self._judge.judge(self._entries.popleft())
            return self._given
        if self._given.verdict is not Verdict.UNKNOWN and (now := self._judge.latest()).verdict is Verdict.UNKNOWN:
            self._given = now
            return now
        return self._nobody(time.monotonic())

    def _nobody(self, now_s: float) -> Reading | None:
        """What there is in place of a first message, when it is time to say so."""
        if self._look_s is not None and now_s >= self._look_s:
            self._look_s, self._say_s = None, now_s + _LOOK_AROUND_S
            self._judge.look_around()
        elif self._say_s is not None and now_s >= self._say_s:
            self._say_s = None
            self._given = self._judge.latest()
            return self._given
        return None

    def _patience_s(self) -> float | None:
        """When to look again though nothing came; None: not at all."""
        next_s = self._look_s if self._look_s is not None else self._say_s
        if next_s is not None:
            return max(0.0, next_s - time.monotonic()) + _LATE_S
        if self._given.verdict is Verdict.UNKNOWN:
            return None
        return max(0.0, self._judge.policy.max_age_s - self._judge.latest().age_s) + _LATE_S


class Readings(_Queue):
    """Iterator for one thread; ends when the client is closed."""

    def __init__(self, judge: Judge, depth: int) -> None:
        super().__init__(judge, depth)
        self._news = threading.Event()

    def put(self, entry: Entry) -> None:
        self._entries.append(entry)
        self._news.set()

    def wake(self) -> None:
        self._news.set()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Reading:
        while not self._judge.closed:
            self._news.clear()  # before looking: what comes after that is not slept over
            if (reading := self._take()) is not None:
                return reading
            if not self._judge.closed:
                self._news.wait(self._patience_s())
        raise StopIteration


class AsyncReadings(_Queue):
    """Asynchronous iterator for one task of asyncio; ends when the client is closed.

    A cancelled wait loses nothing: the next ``anext`` goes on.
    """

    def __init__(self, judge: Judge, depth: int) -> None:
        super().__init__(judge, depth)
        self._loop = asyncio.get_running_loop()
        self._news = asyncio.Event()

    def put(self, entry: Entry) -> None:
        self._entries.append(entry)
        self.wake()

    def wake(self) -> None:
        with contextlib.suppress(RuntimeError):  # its loop has ended, and nobody waits any more
            self._loop.call_soon_threadsafe(self._news.set)

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Reading:
        while not self._judge.closed:
            self._news.clear()
            if (reading := self._take()) is not None:
                return reading
            if not self._judge.closed:
                with contextlib.suppress(TimeoutError):  # then it is time to look again
                    async with asyncio.timeout(self._patience_s()):
                        await self._news.wait()
        raise StopAsyncIteration
