"""What came from the network: Zenoh's threads write, any number of others read without waiting."""

from __future__ import annotations

import logging
import threading
import weakref
from collections.abc import Callable
from typing import NamedTuple, Protocol

from gripmon.client.age import NO_LEADS, Leads, Sent, waited_s, with_answer, without_contradicted
from gripmon.client.message import transform_message
from gripmon.client.names import MonitorName, Start
from gripmon.model.records import ClockReading, FrameRecord, MessageRefused

_log = logging.getLogger(__name__)

MOST_PRESENT = 16
"""Names of more monitors are not kept: two are too many already, and a stranger may make up any number."""


HELD_BACK_S = 1.0
"""So long a transform of which it isn't known how old it is waits for that, before those who wait for one are told.
The monitor is asked meanwhile; an answer takes milliseconds."""
SENDS_S = 1.0
"""Who sent a transform within that time is there, also where a router's rules let no token of its start through."""


class Entry(NamedTuple):
    """A record, who sent it, and when it arrived by the monotonic clock; ``sent`` None: the monitor doesn't say."""

    record: FrameRecord
    monitor: MonitorName
    arrival_s: float
    sent: Sent | None = None

    @property
    def start(self) -> Start:
        return Start(self.monitor, self.record.monitor_id)


class Heard(NamedTuple):
    """What readings are made from; replaced as a whole, so that who reads it needs no lock.

    ``present``: the monitors that are there, by their tokens or because they send; ``cut``: the sender of ``entry``
    vanished since; ``unreadable``: what was wrong with the last message, if it could not be read; ``leads``: what is
    known of the monitors' clocks.  ``starts``: by their tokens, which processes these monitors are; ``senders``: when
    each that sends was heard last; ``elsewhere``: other monitors on the network, where somebody has looked for them.
    """

    entry: Entry | None = None
    present: frozenset[MonitorName] = frozenset()
    cut: bool = False
    unreadable: str = ""
    closed: bool = False
    leads: Leads = NO_LEADS
    starts: frozenset[Start] = frozenset()
    senders: tuple[tuple[Start, float], ...] = ()
    elsewhere: frozenset[MonitorName] = frozenset()


class Waiter(Protocol):
    """Somebody who waits for news; neither method may wait itself."""

    def put(self, entry: Entry) -> None: ...
    def wake(self) -> None: ...


