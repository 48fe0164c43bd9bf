"""The transforms of one monitor for programs that move by them: the newest at once, or each as it comes."""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Self

import zenoh

from gripmon.client.inbox import Entry, Inbox, Sent
from gripmon.client.network import Listener, monitor_name, named_as_arguments, reader_settings, start_of
from gripmon.client.reading import NotUsable, Policy, Reading, judge
from gripmon.io.wire import CLOCK_PARAMETER, DEFAULT_ENDPOINT, Keys, Link, in_zenohs_thread, steady_ns
from gripmon.model.records import ClockReading, MessageRefused, Verdict, from_json

ASK_EVERY_S = 1.0
"""The bound on a message's age grows by 1 ms meanwhile (:data:`gripmon.io.wire.MOST_DRIFT`); 200 bytes each way."""
_ASK_AGAIN_S = 0.1  # while nothing is known: a query may be lost
_ANSWER_WITHIN_S = 10.0  # a late reply is still valid, but gives a weaker bound
FIRST_WITHIN_S = 2.0
"""A running monitor has sent a transform by then; otherwise a reading says that none comes, and which monitors exist.
"""
_LOOK_AROUND_S = 0.5  # of that time, for replies about which monitors exist
_LOOK_WITHIN_S = 1.0  # running monitors answer in milliseconds
_LATE_S = 1e-3  # to wake just after a deadline and not just before it


