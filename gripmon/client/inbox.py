"""Messages received from the network: Zenoh's threads write, any number of other threads read without waiting."""

from __future__ import annotations

import logging
import math
import threading
import weakref
from collections.abc import Callable
from typing import NamedTuple, Protocol

from gripmon.client.age import NO_LEADS, Leads, Sent, steady_s, waited_s, with_answer, without_contradicted
from gripmon.client.network import MonitorName, Start
from gripmon.io.wire.malformed import REMEMBERED_S, Malformed
from gripmon.model.records import ClockReading, FrameRecord, MessageRefused, Verdict, from_json

_log = logging.getLogger(__name__)

PRESENT_KEPT = 16
"""Monitors whose names are kept: two are too many already, and a malicious sender may invent any number."""
HELD_BACK_S = 1.0
"""A transform of unknown age waits this long before it is passed on; meanwhile the monitor's clock is queried, and a
reply takes milliseconds."""
SENDS_S = 1.0
"""A monitor that sent a transform within this time is present, even if a router's rules block its liveliness token."""
_UNIT_TOLERANCE = 1e-3  # of a quaternion's length
CLOSED = "the client is closed"


def transform_message(payload: bytes) -> FrameRecord:
    """Decode and check a transform message; JSON ensures that all numbers are finite.

    Raises :class:`~gripmon.model.records.MessageRefused` for anything that is not a valid message or pose.
    """
    record = from_json(payload, FrameRecord)
    smoothed, bounds = record.smoothed, record.protection
    for pose in (record.cam_T_grip, smoothed, record.absolute):
        if pose is not None and not abs(math.hypot(*pose.rotation_xyzw) - 1.0) < _UNIT_TOLERANCE:
            raise MessageRefused("a transform that is not a pose")
    for covariance in (record.covariance, None if smoothed is None else smoothed.covariance):
        if covariance is not None and min(covariance[::7]) < 0.0:
            raise MessageRefused("a covariance with a variance below 0")
    if bounds is not None and not (min(bounds.position_m, bounds.rotation_rad) >= 0.0 and 0.0 < bounds.risk <= 1.0):
        raise MessageRefused("a protection level below 0, or a risk that is not within 0 and 1")
    for bound in (record.since_reference, record.absolute):
        if bound is not None and not min(bound.position_m, bound.rotation_rad) >= 0.0:
            raise MessageRefused("a protection level below 0")
    if record.verdict is not Verdict.UNKNOWN and (record.cam_T_grip is None or record.covariance is None):
        raise MessageRefused(f"verdict {record.verdict} without a transform and its covariance")
    for name in ("seq", "stamp_ns", "revision", "latency_ns"):
        if not 0 <= getattr(record, name) <= 2**63 - 1:
            raise MessageRefused(f"{name} is not within 0 and 2⁶³ - 1")
    return record


class Entry(NamedTuple):
    """A record, its sender, and its arrival by our steady clock; ``sent`` None: the monitor sends no clock."""

    record: FrameRecord
    monitor: MonitorName
    arrival_s: float
    sent: Sent | None = None

    @property
    def start(self) -> Start:
        return Start(self.monitor, self.record.monitor_id)


class Heard(NamedTuple):
    """The state from which readings are made; replaced as a whole, so that reading it needs no lock.

    ``present``: monitors that are there, by their tokens or because they send; ``cut``: the sender of ``entry`` has
    vanished since; ``unreadable``: what was wrong with the last message, if it was unreadable; ``closed``: why no more
    messages come, empty while they may; ``leads``: bounds of the monitors' clocks.  ``starts``: the processes of these
    monitors, by their tokens; ``senders``: when each was last heard; ``elsewhere``: other monitors on the network.
    """

    entry: Entry | None = None
    present: frozenset[MonitorName] = frozenset()
    cut: bool = False
    unreadable: str = ""
    closed: str = ""
    leads: Leads = NO_LEADS
    starts: frozenset[Start] = frozenset()
    senders: tuple[tuple[Start, float], ...] = ()
    elsewhere: frozenset[MonitorName] = frozenset()


class Waiter(Protocol):
    """An iterator that waits for messages; neither method may block."""

    def put(self, entry: Entry) -> None: ...
    def wake(self) -> None: ...


