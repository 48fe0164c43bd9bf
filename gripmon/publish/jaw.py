"""The robot's jaw opening, heard on the network."""

from __future__ import annotations

import logging
import time

import msgspec
import zenoh

_log = logging.getLogger(__name__)
_JAW_READINGS_KEPT = 64  # between two frames; the newest win


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