class TransformClient(Listener):
    """Receives the transforms of one monitor.  Thread-safe.

    It may start before the monitor and the router, and reconnects by itself when they restart.  It leaves the network
    at the end of a ``with`` statement or by :meth:`close`.
    """

    def __init__(
        self,
        robot: str,
        camera: str | None = None,
        *,
        connect: str | Sequence[str] = (DEFAULT_ENDPOINT,),
        zenoh_config_file: str | None = None,
        policy: Policy | None = None,
        depth: int = 1,
    ) -> None:
        """``camera`` may be omitted while the robot has only one; with two, no reading is usable, and the reason says
        so.

        ``connect``: endpoints of the monitor or a router; ``zenoh_config_file``: a Zenoh configuration file instead.
        ``depth``: how many readings are queued for an iterator or callback that is slower than the camera; with 1 it
        always gets the newest.  Raises ValueError for a name that can't be part of a key or a ``depth`` below 1, and
        :class:`gripmon.io.wire.PublishError` for a bad configuration; a monitor that doesn't answer is not an error.
        """
        if depth < 1:
            raise ValueError(f"depth is {depth}; give 1 or more")
        super().__init__()
        self.policy = policy if policy is not None else Policy()
        self.keys = Keys(robot, camera if camera is not None else "*")
        self._depth = depth
        self._inbox = Inbox()
        self._session: zenoh.Session | None = None
        self._next_question_s = 0.0
        self._declared: tuple[object, ...] = ()  # Zenoh undeclares what is no longer referenced
        with named_as_arguments():
            self._link = Link(reader_settings(connect, zenoh_config_file))
        self._link.attach(self._declare)

    def latest(self, policy: Policy | None = None) -> Reading:
        """The newest transform and whether it may be used now, by the client's policy or the given one.

        Returns immediately: it takes no lock, makes no system call and raises nothing.  (Before the first transform it
        also looks at the session, to name the endpoint to which there is no connection.)
        """
        heard = self._inbox.heard
        return judge(heard, heard.entry, policy or self.policy, time.monotonic(), time.time_ns(), self._fault)

    def require(self, policy: Policy | None = None) -> Reading:
        """As :meth:`latest`, but raises :class:`NotUsable` unless the policy allows the transform."""
        reading = self.latest(policy)
        if not reading.usable:
            raise NotUsable(reading)
        return reading

    def __iter__(self) -> Readings:
        """Each reading as it comes, and an unusable one as soon as the last one expires; ends when the client is
        closed.

        Every iterator has its own queue.
        """
        readings = Readings(self, self._depth)
        self._inbox.join(readings)
        return readings

    def __aiter__(self) -> AsyncReadings:
        """The same for asyncio; to be called while its event loop runs."""
        readings = AsyncReadings(self, self._depth)
        self._inbox.join(readings)
        return readings

    def on_transform(self, callback: Callable[[Reading], None]) -> None:
        """Call back with every reading that an iterator would return, in a separate thread, until the client is closed.

        An exception in the callback ends its thread and goes to ``threading.excepthook``.
        """
        self._call_back(callback, iter(self))

    @property
    def unreadable(self) -> int:
        """How many messages could not be read; the log says once what was wrong with them."""
        return self._inbox.unreadable

    @property
    def closed(self) -> bool:
        return self._inbox.heard.closed

    def close(self) -> None:
        """Leave the network: iterators and callbacks end, nothing is usable any more.  May be called twice.

        It waits for a running callback, unless it is called from one.
        """
        self._inbox.close()
        self._link.close()
        super().close()

    def judge(self, entry: Entry) -> Reading:
        """The reading of a message, as of now."""
        return judge(self._inbox.heard, entry, self.policy, time.monotonic(), time.time_ns(), self._fault)

    def look_around(self) -> None:
        """Query, without waiting, which monitors are on the network; ``reason`` then names them."""

        def find(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                self._inbox.found(monitor_name(reply.ok.key_expr))

        if self._session is not None:
            with contextlib.suppress(zenoh.ZError):  # another thread is closing it
                everyone, found = Keys("*", "*")["alive"], in_zenohs_thread(find)
                self._session.liveliness().get(everyone, found, timeout=_LOOK_WITHIN_S)

    def _fault(self) -> str:
        try:
            return self._link.fault()
        except zenoh.ZError:  # another thread is closing the session
            return "the client is being closed"

    def _declare(self, session: zenoh.Session) -> None:
        self._session = session
        keys, tokens = self.keys, session.liveliness()
        self._declared = (
            session.declare_subscriber(keys["transform"], in_zenohs_thread(self._receive)),
            tokens.declare_subscriber(keys["alive"], in_zenohs_thread(self._see), history=True),
            tokens.declare_subscriber(keys["alive/*"], in_zenohs_thread(self._see_start), history=True),
        )

    def _receive(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            arrival_s, arrived_ns = time.monotonic(), steady_ns()
            reading = None if sample.attachment is None else _clock_reading(sample.attachment)
            sent = None if reading is None else Sent(reading, arrived_ns)
            self._inbox.take(monitor_name(sample.key_expr), sample.payload.to_bytes(), arrival_s, sent)
            if sent is not None:
                self._ask_for_clock(known=self._inbox.age_known)

    def _see(self, token: zenoh.Sample) -> None:
        seen = self._inbox.appeared if token.kind == zenoh.SampleKind.PUT else self._inbox.vanished
        seen(monitor_name(token.key_expr))
        if token.kind == zenoh.SampleKind.PUT:
            self._ask_for_clock(known=False)  # so that already its first transform is usable

    def _see_start(self, token: zenoh.Sample) -> None:
        seen = self._inbox.started if token.kind == zenoh.SampleKind.PUT else self._inbox.ended
        seen(start_of(token.key_expr))

    def _ask_for_clock(self, *, known: bool) -> None:
        """Query the monitor's clock if due, sooner if nothing is ``known`` yet.  Called in Zenoh's threads."""
        session, now_s = self._session, time.monotonic()
        if session is None or now_s < self._next_question_s - (ASK_EVERY_S - _ASK_AGAIN_S) * (not known):
            return
        self._next_question_s = now_s + ASK_EVERY_S
        asked_ns = steady_ns()

        def take(reply: zenoh.Reply) -> None:
            answered_ns = steady_ns()
            reading = None if reply.ok is None else _clock_reading(reply.ok.payload)
            if reading is not None:  # a monitor of an older version replies with its last transform
                self._inbox.answered(reading, asked_ns, answered_ns)

        with contextlib.suppress(zenoh.ZError):  # the session is being closed
            session.get(
                f"{self.keys['transform']}?{CLOCK_PARAMETER}",
                in_zenohs_thread(take),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=_ANSWER_WITHIN_S,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.REAL_TIME,  # also of the reply, which must not queue behind less urgent data
                express=True,
            )


def _clock_reading(payload: zenoh.ZBytes) -> ClockReading | None:
    try:
        return from_json(payload.to_bytes(), ClockReading)
    except MessageRefused:
        return None


class _Queue:
    """The queue of one reader: the newest ``depth`` messages; older ones are dropped.

    In addition it returns, once, a reading of verdict ``unknown`` when the last one expires, because the monitor
    vanished or nothing newer came in time; and, once, one that says why if no first message comes.  So a loop that only
    waits for the next reading also stops in time.
    """

    def __init__(self, client: TransformClient, depth: int) -> None:
        self._client = client
        self._entries: deque[Entry] = deque(maxlen=depth)
        self._given = client.latest()
        waits = self._given.verdict is Verdict.UNKNOWN
        self._look_s = time.monotonic() + FIRST_WITHIN_S - _LOOK_AROUND_S if waits else None
        self._say_s: float | None = None

    def put(self, entry: Entry) -> None:
        self._entries.append(entry)
        self.wake()

    def wake(self) -> None:
        raise NotImplementedError

    def _take(self) -> Reading | None:
        """The next reading if there is one."""
        if self._entries:
            self._look_s = self._say_s = None
            self._given = self._client.judge(self._entries.popleft())
            return self._given
        if self._given.verdict is not Verdict.UNKNOWN and (now := self._client.latest()).verdict is Verdict.UNKNOWN:
            self._given = now
            return now
        return self._silence(time.monotonic())

    def _silence(self, now_s: float) -> Reading | None:
        """A reading that says why there is no first message, when it is due."""
        if self._look_s is not None and now_s >= self._look_s:
            self._look_s, self._say_s = None, now_s + _LOOK_AROUND_S
            self._client.look_around()
        elif self._say_s is not None and now_s >= self._say_s:
            self._say_s = None
            self._given = self._client.latest()
            return self._given
        return None

    def _patience_s(self) -> float | None:
        """Time until the next check if nothing arrives, s; None: no check."""
        next_s = self._look_s if self._look_s is not None else self._say_s
        if next_s is not None:
            return max(0.0, next_s - time.monotonic()) + _LATE_S
        if self._given.verdict is Verdict.UNKNOWN:
            return None
        return max(0.0, self._client.policy.max_age_s - self._client.latest().age_s) + _LATE_S


class Readings(_Queue):
    """Iterator for one thread; ends when the client is closed."""

    def __init__(self, client: TransformClient, depth: int) -> None:
        super().__init__(client, depth)
        self._news = threading.Event()

    def wake(self) -> None:
        self._news.set()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Reading:
        while not self._client.closed:
            self._news.clear()  # before checking, so that what arrives afterwards is not missed
            if (reading := self._take()) is not None:
                return reading
            if not self._client.closed:
                self._news.wait(self._patience_s())
        raise StopIteration


class AsyncReadings(_Queue):
    """Asynchronous iterator for one task of asyncio; ends when the client is closed.

    A cancelled wait loses nothing: the next ``anext`` continues.
    """

    def __init__(self, client: TransformClient, depth: int) -> None:
        super().__init__(client, depth)
        self._loop = asyncio.get_running_loop()
        self._news = asyncio.Event()

    def wake(self) -> None:
        with contextlib.suppress(RuntimeError):  # its event loop has ended, and with it the wait
            self._loop.call_soon_threadsafe(self._news.set)

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Reading:
        while not self._client.closed:
            self._news.clear()
            if (reading := self._take()) is not None:
                return reading
            if not self._client.closed:
                with contextlib.suppress(TimeoutError):  # then the next check is due
                    async with asyncio.timeout(self._patience_s()):
                        await self._news.wait()
        raise StopAsyncIteration