class Inbox:
    """The newest message, the monitors present, and the iterators that wait for the next message."""

    def __init__(self, key: str = "") -> None:
        """``key`` of the messages, for the log."""
        self.heard = Heard()
        self._malformed = Malformed("transform", key)
        self._lock = threading.Lock()  # for writers
        self._held: Entry | None = None
        self._held_since_s: float | None = None
        self._several_said_s = -math.inf
        self._waiters: weakref.WeakSet[Waiter] = weakref.WeakSet()  # a released iterator gets no more messages

    @property
    def unreadable(self) -> int:
        """How many messages could not be read."""
        return self._malformed.count

    def take(self, monitor: MonitorName, payload: bytes, arrival_s: float, sent: Sent | None = None) -> None:
        """A message arrived."""
        try:
            entry = Entry(transform_message(payload), monitor, arrival_s, sent)
        except MessageRefused as error:
            self._malformed.add(f"from {monitor}, {error}")
            with self._lock:
                self._set(unreadable=str(error))
            return
        self._malformed.good()
        with self._lock:
            leads = self.heard.leads if sent is None else without_contradicted(self.heard.leads, sent)
            present, senders = self._present_with(monitor), _with_sender(self.heard.senders, entry)
            self._set(entry=entry, present=present, cut=False, unreadable="", leads=leads, senders=senders)
            self._say_if_several()
            self._hand_over(entry)

    def answered(self, answer: ClockReading, asked_ns: int, answered_ns: int) -> None:
        """A monitor replied with its clock's reading; both times are of our steady clock."""
        with self._lock:
            self._set(leads=with_answer(self.heard.leads, answer, asked_ns, answered_ns))
            held, self._held = self._held, None
            if held is not None:
                self._hand_over(held)

    @property
    def age_known(self) -> bool:
        """Whether the age of the newest transform is known."""
        heard = self.heard
        return heard.entry is not None and waited_s(heard.leads, heard.entry.sent) is not None

    def appeared(self, monitor: MonitorName) -> None:
        """Its liveliness token is there."""
        with self._lock:
            self._set(present=self._present_with(monitor))
            self._say_if_several()
            self._wake()

    def vanished(self, monitor: MonitorName) -> None:
        """Its liveliness token is gone: it ended, was killed, or the connection to it was lost."""
        with self._lock:
            self._cut_off(lambda start: start.monitor == monitor, present=self.heard.present - {monitor})

    def started(self, start: Start) -> None:
        """The token of this start has appeared."""
        with self._lock:
            if len(self.heard.starts) < PRESENT_KEPT:
                self._set(starts=self.heard.starts | {start})
            self._say_if_several()
            self._wake()

    def ended(self, start: Start) -> None:
        """The token of this start is gone; another process may use the same name."""
        with self._lock:
            self._cut_off(lambda one: one == start, starts=self.heard.starts - {start})

    def found(self, monitor: MonitorName) -> None:
        """A monitor was found on the network, whether it is the wanted one or not."""
        with self._lock:
            if len(self.heard.elsewhere) < PRESENT_KEPT:
                self._set(elsewhere=self.heard.elsewhere | {monitor})

    def close(self, why: str = CLOSED) -> None:
        """Stop: no more messages will come."""
        with self._lock:
            self._set(closed=self.heard.closed or why)
            self._wake()

    def after_fork(self, why: str) -> None:
        """In the child: the lock may be held by a thread that isn't there, and nobody waits."""
        self._lock = threading.Lock()
        self._waiters = weakref.WeakSet()
        self.close(why)

    def join(self, waiter: Waiter) -> None:
        """Pass every message from now on to ``waiter``, as long as it is referenced elsewhere."""
        with self._lock:
            self._waiters.add(waiter)

    def _hand_over(self, entry: Entry) -> None:
        """Pass a message to the waiters; one of unknown age is held back for :data:`HELD_BACK_S` at most."""
        self._held = None
        if entry.sent is None or waited_s(self.heard.leads, entry.sent) is not None:
            self._held_since_s = None
        else:
            if self._held_since_s is None:
                self._held_since_s = entry.arrival_s
            if entry.arrival_s - self._held_since_s < HELD_BACK_S:
                self._held = entry
                return
        for waiter in self._waiters:
            waiter.put(entry)

    def _present_with(self, monitor: MonitorName) -> frozenset[MonitorName]:
        present = self.heard.present
        return present if len(present) >= PRESENT_KEPT else present | {monitor}

    def _set(self, **changes: object) -> None:
        self.heard = self.heard._replace(**changes)  # type: ignore[arg-type]

    def _cut_off(self, gone: Callable[[Start], bool], **changes: object) -> None:
        """Remove the starts for which ``gone`` is true, and apply ``changes``."""
        entry = self.heard.entry
        cut = self.heard.cut or (entry is not None and gone(entry.start))
        senders = tuple(sender for sender in self.heard.senders if not gone(sender[0]))
        self._set(cut=cut, senders=senders, **changes)
        self._wake()

    def _say_if_several(self) -> None:
        """Log it if tokens or names show it, but not again and again: any sender on the network may cause it."""
        if steady_s() - self._several_said_s > REMEMBERED_S and (text := several(self.heard, math.inf)):
            self._several_said_s = steady_s()
            _log.error("%s", text)

    def _wake(self) -> None:
        for waiter in self._waiters:
            waiter.wake()


def several(heard: Heard, at_s: float) -> str:
    """A message if more than one monitor is present at ``at_s`` of our steady clock; empty otherwise."""
    if len(heard.present) > 1:  # the camera was not named
        names = ", ".join(map(str, sorted(heard.present)))
        return f"more than one monitor is there: {names}; name the camera"
    starts = heard.starts.union(start for start, sent_s in heard.senders if at_s - sent_s < SENDS_S)
    if len(starts) < 2:
        return ""
    return f"more than one monitor has the same name: {', '.join(map(str, sorted(starts)))}; stop all but one"


def _with_sender(senders: tuple[tuple[Start, float], ...], entry: Entry) -> tuple[tuple[Start, float], ...]:
    """With the sender of ``entry``, and without silent ones."""
    start, at_s = entry.start, entry.arrival_s
    others = tuple(sender for sender in senders if sender[0] != start and at_s - sender[1] < SENDS_S)
    return (*others[1 - PRESENT_KEPT :], (start, at_s))
