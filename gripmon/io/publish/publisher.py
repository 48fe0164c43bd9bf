"""A monitor's messages on the network."""

from __future__ import annotations

import threading
import uuid
from collections import deque
from collections.abc import Callable
from typing import TypeVar

import msgspec
import zenoh

from gripmon.io.publish.presence import Answers, Presence
from gripmon.io.wire import CLOCK_PARAMETER, Keys, Link, check_name, in_zenohs_thread, steady_ns
from gripmon.model.outputs import Event, Notes, Output, Trace
from gripmon.model.records import (
    AlertRecord,
    ClockReading,
    Frame,
    FrameRecord,
    ReferenceRecord,
    StateRecord,
    to_json,
)

_T = TypeVar("_T", FrameRecord, StateRecord, AlertRecord)
_JSON = zenoh.Encoding.APPLICATION_JSON
_ALERTS_KEPT = 32  # for subscribers that ask for history, and while there is no session yet
_HEARTBEAT_S = 1.0


class ZenohPublisher(Output):
    """Publishes one monitor's records over a link, which it closes in the end.

    While the link is not open yet, transforms are dropped and counted in ``unsent``; the last state, the last reference
    and the last few alerts are kept for its opening.
    """

    name = "Zenoh"
    public = True

    def __init__(self, link: Link, robot: str, camera: str, presence: Presence | None = None) -> None:
        """``presence`` has the id for every message.  Raises ValueError for a name that can't be part of a key."""
        self.keys = Keys(check_name("robot", robot), check_name("camera", camera))
        self.monitor_id = "" if presence is None else presence.monitor_id
        self.unsent = 0
        self._link = link
        self._wire: _Wire | None = None
        self._lock = threading.Lock()  # guards the kept records below against the opening thread
        self._last: dict[str, bytes] = {}  # by key, of what late joiners get
        self._waiting: deque[bytes] = deque(maxlen=_ALERTS_KEPT)
        link.attach(self._adopt, self._leave)

    def frame(self, frame: Frame, record: FrameRecord, trace: Trace, notes: Notes | None = None) -> None:
        """Send one frame's record."""
        wire = self._wire
        if wire is None:
            self.unsent += 1
        else:
            wire.puts["transform"](to_json(self._signed(record)))

    def event(self, event: Event) -> None:
        """Send a reference or a state, and keep it for late joiners; send an alert."""
        if isinstance(event, AlertRecord):
            self._put_alert(to_json(self._signed(event)))
        elif isinstance(event, StateRecord):
            self._put_last("state", to_json(self._signed(event)))
        elif isinstance(event, ReferenceRecord):
            self._put_last("reference", to_json(event))

    def close(self) -> None:
        """Withdraw the liveliness token and close the link.  Calling it twice does nothing more."""
        self._link.close()

    def _signed(self, record: _T) -> _T:
        """The record with the id of this start."""
        return msgspec.structs.replace(record, monitor_id=self.monitor_id) if self.monitor_id else record

    def _put_last(self, leaf: str, payload: bytes) -> None:
        with self._lock:
            self._last[leaf] = payload
            if self._wire is not None:
                self._wire.puts[leaf](payload)

    def _put_alert(self, payload: bytes) -> None:
        with self._lock:
            if self._wire is not None:
                self._wire.puts["alert"](payload)
            else:
                self._waiting.append(payload)

    def _adopt(self, session: zenoh.Session) -> None:
        """Declare everything on a new session and send what was kept for it."""
        wire = _Wire(session, self.keys, self.monitor_id)
        wire.appear()
        with self._lock:
            self._wire = wire
            for leaf in sorted(self._last):  # a reference before the state that names it
                wire.puts[leaf](self._last[leaf])
            while self._waiting:
                wire.puts["alert"](self._waiting.popleft())

    def _leave(self) -> None:
        with self._lock:
            wire, self._wire = self._wire, None
        if wire is not None:
            wire.close()


