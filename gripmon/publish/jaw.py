"""The robot's jaw opening, heard on the network."""

from __future__ import annotations

import logging
import threading
import time

import zenoh

from gripmon.records import JawReading, MessageRefused, from_json
from gripmon.wire import Link

_log = logging.getLogger(__name__)


class ZenohJaw:
    """The newest jaw opening that the robot sent.

    Age counts from arrival, so that the robot's clock need not agree with ours.  Zenoh's thread stores what arrives;
    any thread may ask.
    """

    def __init__(self, link: Link, key: str) -> None:
        """Reads ``key``; a reading older than the link's ``jaw_max_age_s`` is not used."""
        self.malformed = 0
        self._key = key
        self._max_age_s = link.settings.jaw_max_age_s
        self._subscriber: zenoh.Subscriber[None] | None = None
        self._lock = threading.Lock()  # guards what follows, and `malformed`, against Zenoh's thread
        self._newest: JawReading | None = None
        self._arrival_s = 0.0
        link.attach(self._attach)

    def opening_m(self) -> float | None:
        """The newest opening, m; None if none came, or none for ``jaw_max_age_s``."""
        with self._lock:
            return None if self._newest is None or self._is_old() else self._newest.opening_m

    def fault(self) -> str:
        """What is wrong with the readings, in a few words for a person; empty if nothing is."""
        faults = []
        with self._lock:
            if self._newest is None:
                faults.append("no jaw opening received")
            elif self._is_old():
                faults.append(f"no jaw opening for {self._max_age_s:g} s or longer")
            if self.malformed:
                faults.append(f"{self.malformed} malformed jaw message{'s' * (self.malformed > 1)}")
        return ", ".join(faults)

    def _is_old(self) -> bool:
        return time.monotonic() - self._arrival_s > self._max_age_s

    def _attach(self, session: zenoh.Session) -> None:
        # In Zenoh's own thread: one of Python's would keep a process that forgot close() from ending.
        self._subscriber = session.declare_subscriber(self._key, zenoh.handlers.Callback(self._receive, indirect=False))

    def _receive(self, sample: zenoh.Sample) -> None:
        arrival_s = time.monotonic()
        try:
            reading = from_json(sample.payload.to_bytes(), JawReading)
        except MessageRefused as error:
            with self._lock:
                self.malformed += 1
                first = self.malformed == 1
            if first:
                _log.warning("malformed message on %s: %s", sample.key_expr, error)
            return
        with self._lock:
            self._newest, self._arrival_s = reading, arrival_s
