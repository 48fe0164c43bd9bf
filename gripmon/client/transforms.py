"""The newest transform of one monitor, for programs that move by it."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Sequence
from typing import Self

import zenoh

from gripmon.client.age import Sent
from gripmon.client.asking import ClockAsker
from gripmon.client.inbox import Entry, Inbox
from gripmon.client.iterators import AsyncReadings, Readings
from gripmon.client.judging import judge
from gripmon.client.names import monitor_name, start_of
from gripmon.client.network import named_as_arguments, reader_settings
from gripmon.client.reading import NotUsable, Policy, Reading
from gripmon.io.wire import DEFAULT_ENDPOINT, Keys, Link, steady_ns
from gripmon.model.records import ClockReading, MessageRefused, from_json

_LOOK_WITHIN_S = 1.0  # who is there answers in milliseconds


class TransformClient:
    """Hears one monitor.  Any thread may call any method.

    It may start before the monitor and the router, and needs no help when they end and come again.  With a ``with``
    statement or :meth:`close` it leaves the network.
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
        """``camera`` may be left out while the robot has one; with a second one no reading is usable, and says so.

        ``connect`` are the monitor's or a router's endpoints; ``zenoh_config_file`` is a file of Zenoh's instead.
        ``depth`` is how many readings wait for each iterator or callback that is slower than the camera: 1 gives it
        always the newest.  Raises ValueError for a name that can't be part of a key or a ``depth`` below 1, and
        :class:`gripmon.io.wire.PublishError` for a bad configuration; that nobody answers is no error.
        """
        if depth < 1:
            raise ValueError(f"depth is {depth}; give 1 or more")
        self.policy = policy if policy is not None else Policy()
        self.keys = Keys(robot, camera if camera is not None else "*")
        self._depth = depth
        self._inbox = Inbox()
        self._asker = ClockAsker(self.keys["transform"], self._inbox.answered)
        self._threads: list[threading.Thread] = []
        self._declared: tuple[object, ...] = ()  # Zenoh undeclares what nobody refers to
        with named_as_arguments():
            self._link = Link(reader_settings(connect, zenoh_config_file))
        self._session: zenoh.Session | None = None
        self._link.attach(self._declare)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def latest(self, policy: Policy | None = None) -> Reading:
        """The newest transform and whether it may be used now, at once; by the client's policy or another one.

        It takes no lock, makes no system call and raises nothing.  (Before the first transform it looks at the session,
        too, to say whom there is no connection to.)
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
        """Each reading as it comes, and one that refuses the last as soon as it holds no longer; ends with the client.

        Every iterator has a queue of its own.
        """
        readings = Readings(self, self._depth)
        self._inbox.join(readings)
        return readings

    def __aiter__(self) -> AsyncReadings:
        """The same for asyncio; to be called while its loop runs."""
        readings = AsyncReadings(self, self._depth)
        self._inbox.join(readings)
        return readings

    def on_transform(self, callback: Callable[[Reading], None]) -> None:
        """Call back with every reading that an iterator would give, in a thread of its own, until the client is closed.

        An exception in the callback ends its thread and goes to ``threading.excepthook``.
        """
        readings = iter(self)

        def pump() -> None:
            for reading in readings:
                callback(reading)

        thread = threading.Thread(target=pump, name="gripmon-client", daemon=True)
        self._threads.append(thread)
        thread.start()

    @property
    def unreadable(self) -> int:
        """How many messages could not be read; what was wrong with them is in the log, once."""
        return self._inbox.unreadable

    @property
    def closed(self) -> bool:
        return self._inbox.heard.closed

    def close(self) -> None:
        """Leave the network: iterations and callbacks end, nothing is usable.  Calling it twice does nothing more.

        It waits for a callback that is at work, unless it is called in one.
        """
        self._inbox.close()
        self._link.close()
        if threading.current_thread() not in self._threads:  # two callbacks that close would wait for each other
            for thread in self._threads:
                thread.join()

    def judge(self, entry: Entry) -> Reading:
        """The reading of a message, as of now."""
        return judge(self._inbox.heard, entry, self.policy, time.monotonic(), time.time_ns(), self._fault)

    def look_around(self) -> None:
        """Ask, without waiting, which monitors are on the network; what was heard then stands in the ``reason``."""
        found = zenoh.handlers.Callback(self._find, indirect=False)
        if self._session is not None:
            with contextlib.suppress(zenoh.ZError):  # another thread closes it just now
                self._session.liveliness().get(Keys("*", "*")["alive"], found, timeout=_LOOK_WITHIN_S)

    def _find(self, reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            self._inbox.found(monitor_name(reply.ok.key_expr))

    def _fault(self) -> str:
        try:
            return self._link.fault()
        except zenoh.ZError:  # another thread closes the session just now
            return "the client is being closed"

    def _declare(self, session: zenoh.Session) -> None:
        self._session = session
        # In Zenoh's own threads: one of Python's would keep a program that forgot close() from ending.
        transforms = zenoh.handlers.Callback(self._receive, indirect=False)
        tokens = zenoh.handlers.Callback(self._see, indirect=False)
        self._asker.use(session)
        starts = zenoh.handlers.Callback(self._see_start, indirect=False)
        self._declared = (
            session.declare_subscriber(self.keys["transform"], transforms),
            session.liveliness().declare_subscriber(self.keys["alive"], tokens, history=True),
            session.liveliness().declare_subscriber(self.keys["alive/*"], starts, history=True),
        )

    def _receive(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            arrival_s, arrived_ns = time.monotonic(), steady_ns()
            sent = _sent(sample, arrived_ns)
            self._inbox.take(monitor_name(sample.key_expr), sample.payload.to_bytes(), arrival_s, sent)
            if sent is not None:
                self._asker.ask(known=self._inbox.age_known)

    def _see(self, token: zenoh.Sample) -> None:
        seen = self._inbox.appeared if token.kind == zenoh.SampleKind.PUT else self._inbox.vanished
        seen(monitor_name(token.key_expr))
        if token.kind == zenoh.SampleKind.PUT:
            self._asker.ask(known=False)  # so that its first transform is usable

    def _see_start(self, token: zenoh.Sample) -> None:
        seen = self._inbox.started if token.kind == zenoh.SampleKind.PUT else self._inbox.ended
        seen(start_of(token.key_expr))


def _sent(sample: zenoh.Sample, arrived_ns: int) -> Sent | None:
    """When it was sent and when it arrived; None if the message doesn't say."""
    attached = sample.attachment
    if attached is None:
        return None
    try:
        return Sent(from_json(attached.to_bytes(), ClockReading), arrived_ns)
    except MessageRefused:
        return None
