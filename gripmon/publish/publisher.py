"""What a monitor says on the network."""

from __future__ import annotations

import threading
from collections import deque
from typing import Protocol

import zenoh

from gripmon.publish.answers import Answers
from gripmon.records import AlertRecord, FrameRecord, ReferenceRecord, StateRecord, to_json
from gripmon.wire import Keys, Link, check_name

_JSON = zenoh.Encoding.APPLICATION_JSON
_ALERTS_KEPT = 32  # for subscribers that ask for history, and while there is no session yet
_HEARTBEAT_S = 1.0


class Publisher(Protocol):
    """Where the loop puts what it has to say.  No method waits for the network."""

    def transform(self, record: FrameRecord) -> None: ...
    def state(self, record: StateRecord) -> None: ...
    def alert(self, record: AlertRecord) -> None: ...
    def reference(self, record: ReferenceRecord) -> None: ...
    def close(self) -> None: ...


class NullPublisher:
    """Says nothing."""

    def transform(self, record: FrameRecord) -> None: ...
    def state(self, record: StateRecord) -> None: ...
    def alert(self, record: AlertRecord) -> None: ...
    def reference(self, record: ReferenceRecord) -> None: ...
    def close(self) -> None: ...


class ZenohPublisher:
    """Publishes one monitor's records over a link, which it closes in the end.

    While the link is not open yet, transforms are dropped and counted in ``unsent``; the last state, the last reference
    and the last few alerts are kept for its opening.
    """

    def __init__(self, link: Link, robot: str, camera: str) -> None:
        """Raises ValueError for a name that can't be part of a key."""
        self.keys = Keys(check_name("robot", robot), check_name("camera", camera))
        self.unsent = 0
        self._link = link
        self._wire: _Wire | None = None
        self._lock = threading.Lock()  # guards the kept records below against the opening thread
        self._state: StateRecord | None = None
        self._reference: ReferenceRecord | None = None
        self._alerts: deque[AlertRecord] = deque(maxlen=_ALERTS_KEPT)
        link.attach(self._adopt, self._leave)

    def transform(self, record: FrameRecord) -> None:
        """Send one frame's record."""
        wire = self._wire
        if wire is None:
            self.unsent += 1
        else:
            wire.transform.put(to_json(record))

    def state(self, record: StateRecord) -> None:
        """Send the state, and keep it for late joiners."""
        with self._lock:
            self._state = record
            if self._wire is not None:
                self._wire.state.put(to_json(record))

    def reference(self, record: ReferenceRecord) -> None:
        """Send the reference, and keep it for late joiners."""
        with self._lock:
            self._reference = record
            if self._wire is not None:
                self._wire.reference.put(to_json(record))

    def alert(self, record: AlertRecord) -> None:
        """Send an alert."""
        with self._lock:
            if self._wire is not None:
                self._wire.alert.put(to_json(record))
            else:
                self._alerts.append(record)

    def close(self) -> None:
        """Withdraw the liveliness token and close the link.  Calling it twice does nothing more."""
        self._link.close()

    def _adopt(self, session: zenoh.Session) -> None:
        """Declare everything on a new session and send what was kept for it."""
        wire = _Wire(session, self.keys)
        with self._lock:
            self._wire = wire
            if self._reference is not None:
                wire.reference.put(to_json(self._reference))
            if self._state is not None:
                wire.state.put(to_json(self._state))
            while self._alerts:
                wire.alert.put(to_json(self._alerts.popleft()))

    def _leave(self) -> None:
        with self._lock:
            wire, self._wire = self._wire, None
        if wire is not None:
            wire.close()


def _keeping_publisher(
    session: zenoh.Session, key: str, priority: zenoh.Priority, kept: int
) -> zenoh.ext.AdvancedPublisher:
    """A publisher whose last ``kept`` samples an advanced subscriber with history gets when it comes later."""
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


class _LastValue:
    """A key whose last value is there for whoever asks."""

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
        # Answered in Zenoh's own thread: one of Python's would keep a process that forgot close() from ending.
        answer = zenoh.handlers.Callback(self._answer, indirect=False)
        self._queryable = session.declare_queryable(key, answer, complete=True)

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


class _Wire:
    """Everything declared on one open session."""

    def __init__(self, session: zenoh.Session, keys: Keys) -> None:
        # No cache here: a transform is worth nothing to who didn't ask for the last one.
        transforms = session.declare_publisher(
            keys["transform"],
            encoding=_JSON,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME,
            express=True,
        )
        self._answers = Answers("latest")
        self.transform = _LastValue(session, keys["transform"], transforms, self._answers)
        self.alert = _keeping_publisher(session, keys["alert"], zenoh.Priority.INTERACTIVE_HIGH, kept=_ALERTS_KEPT)
        self.state, self.reference = (
            _LastValue(session, key, _keeping_publisher(session, key, zenoh.Priority.DATA_HIGH, kept=1), self._answers)
            for key in (keys["state"], keys["reference"])
        )
        self._alive = session.liveliness().declare_token(keys["alive"])

    def close(self) -> None:
        self._alive.undeclare()
        self._answers.close()
