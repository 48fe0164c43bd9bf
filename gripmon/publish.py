"""What the monitor says on the network, and the jaw opening that it hears there: one Zenoh session.

Keys, all below ``gripmon/<robot>/<camera>``, payloads JSON of the records (:mod:`gripmon.records`):

``transform``  every frame; express, real-time priority, dropped rather than waited for when a link is congested
``state``      once a second and on every change; late joiners get the last one
``reference``  on every new revision; late joiners get the last one
``alert``      when there is one; an advanced subscriber with history gets the last 32
``alive``      liveliness token, gone as soon as the process is
``jaw``        read, not written: ``{"stamp_ns": …, "opening_m": …}`` from the robot

"Late joiners get the last one" holds both ways that people ask: a plain ``get`` on the key (a queryable answers it),
and an advanced subscriber with history (``zenoh.ext``).
"""

from __future__ import annotations

import logging
import re
import threading
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Protocol

import msgspec
import zenoh

from gripmon.records import AlertRecord, FrameRecord, ReferenceRecord, StateRecord, to_json

_log = logging.getLogger(__name__)

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
_ENDPOINT_PATTERN = r"^(tcp|udp|tls|quic|ws|serial|unixsock-stream|unixpipe|vsock)/\S+$"
_NAME = re.compile(r"[^/*$#?@\s][^/*$#?\s]*")
_JSON = zenoh.Encoding.APPLICATION_JSON
_ALERTS_KEPT = 32  # for subscribers that ask for history, and while there is no session yet
_JAW_READINGS_KEPT = 64  # between two frames; the newest win
_HEARTBEAT_S = 1.0

Endpoint = Annotated[
    str, msgspec.Meta(pattern=_ENDPOINT_PATTERN, description="a Zenoh endpoint, e.g. tcp/127.0.0.1:7447")
]


class PublishError(ValueError):
    """The session can't be opened as configured; the text is ``key: what is wrong; what would be right``."""


class PublishSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How to join the network.  The default is a peer that listens on loopback only and looks for nobody."""

    enabled: Annotated[bool, msgspec.Meta(description="false: nothing is published")] = True
    mode: Annotated[
        Literal["peer", "client"],
        msgspec.Meta(description="peer: listens and connects; client: connects to a router, and waits for it"),
    ] = "peer"
    listen: Annotated[tuple[Endpoint, ...], msgspec.Meta(description="where a peer listens; empty: nowhere")] = (
        DEFAULT_ENDPOINT,
    )
    connect: Annotated[tuple[Endpoint, ...], msgspec.Meta(description="peers or routers to connect to")] = ()
    multicast_scouting: Annotated[bool, msgspec.Meta(description="look for others by UDP multicast")] = False
    zenoh_config: Annotated[
        str | None, msgspec.Meta(description="a Zenoh configuration file (json5, json, yaml) instead of the keys above")
    ] = None
    retry_first_s: Annotated[
        float, msgspec.Meta(gt=0.0, description="client without a router: first pause before the next attempt (s)")
    ] = 0.25
    retry_max_s: Annotated[float, msgspec.Meta(gt=0.0, description="longest such pause; they double (s)")] = 8.0
    jaw_max_age_s: Annotated[
        float, msgspec.Meta(gt=0.0, description="a jaw opening received longer ago than this is not used (s)")
    ] = 1.0


@dataclass(frozen=True, slots=True)
class Keys:
    """The keys of one monitor: ``Keys("arm", "wrist")["state"]``.  For readers a name may be ``*``: any."""

    robot: str
    camera: str

    def __post_init__(self) -> None:
        for role, name in (("robot", self.robot), ("camera", self.camera)):
            if name != "*":
                check_name(role, name)

    def __getitem__(self, leaf: str) -> str:
        return f"gripmon/{self.robot}/{self.camera}/{leaf}"


def check_name(role: str, name: str) -> None:
    """Raise ValueError unless the name can be one chunk of a Zenoh key."""
    if not _NAME.fullmatch(name):
        raise ValueError(
            f"{role} name {name!r} can't be part of a Zenoh key; give at least one character, none of them a space or "
            "one of / * $ # ?, and no @ in front"
        )


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


class JawReading(msgspec.Struct, frozen=True):
    """One message on the ``jaw`` key."""

    stamp_ns: int
    opening_m: float


class ZenohJaw:
    """The newest jaw opening that the robot sent.

    Ask once a frame, from one thread; nothing runs between the asks.  Age counts from arrival, so that the robot's
    clock need not agree with ours.
    """

    def __init__(self, max_age_s: float) -> None:
        self.malformed = 0
        self._max_age_s = max_age_s
        self._subscriber: zenoh.Subscriber[zenoh.Handler[zenoh.Sample]] | None = None
        self._decode = msgspec.json.Decoder(JawReading).decode
        self._newest: JawReading | None = None
        self._arrival_s = 0.0

    def attach(self, session: zenoh.Session, key: str) -> None:
        self._subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(_JAW_READINGS_KEPT))

    def opening_m(self) -> float | None:
        """The newest opening, m; None if none came, or none for ``jaw_max_age_s``."""
        now_s = time.monotonic()
        self._receive(now_s)
        if self._newest is None or now_s - self._arrival_s > self._max_age_s:
            return None
        return self._newest.opening_m

    def fault(self) -> str:
        """What is wrong with the readings, in a few words for a person; empty if nothing is."""
        faults = []
        if self._newest is None:
            faults.append("no jaw opening received")
        elif time.monotonic() - self._arrival_s > self._max_age_s:
            faults.append(f"no jaw opening for {self._max_age_s:g} s or longer")
        if self.malformed:
            faults.append(f"{self.malformed} malformed jaw message{'s' * (self.malformed > 1)}")
        return ", ".join(faults)

    def _receive(self, now_s: float) -> None:
        while self._subscriber is not None and (sample := self._subscriber.try_recv()) is not None:
            try:
                self._newest = self._decode(sample.payload.to_bytes())
                self._arrival_s = now_s
            except msgspec.DecodeError as error:
                self.malformed += 1
                if self.malformed == 1:
                    _log.warning("malformed message on %s: %s", sample.key_expr, error)


class ZenohPublisher:
    """Publishes one monitor's records.

    The session is open when the constructor returns, except for a client: its router may come later, so it is opened in
    a thread that tries again with growing pauses.  Until then transforms are dropped and counted in ``unsent``; the
    last state, the last reference and the last few alerts are kept for the router's arrival.
    """

    def __init__(self, settings: PublishSettings, robot: str, camera: str, *, subscribe_jaw: bool = False) -> None:
        """Raises ValueError for a name that can't be part of a key, and :class:`PublishError` for a configuration that
        can't work or an address that is already taken.
        """
        check_name("robot", robot)
        check_name("camera", camera)
        self.keys = Keys(robot, camera)
        self.jaw = ZenohJaw(settings.jaw_max_age_s)
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
        config = zenoh_config(settings)
        if config.get_json("mode") == '"client"':
            self._opener = threading.Thread(
                target=self._open_until_it_works, args=(config,), name="zenoh-open", daemon=True
            )
            self._opener.start()
        else:
            self._adopt(_open(config, settings))

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
                if (text := _short(error)) != said:
                    _log.warning("no Zenoh session yet, trying again: %s", text)
                    said = text
                self._closing.wait(pause_s)
                pause_s = min(2.0 * pause_s, self._settings.retry_max_s)
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
        self._queryable = session.declare_queryable(key, self._answer, complete=True)

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


def zenoh_config(settings: PublishSettings) -> zenoh.Config:
    """Zenoh's own configuration for these settings.  Raises :class:`PublishError`."""
    defaults = PublishSettings()
    if settings.zenoh_config is not None:
        for key in ("mode", "listen", "connect", "multicast_scouting"):
            if getattr(settings, key) != getattr(defaults, key):
                raise PublishError(f"publish.{key}: has no effect beside publish.zenoh_config; say it in that file")
        if not Path(settings.zenoh_config).is_file():
            raise PublishError(
                f"publish.zenoh_config: no file {settings.zenoh_config}; give a json5 or yaml file of Zenoh's"
            )
        try:
            return zenoh.Config.from_file(settings.zenoh_config)
        except zenoh.ZError as error:
            raise PublishError(f"publish.zenoh_config: {settings.zenoh_config}: {_short(error)}") from error
    if settings.mode == "client" and not (settings.connect or settings.multicast_scouting):
        raise PublishError("publish.connect: a client needs a router; give its endpoint, e.g. tcp/192.168.1.2:7447")
    config = zenoh.Config()
    listen = settings.listen if settings.mode == "peer" else ()
    entries = {
        "mode": settings.mode,
        "listen/endpoints": listen,
        "listen/exit_on_failure": True,
        "connect/endpoints": settings.connect,
        "scouting/multicast/enabled": settings.multicast_scouting,
    }
    for key, value in entries.items():
        try:
            config.insert_json5(key, msgspec.json.encode(value).decode())
        except zenoh.ZError as error:
            raise PublishError(f"publish.{key.split('/')[0]}: {_short(error)}") from error
    return config


def _open(config: zenoh.Config, settings: PublishSettings) -> zenoh.Session:
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        keys = [f"publish.{key}" for key in ("listen", "connect") if getattr(settings, key)]
        key = " or ".join(keys) if settings.zenoh_config is None else "publish.zenoh_config"
        if taken := re.search(r"bound to (\S+?): .*Address already in use", str(error)):
            key = key.split(" or ")[0]
            remedy = "stop the program that has it, or choose another port"
            raise PublishError(f"{key}: {taken[1]} is already in use; {remedy}") from error
        raise PublishError(f"{key}: can't open a Zenoh session: {_short(error)}") from error


def _short(error: zenoh.ZError) -> str:
    """Zenoh's message without the places in its source files."""
    return re.sub(r"\s+at \S+\.rs:\d+\.?", "", str(error)).strip()
