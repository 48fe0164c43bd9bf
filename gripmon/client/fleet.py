"""All monitors on the network: what is known about each, and its condition."""

from __future__ import annotations

import enum
import logging
import math
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import msgspec
import zenoh
import zenoh.ext

from gripmon.client.age import steady_s
from gripmon.client.commands import ask
from gripmon.client.network import FORKED, Joined, MonitorName, NotCarriedOut, monitor_name, start_of
from gripmon.io.wire import DEFAULT_ENDPOINT, Keys, in_zenohs_thread
from gripmon.io.wire.malformed import Malformed
from gripmon.model.records import (
    AlertRecord,
    CommandName,
    CommandReply,
    CommandRequest,
    MessageRefused,
    Severity,
    StandingAlert,
    StateRecord,
    from_json,
)

_T = TypeVar("_T", bound=msgspec.Struct)
_log = logging.getLogger(__name__)

SILENT_AFTER_S = 5.0
"""A monitor sends its state once a second; one that hasn't for this time, though its session is alive, hangs."""
MONITORS_KEPT = 50_000
"""At most this many names are kept, so that no sender on the network can fill the memory."""
_STARTS_KEPT = 16  # per name: two are too many already
_RATE_TRANSFORMS = 64  # transforms over which the rate is measured
_ALERTS_KEPT = 64  # per monitor: twice what its publisher repeats to late subscribers
_RANK = {Severity.ERROR: 0, Severity.WARNING: 1, Severity.INFO: 2}


class Condition(enum.StrEnum):
    """The condition of a monitor, the worst first."""

    GONE = "gone"
    STOPPED = "stopped"
    SILENT = "silent"
    SEVERAL = "several"
    UNKNOWN = "unknown"
    STARTING = "starting"
    SUSPECT = "suspect"
    VALID = "valid"


class MonitorStatus(msgspec.Struct, frozen=True, kw_only=True):
    """One monitor at the time of the call.

    ``state``: its last state message, None before the first; ``state_age_s``: time since that arrived, or since the
    monitor was first seen.  ``gone_since_ns``: when its liveliness token vanished, by our clock; None while it is
    present.  ``monitor_id``: of its start, empty while unknown; ``several``: another start with the same name is
    present, so that neither may be used.  ``transforms_per_s`` and ``transform_age_s`` are None unless transforms are
    subscribed and arrive; the age counts from the arrival, without the delay (to move by a transform use a
    :class:`TransformClient`).
    """

    name: MonitorName
    state: StateRecord | None
    state_age_s: float
    gone_since_ns: int | None = None
    transforms_per_s: float | None = None
    transform_age_s: float | None = None
    monitor_id: str = ""
    several: bool = False

    @property
    def condition(self) -> Condition:
        """From its token, its silence and its last verdict; ``starting`` before its first state message."""
        if self.gone_since_ns is not None:
            # Other faults may follow.
            stopped = self.state is not None and self.state.message.partition(";")[0] == "stopped"
            return Condition.STOPPED if stopped else Condition.GONE
        if self.state_age_s > SILENT_AFTER_S:
            return Condition.SILENT
        if self.several:
            return Condition.SEVERAL
        if self.state is None:
            return Condition.STARTING
        return Condition(self.state.verdict.value)

    @property
    def drift_m(self) -> float | None:
        """Distance of the TCP from its reference position, m; None if unknown."""
        if self.state is None or self.state.tcp_shift_m is None:
            return None
        return math.hypot(*self.state.tcp_shift_m)

    @property
    def alerts(self) -> tuple[StandingAlert, ...]:
        """Open alerts: the most severe first, then those not acknowledged, then the newest."""
        alerts = () if self.state is None else self.state.open_alerts
        return tuple(sorted(alerts, key=lambda a: (_RANK[a.severity], a.acknowledged, -(a.since_ns or 0))))


def trouble(status: MonitorStatus) -> tuple[object, ...]:
    """Sort key, the worst first: condition, then the most severe open alert, then drift, then name."""
    severest = min((_RANK[alert.severity] for alert in status.alerts), default=len(_RANK))
    return list(Condition).index(status.condition), severest, -(status.drift_m or 0.0), status.name


