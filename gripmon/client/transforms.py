"""One monitor for programs: its newest transform at once, or each as it comes, and commands to it."""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Self, TypeVar

import msgspec
import zenoh

from gripmon.client.age import Sent, steady_s
from gripmon.client.commands import alive, ask
from gripmon.client.inbox import Entry, Inbox
from gripmon.client.network import FORKED, Joined, MonitorName, monitor_name, start_of
from gripmon.client.reading import NotUsable, Policy, Reading, judge
from gripmon.io.wire import CLOCK_PARAMETER, DEFAULT_ENDPOINT, Keys, in_zenohs_thread, steady_ns
from gripmon.model.records import (
    ClockReading,
    CommandName,
    CommandReply,
    CommandRequest,
    MessageRefused,
    ReferenceRecord,
    StateRecord,
    Verdict,
    from_json,
)

_T = TypeVar("_T", bound=msgspec.Struct)

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


class TransformClient(Joined):
    """Receives the transforms of one monitor, and sends it commands.  Thread-safe.

    It may start before the monitor and the router, and reconnects by itself when they restart.  It leaves the network
    at the end of a ``with`` statement or by :meth:`close`.  A slow reader never delays the monitor.
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
        self.policy = policy if policy is not None else Policy()
        self.keys = Keys(robot, camera if camera is not None else "*")
        self._depth = depth
        self._inbox = Inbox(self.keys["transform"])
        self._next_question_s = 0.0
        super().__init__(connect, zenoh_config_file)
        self._join()

    def latest(self, policy: Policy | None = None) -> Reading:
        """The newest transform and whether it may be used now, by the client's policy or the given one.

        Returns immediately: it takes no lock, waits for nothing and raises nothing.  (Before the first transform it
        also looks at the session, to name the endpoint to which there is no connection.)
        """
        heard = self._inbox.heard
        return judge(heard, heard.entry, policy or self.policy, steady_s(), time.time_ns(), self.fault)

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

    def __aiter__(self) -> Readings:
        """The same for asyncio; to be called while its event loop runs."""
        return iter(self)

    def on_transform(self, callback: Callable[[Reading], None]) -> None:
        """Call back with every reading that an iterator would return, in a separate thread, until the client is closed.

        An exception in the callback ends its thread and goes to ``threading.excepthook``.
        """
        self._call_back(callback, iter(self))

    def state(self, timeout_s: float = 1.0) -> StateRecord | None:
        """The monitor's last state message; None if no monitor answers in time.  LookupError if several do."""
        return self._get("state", StateRecord, timeout_s)

    def reference(self, timeout_s: float = 1.0) -> ReferenceRecord | None:
        """The reference from which drift is measured now; None if no monitor answers in time.  LookupError if several
        do.
        """
        return self._get("reference", ReferenceRecord, timeout_s)

    def alive(self, timeout_s: float = 1.0) -> tuple[MonitorName, ...]:
        """The running monitors of this name, sorted; all on the network for ``TransformClient("*")``.  Raises
        :class:`gripmon.client.NotCarriedOut` without a connection, as the two above.
        """
        return alive(self.session(timeout_s), self.keys, timeout_s)

    def send(
        self,
        name: CommandName,
        argument: str = "",
        timeout_s: float = 5.0,
        *,
        request_id: str | None = None,
        monitor_id: str = "",
    ) -> CommandReply:
        """Send the monitor a command (:class:`gripmon.model.records.Command`) and wait for its reply.

        A refused command changes nothing.  ``request_id`` (at most 64 characters; by default a new one): that of an
        earlier attempt; if that was carried out, its reply is returned again.  ``monitor_id`` names one start of the
        monitor; without it only one may be running.  Raises :class:`gripmon.client.NotCarriedOut`;
        :class:`gripmon.client.Ambiguous` if several monitors have the name; ValueError for an invalid request.
        """
        new_id = uuid.uuid4().hex if request_id is None else request_id
        return ask(self, self.keys, CommandRequest(argument, new_id, monitor_id), name, timeout_s)[0]

    def snapshot(self, timeout_s: float = 5.0, *, monitor_id: str = "") -> tuple[CommandReply, bytes | None]:
        """The monitor's state and newest frame, and its image as a file of the type ``reply.snapshot.image`` (None if
        there is none).  Raises as :meth:`send`.
        """
        request = CommandRequest("", uuid.uuid4().hex, monitor_id)
        return ask(self, self.keys, request, CommandName.SNAPSHOT, timeout_s)

    @property
    def unreadable(self) -> int:
        """How many messages could not be read; the log says once what was wrong with them."""
        return self._inbox.unreadable

    @property
    def closed(self) -> bool:
        return bool(self._inbox.heard.closed)

    def close(self) -> None:
        """Leave the network: iterators and callbacks end, nothing is usable any more.  May be called twice.

        It waits for a running callback, unless it is called from one.
        """
        self._inbox.close()
        super().close()

    def judge(self, entry: Entry) -> Reading:
        """The reading of a message, as of now."""
        return judge(self._inbox.heard, entry, self.policy, steady_s(), time.time_ns(), self.fault)

    def look_around(self) -> None:
        """Query, without waiting, which monitors are on the network; ``reason`` then names them."""

        def find(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                self._inbox.found(monitor_name(reply.ok.key_expr))

        if self._session is not None:
            with contextlib.suppress(zenoh.ZError):  # another thread is closing it
                everyone, found = Keys("*", "*")["alive"], in_zenohs_thread(find)
                self._session.liveliness().get(everyone, found, timeout=_LOOK_WITHIN_S)

    def _after_fork(self) -> None:
        super()._after_fork()
        self._inbox.after_fork(FORKED)

    def _declare(self, session: zenoh.Session) -> Sequence[object]:
        keys, tokens = self.keys, session.liveliness()
        return (
            session.declare_subscriber(keys["transform"], in_zenohs_thread(self._receive)),
            tokens.declare_subscriber(keys["alive"], in_zenohs_thread(self._see), history=True),
            tokens.declare_subscriber(keys["alive/*"], in_zenohs_thread(self._see_start), history=True),
        )

    def _receive(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            arrived_ns = steady_ns()
            reading = None if sample.attachment is None else _clock_reading(sample.attachment)
            sent = None if reading is None else Sent(reading, arrived_ns)
            self._inbox.take(monitor_name(sample.key_expr), sample.payload.to_bytes(), 1e-9 * arrived_ns, sent)
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
        session, asked_ns = self._session, steady_ns()
        if session is None or 1e-9 * asked_ns < self._next_question_s - (ASK_EVERY_S - _ASK_AGAIN_S) * (not known):
            return
        self._next_question_s = 1e-9 * asked_ns + ASK_EVERY_S

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

    def _get(self, leaf: str, record_type: type[_T], timeout_s: float) -> _T | None:
        answers: dict[MonitorName, _T] = {}
        for reply in self.session(timeout_s).get(self.keys[leaf], timeout=timeout_s):
            if reply.ok is not None:
                answers[monitor_name(reply.ok.key_expr)] = from_json(reply.ok.payload.to_bytes(), record_type)
        if len(answers) > 1:
            names = ", ".join(map(str, sorted(answers)))
            raise LookupError(f"{self.keys.robot}/{self.keys.camera} is more than one monitor: {names}; name the one")
        return next(iter(answers.values()), None)


def _clock_reading(payload: zenoh.ZBytes) -> ClockReading | None:
    try:
        return from_json(payload.to_bytes(), ClockReading)
    except MessageRefused:
        return None


class Readings(Iterator[Reading]):
    """The queue of one reader, a thread or a task of asyncio: the newest ``depth`` messages; older ones are dropped.

    In addition it returns, once, a reading of verdict ``unknown`` when the last one expires, because the monitor
    vanished or nothing newer came in time; and, once, one that says why if no first message comes.  So a loop that only
    waits for the next reading also stops in time.  It ends when the client is closed.  A cancelled wait of asyncio
    loses nothing: the next ``anext`` continues.
    """

    def __init__(self, client: TransformClient, depth: int) -> None:
        self._client = client
        self._entries: deque[Entry] = deque(maxlen=depth)
        self._news = threading.Event()
        self._waiting: tuple[asyncio.AbstractEventLoop, asyncio.Event] | None = None
        self._given = client.latest()
        waits = self._given.verdict is Verdict.UNKNOWN
        self._look_s = steady_s() + FIRST_WITHIN_S - _LOOK_AROUND_S if waits else None
        self._say_s: float | None = None

    def put(self, entry: Entry) -> None:
        self._entries.append(entry)
        self.wake()

    def wake(self) -> None:
        self._news.set()
        if (waiting := self._waiting) is not None:
            loop, event = waiting
            with contextlib.suppress(RuntimeError):  # its event loop has ended, and with it the wait
                loop.call_soon_threadsafe(event.set)

    def __next__(self) -> Reading:
        while not self._client.closed:
            self._news.clear()  # before checking, so that what arrives afterwards is not missed
            if (reading := self._take()) is not None:
                return reading
            if not self._client.closed:
                self._news.wait(self._patience_s())
        raise StopIteration

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Reading:
        event = asyncio.Event()
        self._waiting = asyncio.get_running_loop(), event
        while not self._client.closed:
            event.clear()
            if (reading := self._take()) is not None:
                return reading
            if not self._client.closed:
                with contextlib.suppress(TimeoutError):  # then the next check is due
                    async with asyncio.timeout(self._patience_s()):
                        await event.wait()
        raise StopAsyncIteration

    def _take(self) -> Reading | None:
        """The next reading if there is one."""
        if self._entries:
            self._look_s = self._say_s = None
            self._given = self._client.judge(self._entries.popleft())
            return self._given
        if self._given.verdict is not Verdict.UNKNOWN and (now := self._client.latest()).verdict is Verdict.UNKNOWN:
            self._given = now
            return now
        return self._silence()

    def _silence(self) -> Reading | None:
        """A reading that says why there is no first message, when it is due."""
        if self._look_s is not None and steady_s() >= self._look_s:
            self._look_s, self._say_s = None, steady_s() + _LOOK_AROUND_S
            self._client.look_around()
        elif self._say_s is not None and steady_s() >= self._say_s:
            self._say_s = None
            self._given = self._client.latest()
            return self._given
        return None

    def _patience_s(self) -> float | None:
        """Time until the next check if nothing arrives, s; None: no check."""
        next_s = self._look_s if self._look_s is not None else self._say_s
        if next_s is not None:
            return max(0.0, next_s - steady_s()) + _LATE_S
        if self._given.verdict is Verdict.UNKNOWN:
            return None
        return max(0.0, self._client.policy.max_age_s - self._client.latest().age_s) + _LATE_S