class Inbox:
    """The newest message, who is there, and who wants to be told."""

    def __init__(self) -> None:
        self.heard = Heard()
        self.unreadable = 0
        self._lock = threading.Lock()  # for those who write
        self._held: Entry | None = None
        self._held_since_s: float | None = None
        self._waiters: weakref.WeakSet[Waiter] = weakref.WeakSet()  # an iterator that is let go is told no more

    def take(self, monitor: MonitorName, payload: bytes, arrival_s: float, sent: Sent | None = None) -> None:
        """A message arrived."""
        try:
            entry = Entry(transform_message(payload), monitor, arrival_s, sent)
        except MessageRefused as error:
            self._refuse(monitor, str(error))
            return
        with self._lock:
            leads = self.heard.leads if sent is None else without_contradicted(self.heard.leads, sent)
            self._set(
                entry=entry,
                present=self._present_with(monitor),
                cut=False,
                unreadable="",
                leads=leads,
                senders=_with_sender(self.heard.senders, entry),
            )
            self._hand_over(entry)

    def answered(self, answer: ClockReading, asked_ns: int, answered_ns: int) -> None:
        """A monitor said what its clock shows; both times by our steady clock."""
        with self._lock:
            self._set(leads=with_answer(self.heard.leads, answer, asked_ns, answered_ns))
            held, self._held = self._held, None
            if held is not None:
                self._hand_over(held)

    @property
    def age_known(self) -> bool:
        """Is it known how old the newest transform is?"""
        heard = self.heard
        return heard.entry is not None and waited_s(heard.leads, heard.entry.sent) is not None

    def appeared(self, monitor: MonitorName) -> None:
        """Its liveliness token is there."""
        with self._lock:
            self._set(present=self._present_with(monitor))
            self._wake()

    def vanished(self, monitor: MonitorName) -> None:
        """Its liveliness token is gone: it ended, was killed, or the way to it is cut."""
        with self._lock:
            self._cut_off(lambda start: start.monitor == monitor, present=self.heard.present - {monitor})

    def started(self, start: Start) -> None:
        """The token of this start is there."""
        with self._lock:
            if len(self.heard.starts) < MOST_PRESENT:
                self._set(starts=self.heard.starts | {start})
            self._wake()

    def ended(self, start: Start) -> None:
        """It is gone; another process may speak under the same name."""
        with self._lock:
            self._cut_off(lambda one: one == start, starts=self.heard.starts - {start})

    def found(self, monitor: MonitorName) -> None:
        """It is on the network, whether it is the one that is meant or not."""
        with self._lock:
            if len(self.heard.elsewhere) < MOST_PRESENT:
                self._set(elsewhere=self.heard.elsewhere | {monitor})

    def close(self) -> None:
        """No more will come."""
        with self._lock:
            self._set(closed=True)
            self._wake()

    def join(self, waiter: Waiter) -> None:
        """Tell it from now on, as long as somebody else refers to it."""
        with self._lock:
            self._waiters.add(waiter)

    def _hand_over(self, entry: Entry) -> None:
        """Give it to those who wait; one of which it isn't known how old it is only when that takes too long."""
        if entry.sent is not None and waited_s(self.heard.leads, entry.sent) is None:
            if self._held_since_s is None:
                self._held_since_s = entry.arrival_s
            if entry.arrival_s - self._held_since_s < HELD_BACK_S:
                self._held = entry
                return
        else:
            self._held_since_s = None
        self._held = None
        for waiter in self._waiters:
            waiter.put(entry)

    def _refuse(self, monitor: MonitorName, text: str) -> None:
        with self._lock:
            self.unreadable += 1
            if self.heard.unreadable != text:  # said once, and again when it is something else or was over
                _log.warning("%s: a transform message can't be read: %s", monitor, text)
                self._set(unreadable=text)

    def _present_with(self, monitor: MonitorName) -> frozenset[MonitorName]:
        present = self.heard.present
        return present if len(present) >= MOST_PRESENT else present | {monitor}

    def _set(self, **changes: object) -> None:
        before = self.heard
        self.heard = before._replace(**changes)  # type: ignore[arg-type]
        if len(self.heard.present) > 1 >= len(before.present) or len(self.heard.starts) > 1 >= len(before.starts):
            _log.error("%s", several(self.heard, 0.0))

    def _cut_off(self, gone: Callable[[Start], bool], **changes: object) -> None:
        """These starts are gone, with what else that changes."""
        entry = self.heard.entry
        cut = self.heard.cut or (entry is not None and gone(entry.start))
        senders = tuple(sender for sender in self.heard.senders if not gone(sender[0]))
        self._set(cut=cut, senders=senders, **changes)
        self._wake()

    def _wake(self) -> None:
        for waiter in self._waiters:
            waiter.wake()


def several(heard: Heard, now_s: float) -> str:
    """What to say where more than one monitor is there at ``now_s``; empty if there is one at most."""
    if len(heard.present) > 1:  # the camera isn't named
        names = ", ".join(map(str, sorted(heard.present)))
        return f"more than one monitor is there: {names}; name the camera"
    starts = heard.starts.union(start for start, sent_s in heard.senders if now_s - sent_s < SENDS_S)
    if len(starts) < 2:
        return ""
    return f"more than one monitor has the same name: {', '.join(map(str, sorted(starts)))}; stop all but one"


def _with_sender(senders: tuple[tuple[Start, float], ...], entry: Entry) -> tuple[tuple[Start, float], ...]:
    """With who sent just now, and without those that are silent."""
    start, now_s = entry.start, entry.arrival_s
    others = tuple(sender for sender in senders if sender[0] != start and now_s - sender[1] < SENDS_S)
    return (*others[1 - MOST_PRESENT :], (start, now_s))
