"""One open session and everything declared on it."""

from __future__ import annotations

import logging
import threading
from collections import deque
from pathlib import Path
from typing import Protocol

import zenoh

from gripmon.publish.commands import ZenohCommands
from gripmon.publish.jaw import ZenohJaw
from gripmon.publish.session import in_short, open_session, zenoh_config
from gripmon.publish.settings import Keys, PublishSettings, check_name
from gripmon.records import AlertRecord, FrameRecord, ReferenceRecord, StateRecord, to_json

_log = logging.getLogger(__name__)

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
    """Publishes one monitor's records.

    The session is open when the constructor returns, except for a client: its router may come later, so it is opened in
    a thread that tries again with growing pauses.  Until then transforms are dropped and counted in ``unsent``; the
    last state, the last reference and the last few alerts are kept for the router's arrival.
    """

    def __init__(
        self,
        settings: PublishSettings,
        robot: str,
        camera: str,
        *,
        subscribe_jaw: bool = False,
        relative_to: Path = Path(),
    ) -> None:
        """``relative_to`` is the folder of the configuration file, from which a path in the settings counts.

        Raises ValueError for a name that can't be part of a key, and :class:`PublishError` for a configuration that
        can't work or an address that is already taken.
        """
        check_name("robot", robot)
        check_name("camera", camera)
        self.keys = Keys(robot, camera)
        self.jaw = ZenohJaw(settings.jaw_max_age_s)
        self.commands = ZenohCommands(self.keys)
        self.unsent = 0
        self._settings = settings
        self._subscribe_jaw = subscribe_jaw
        self._wire: _Wire | None = None
        self._lock = threading.Lock()  # guards the kept records below against the opening thread
        self._state: StateRecord | None = None
        self._reference: ReferenceRecord | None = None
        self._alerts: deque[AlertRecord] = deque(maxlen=_ALERTS_KEPT)
        self._closing = threading.Event()
        self._opener: threading.Thread | None = None
        config = zenoh_config(settings, relative_to)
        if config.get_json("mode") == '"client"':
            self._opener = threading.Thread(
                target=self._open_until_it_works, args=(config,), name="zenoh-open", daemon=True
            )
            self._opener.start()
        else:
            self._adopt(open_session(config, settings))

    @property
    def connected(self) -> bool:
        """Is there a session?  False only for a client that has not found its router yet."""
        return self._wire is not None

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
        """Withdraw the liveliness token, close the session and free its port.  Calling it twice does nothing more."""
        self._closing.set()
        self.commands.close()
        if self._opener is not None:
            self._opener.join(timeout=1.0)  # an attempt under way closes its own session when it returns
        with self._lock:
            wire, self._wire = self._wire, None
        if wire is not None:
            wire.close()

    def _adopt(self, session: zenoh.Session) -> None:
        """Declare everything on a new session and send what was kept for it."""
        wire = _Wire(session, self.keys)
        if self._subscribe_jaw:
            self.jaw.attach(session, self.keys["jaw"])
        if self._settings.commands:
            self.commands.attach(session)
        with self._lock:
            self._wire = wire
            if self._reference is not None:
                wire.reference.put(to_json(self._reference))
            if self._state is not None:
                wire.state.put(to_json(self._state))
            while self._alerts:
                wire.alert.put(to_json(self._alerts.popleft()))

    def _open_until_it_works(self, config: zenoh.Config) -> None:
        pause_s = self._settings.retry_first_s
        said = ""
        while not self._closing.is_set():
            try:
                session = zenoh.open(config)
            except zenoh.ZError as error:
                if (text := in_short(error)) != said:
                    _log.warning("no Zenoh session yet, trying again: %s", text)
                    said = text
                self._closing.wait(pause_s)
                pause_s = min(2.0 * pause_s, self._settings.retry_longest_s)
                continue
            if self._closing.is_set():
                session.close()
                return
            self._adopt(session)
            _log.info("Zenoh session open")
            return


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
    """A key whose last value is there for whoever comes later."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._key = key
        self._last: bytes | None = None
        self._publisher = _keeping_publisher(session, key, zenoh.Priority.DATA_HIGH, kept=1)
        # Answered in Zenoh's own thread: one of Python's would keep a process that forgot close() from ending.
        answer = zenoh.handlers.Callback(self._answer, indirect=False)
        self._queryable = session.declare_queryable(key, answer, complete=True)

    def put(self, payload: bytes) -> None:
        self._last = payload
        self._publisher.put(payload)

    def _answer(self, query: zenoh.Query) -> None:
        # Zenoh swallows an exception here and the asker would see an empty result: always answer in words.
        last = self._last
        if last is None:
            query.reply_err(b"nothing published on this key yet", encoding=zenoh.Encoding.TEXT_PLAIN)
        else:
            query.reply(self._key, last, encoding=_JSON)


class _Wire:
    """Everything declared on one open session."""

    def __init__(self, session: zenoh.Session, keys: Keys) -> None:
        self._session = session
        self.transform = session.declare_publisher(
            keys["transform"],
            encoding=_JSON,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME,
            express=True,
        )
        self.alert = _keeping_publisher(session, keys["alert"], zenoh.Priority.INTERACTIVE_HIGH, kept=_ALERTS_KEPT)
        self.state = _LastValue(session, keys["state"])
        self.reference = _LastValue(session, keys["reference"])
        self._alive = session.liveliness().declare_token(keys["alive"])

    def close(self) -> None:
        self._alive.undeclare()
        self._session.close()