@dataclass(slots=True)
class _Known:
    """What is known about one monitor; times by the monotonic clock unless they end with ``_ns``.

    ``starts``: by id, the last state message of each start that is present, and when it arrived; more than one means
    several monitors with one name.
    """

    heard_s: float
    present: bool = False
    gone_since_ns: int | None = None
    state: StateRecord | None = None
    transforms_s: deque[float] = field(default_factory=lambda: deque(maxlen=_RATE_TRANSFORMS))
    starts: dict[str, tuple[StateRecord | None, float]] = field(default_factory=dict)
    alerts: deque[int] = field(default_factory=lambda: deque(maxlen=_ALERTS_KEPT))


class Fleet(Joined):
    """Subscribes to every monitor's state and liveliness token, and optionally to more.  Thread-safe.

    State messages come once a second regardless of the cameras' rates, so this works for thousands of robots.  The last
    message of a vanished monitor is kept.
    """

    def __init__(
        self,
        *,
        connect: str | Sequence[str] = (DEFAULT_ENDPOINT,),
        zenoh_config_file: str | None = None,
        transforms: bool = False,
        on_alert: Callable[[MonitorName, AlertRecord, bytes], None] | None = None,
        on_presence: Callable[[MonitorStatus], None] | None = None,
    ) -> None:
        """``transforms``: also subscribe to transforms, for their rate and age; that is every frame of every camera.

        ``on_alert`` gets every alert with its payload, including the last ones from before, each once; ``on_presence``
        gets a monitor that has appeared (``gone_since_ns`` is None) or vanished.  Both are called in Zenoh's threads:
        they must return quickly and not raise.  Raises :class:`gripmon.io.wire.PublishError`.
        """
        self._transforms, self._on_alert, self._on_presence = transforms, on_alert, on_presence
        self._malformed = Malformed("message", "gripmon/*/*")
        self._known: dict[MonitorName, _Known] = {}
        self._lock = threading.Lock()  # guards the one above against Zenoh's threads
        super().__init__(connect, zenoh_config_file)
        self._join()

    @property
    def unreadable(self) -> int:
        """How many messages could not be read; the log says once what was wrong with them."""
        return self._malformed.count

    def monitors(self) -> list[MonitorStatus]:
        """All monitors seen since the start, unordered; each of several present under one name.

        Raises :class:`NotCarriedOut` in a process that was forked since: nothing is heard there.
        """
        if self.forked:
            raise NotCarriedOut(FORKED)
        now_s = steady_s()
        with self._lock:
            return [status for name, known in self._known.items() for status in _statuses(name, known, now_s)]

    def send(
        self,
        monitor: MonitorName,
        name: CommandName,
        argument: str = "",
        timeout_s: float = 5.0,
        *,
        monitor_id: str = "",
    ) -> tuple[CommandReply, bytes | None]:
        """Send one of them a command, as :meth:`gripmon.client.TransformClient.send` does; returns the reply and its
        attachment, a snapshot's image.  Raises as that does.
        """
        request = CommandRequest(argument, uuid.uuid4().hex, monitor_id)
        return ask(self, Keys(*monitor), request, name, timeout_s)

    def _declare(self, session: zenoh.Session) -> Sequence[object]:
        keys, tokens = Keys("*", "*"), session.liveliness()
        declared: list[object] = [
            session.declare_subscriber(keys["state"], in_zenohs_thread(self._take_state)),
            tokens.declare_subscriber(keys["alive"], in_zenohs_thread(self._take_token), history=True),
            tokens.declare_subscriber(keys["alive/*"], in_zenohs_thread(self._take_start), history=True),
        ]
        if self._transforms:
            declared.append(session.declare_subscriber(keys["transform"], in_zenohs_thread(self._take_transform)))
        if self._on_alert is not None:
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
            recovery = zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True)
            take = in_zenohs_thread(self._take_alert)
            declared.append(
                zenoh.ext.declare_advanced_subscriber(session, keys["alert"], take, history=history, recovery=recovery)
            )
        return declared

    def _take_state(self, sample: zenoh.Sample) -> None:
        name = monitor_name(sample.key_expr)
        record = self._read(sample, StateRecord)
        if record is None:
            return
        with self._lock:
            known = self._about(name)
            if known is not None:
                known.state, known.heard_s = record, steady_s()
                if record.monitor_id in known.starts:
                    known.starts[record.monitor_id] = record, known.heard_s

    def _take_start(self, token: zenoh.Sample) -> None:
        start, now_s = start_of(token.key_expr), steady_s()
        with self._lock:
            known = self._about(start.monitor)
            if known is None:
                return
            if token.kind == zenoh.SampleKind.DELETE:
                known.starts.pop(start.monitor_id, None)
                if known.starts:  # the last state was from the start that left
                    known.state, known.heard_s = next(reversed(known.starts.values()))
            elif len(known.starts) < _STARTS_KEPT:
                state = known.state if known.state and known.state.monitor_id == start.monitor_id else None
                known.starts.setdefault(start.monitor_id, (state, now_s))

    def _take_token(self, token: zenoh.Sample) -> None:
        name, now_s = monitor_name(token.key_expr), steady_s()
        with self._lock:
            known = self._about(name)
            if known is None or known.present == (token.kind == zenoh.SampleKind.PUT):
                return
            known.present = not known.present
            known.gone_since_ns = None if known.present else time.time_ns()
            if known.present:
                known.state, known.heard_s = None, now_s  # a message from before it ended is outdated
                known.transforms_s.clear()
            status = _status(name, known, now_s)
        if self._on_presence is not None:
            self._on_presence(status)

    def _take_transform(self, sample: zenoh.Sample) -> None:
        with self._lock:
            known = self._about(monitor_name(sample.key_expr))
            if known is not None:
                known.transforms_s.append(steady_s())

    def _take_alert(self, sample: zenoh.Sample) -> None:
        name = monitor_name(sample.key_expr)
        record = self._read(sample, AlertRecord)
        if record is None or self._on_alert is None:
            return
        payload = sample.payload.to_bytes()
        with self._lock:
            known = self._about(name)
            if known is None or hash(payload) in known.alerts:  # repeated after a lost connection
                return
            known.alerts.append(hash(payload))
        self._on_alert(name, record, payload)

    def _read(self, sample: zenoh.Sample, kind: type[_T]) -> _T | None:
        """The message; None if it is invalid, which is counted, and logged once."""
        try:
            record = from_json(sample.payload.to_bytes(), kind)
        except MessageRefused as error:
            self._malformed.add(f"from {monitor_name(sample.key_expr)}, {error}")
            return None
        self._malformed.good()
        return record

    def _about(self, name: MonitorName) -> _Known | None:
        """The entry of a monitor, new if needed; None if there are too many.  The lock must be held."""
        known = self._known.get(name)
        if known is None and len(self._known) < MONITORS_KEPT:
            known = self._known[name] = _Known(steady_s())
            if len(self._known) == MONITORS_KEPT:
                _log.error("%d monitors; any more are not listened to", MONITORS_KEPT)
        return known


def _statuses(name: MonitorName, known: _Known, now_s: float) -> list[MonitorStatus]:
    if len(known.starts) < 2 or not known.present:
        return [_status(name, known, now_s)]
    return [
        MonitorStatus(name=name, state=state, state_age_s=now_s - heard_s, monitor_id=monitor_id, several=True)
        for monitor_id, (state, heard_s) in known.starts.items()
    ]


def _status(name: MonitorName, known: _Known, now_s: float) -> MonitorStatus:
    times_s = known.transforms_s
    rate = (len(times_s) - 1) / (times_s[-1] - times_s[0]) if len(times_s) > 1 and times_s[-1] > times_s[0] else None
    return MonitorStatus(
        name=name,
        state=known.state,
        state_age_s=now_s - known.heard_s,
        gone_since_ns=known.gone_since_ns,
        transforms_per_s=rate,
        transform_age_s=now_s - times_s[-1] if times_s else None,
        monitor_id=known.state.monitor_id if known.state is not None else next(iter(known.starts), ""),
    )