def _keeping_publisher(
    session: zenoh.Session, key: str, priority: zenoh.Priority, kept: int
) -> zenoh.ext.AdvancedPublisher:
    """A publisher that keeps its last ``kept`` samples for advanced subscribers with history that join later."""
    return zenoh.ext.declare_advanced_publisher(
        session,
        key,
        encoding=_JSON,
        congestion_control=zenoh.CongestionControl.DROP,
        priority=priority,
        cache=zenoh.ext.CacheConfig(kept),
        # Sequence numbers instead of timestamps: the cache then works whatever the session's timestamping setting.
        sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=_HEARTBEAT_S),
        publisher_detection=True,
    )


def _too_many_ask(query: zenoh.Query) -> None:
    query.reply_err(b"busy: too many ask; try again later", encoding=zenoh.Encoding.TEXT_PLAIN)


class _LastValue:
    """A key whose last value is returned by a ``get``."""

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        publisher: zenoh.Publisher | zenoh.ext.AdvancedPublisher,
        answers: Answers,
    ) -> None:
        self._key = key
        self._answers = answers
        self._last: bytes | None = None
        self._publisher = publisher
        self._queryable = session.declare_queryable(key, in_zenohs_thread(self._answer), complete=True)

    def put(self, payload: bytes) -> None:
        self._last = payload
        self._publisher.put(payload)

    def _answer(self, query: zenoh.Query) -> None:
        self._answers.send(query, self._reply)

    def _reply(self, query: zenoh.Query) -> None:
        last = self._last
        if last is None:
            query.reply_err(b"nothing published on this key yet", encoding=zenoh.Encoding.TEXT_PLAIN)
        else:
            query.reply(self._key, last, encoding=_JSON)


class _TimedStream(_LastValue):
    """A key whose messages contain their sending time, and which answers queries for the present time.

    With both a reader without a synchronised clock can bound a message's delay.
    """

    _clock = uuid.uuid4().hex  # of this process: after a restart, perhaps on another machine, it is another one

    def put(self, payload: bytes) -> None:
        self._last = payload
        self._publisher.put(payload, attachment=self._now())

    def _answer(self, query: zenoh.Query) -> None:
        if query.parameters.get(CLOCK_PARAMETER) is None:
            super()._answer(query)
            return
        now = self._now()  # before the reply has to wait for anything
        self._answers.send(query, lambda asked: asked.reply(self._key, now, encoding=_JSON))

    def _now(self) -> bytes:
        return to_json(ClockReading(self._clock, steady_ns()))


class _Wire:
    """Everything declared on one open session; ``puts`` by the last part of the key."""

    def __init__(self, session: zenoh.Session, keys: Keys, monitor_id: str) -> None:
        self._session, self._keys = session, keys
        # the id first: a reader that sees the token without one then also finds the id
        self._tokens = [*([keys[f"alive/{monitor_id}"]] if monitor_id else []), keys["alive"]]
        self._answers = Answers("latest", _too_many_ask)
        alerts = _keeping_publisher(session, keys["alert"], zenoh.Priority.INTERACTIVE_HIGH, kept=_ALERTS_KEPT)
        self.puts: dict[str, Callable[[bytes], None]] = {"alert": alerts.put}
        self.declare_newest("transform")
        for leaf in ("reference", "state"):
            self.declare_kept(leaf)
        self._alive: list[zenoh.LivelinessToken] = []

    def declare_newest(self, leaf: str) -> None:
        """A key of a stream, without history: earlier messages are useless to subscribers."""
        publisher = self._session.declare_publisher(
            self._keys[leaf],
            encoding=_JSON,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME,
            express=True,
        )
        self.puts[leaf] = _TimedStream(self._session, self._keys[leaf], publisher, self._answers).put

    def declare_kept(self, leaf: str, kept: int = 1) -> None:
        """A key whose last ``kept`` messages are kept for late joiners."""
        publisher = _keeping_publisher(self._session, self._keys[leaf], zenoh.Priority.DATA_HIGH, kept)
        self.puts[leaf] = _LastValue(self._session, self._keys[leaf], publisher, self._answers).put

    def appear(self) -> None:
        """Declare the liveliness tokens, after everything else: the one of every monitor, and that of this start."""
        self._alive = [self._session.liveliness().declare_token(key) for key in self._tokens]

    def close(self) -> None:
        for token in reversed(self._alive):
            token.undeclare()
        self._answers.close()
