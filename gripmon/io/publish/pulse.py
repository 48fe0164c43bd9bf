"""The laser's pulses, as the robot's program tells them on the network."""

from __future__ import annotations

import logging
from collections import deque

import zenoh

from gripmon.io.wire import Link
from gripmon.io.wire.malformed import Malformed
from gripmon.laser.matching import Told, of_message
from gripmon.model.records import LaserPulse, MessageRefused, from_json, largest_bytes

_log = logging.getLogger(__name__)
_WAITING_MOST = 64


class ZenohPulses:
    """Pulses in the order in which they came.

    Zenoh's thread stores what arrives; any thread may ask.  What is malformed, or no pulse that can be, is counted and
    said.  Pulses that nobody asks for, more than 64 of them, give way to newer ones.
    """

    def __init__(self, link: Link, key: str) -> None:
        self._key = key
        self._waiting: deque[Told] = deque(maxlen=_WAITING_MOST)
        self._malformed = Malformed("pulse message", key)
        self._subscriber: zenoh.Subscriber[None] | None = None
        link.attach(self._attach)

    @property
    def malformed(self) -> int:
        """Messages so far that told no pulse."""
        return self._malformed.count

    def poll(self) -> Told | None:
        """The next pulse, at once; None if there is none."""
        return self._waiting.popleft() if self._waiting else None

    def fault(self) -> str:
        """What is wrong with what came, in a few words for a person; empty if nothing is."""
        return self._malformed.fault()

    def _attach(self, session: zenoh.Session) -> None:
        # In Zenoh's own thread: one of Python's would keep a process that forgot close() from ending.
        self._subscriber = session.declare_subscriber(self._key, zenoh.handlers.Callback(self._receive, indirect=False))

    def _receive(self, sample: zenoh.Sample) -> None:
        if sample.kind != zenoh.SampleKind.PUT:
            return
        try:
            told = _told(sample.payload)
        except (MessageRefused, ValueError) as error:
            self._malformed.add(str(error))
            return
        except Exception as error:  # noqa: BLE001  Zenoh would swallow it, and nobody learn of it
            self._malformed.add(f"{type(error).__name__}: {error}")
            _log.debug("pulse on %s", self._key, exc_info=error)
            return
        self._malformed.good()
        self._waiting.append(told)


def _told(payload: zenoh.ZBytes) -> Told:
    if len(payload) > (most := largest_bytes(LaserPulse)):  # before a copy of it is made
        raise MessageRefused(f"{len(payload)} bytes; at most {most}")
    return of_message(from_json(payload.to_bytes(), LaserPulse))
