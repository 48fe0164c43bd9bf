"""The robot's jaw opening, heard on the network."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import msgspec
import zenoh

from gripmon.records import JawReading, MessageRefused, from_json, largest_bytes
from gripmon.ros2 import JointOpening, MessageError, decode_joint_state
from gripmon.wire import Link
from gripmon.wire.malformed import Malformed

LARGEST_OPENING_M = 0.5
"""No gripper file allows more."""

BEYOND_TRAVEL_M = 1e-3
"""So far beyond its travel a gripper may report to be; the monitor refuses frames with more."""

DecodeOpening = Callable[[bytes], float | None]
"""An opening (m) from a payload; None if the message is about something else.  Raises :class:`JawError`."""


class JawError(ValueError):
    """A payload that tells no jaw opening; the text says why, in one line."""


class ZenohJaw:
    """The newest jaw opening that the robot sent.

    Age counts from arrival, so that the robot's clock need not agree with ours.  Zenoh's thread stores what arrives;
    any thread may ask.  What is malformed, or no opening that this gripper can have, is counted and said; the one
    before it stays in force until it is too old.
    """

    def __init__(
        self,
        link: Link,
        key: str,
        decode: DecodeOpening | None = None,
        *,
        travel_m: tuple[float, float] = (0.0, LARGEST_OPENING_M),
    ) -> None:
        """Reads ``key``, by default :func:`opening_of_json`; ``travel_m``: smallest and largest opening of the gripper.

        A reading older than the link's ``jaw_max_age_s`` is not used.
        """
        self._decode = decode or opening_of_json
        self._travel_m = travel_m
        self._key = key
        self._max_age_s = link.settings.jaw_max_age_s
        self._subscriber: zenoh.Subscriber[None] | None = None
        self._malformed = Malformed("jaw message", key)
        self._lock = threading.Lock()  # guards what follows against Zenoh's thread
        self._newest_m: float | None = None
        self._arrival_s = 0.0
        link.attach(self._attach)

    @property
    def malformed(self) -> int:
        """Messages so far that told no opening."""
        return self._malformed.count

    def opening_m(self) -> float | None:
        """The newest opening, m; None if none came, or none for ``jaw_max_age_s``."""
        with self._lock:
            return None if self._newest_m is None or self._is_old() else self._newest_m

    def fault(self) -> str:
        """What is wrong with the readings, in a few words for a person; empty if nothing is."""
        missing = ""
        with self._lock:
            if self._newest_m is None:
                missing = "no jaw opening received"
            elif self._is_old():
                missing = f"no jaw opening for {self._max_age_s:g} s or longer"
        return ", ".join(fault for fault in (missing, self._malformed.fault()) if fault)

    def _is_old(self) -> bool:
        return time.monotonic() - self._arrival_s > self._max_age_s

    def _attach(self, session: zenoh.Session) -> None:
        # In Zenoh's own thread: one of Python's would keep a process that forgot close() from ending.
        self._subscriber = session.declare_subscriber(self._key, zenoh.handlers.Callback(self._receive, indirect=False))

    def _receive(self, sample: zenoh.Sample) -> None:
        if sample.kind != zenoh.SampleKind.PUT:
            return
        arrival_s = time.monotonic()
        try:
            opening_m = self._decode(_bounded(sample.payload))
            if opening_m is None:
                return
            self._check(opening_m)
        except JawError as error:
            self._malformed.add(str(error))
            return
        self._malformed.good()
        with self._lock:
            self._newest_m, self._arrival_s = opening_m, arrival_s

    def _check(self, opening_m: float) -> None:
        low_m, high_m = self._travel_m
        # Written so that NaN fails, too.
        if not low_m - BEYOND_TRAVEL_M <= opening_m <= high_m + BEYOND_TRAVEL_M:
            raise JawError(f"opening {opening_m:g} m; {low_m:g} to {high_m:g} m as the gripper file says")


LARGEST_BYTES = 1 << 18
"""A JointState of some thousand joints."""


def _bounded(payload: zenoh.ZBytes) -> bytes:
    if len(payload) > LARGEST_BYTES:
        raise JawError(f"{len(payload)} bytes; at most {LARGEST_BYTES}")
    return payload.to_bytes()


def opening_of_json(payload: bytes) -> float:
    """An opening from ``{"stamp_ns": …, "opening_m": …}``, or from a number alone (m).  Raises :class:`JawError`."""
    try:
        if payload[:64].lstrip()[:1] == b"{":
            return from_json(payload, JawReading).opening_m
        if len(payload) > largest_bytes(JawReading):
            raise JawError(f"{len(payload)} bytes; a number, or at most {largest_bytes(JawReading)} bytes of JSON")
        return _decode_number(payload)
    except MessageRefused as error:
        raise JawError(str(error)) from None
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise JawError(f'{error}; a number of metres, or {{"stamp_ns": …, "opening_m": …}}') from None


def opening_of_joints(joints: JointOpening) -> DecodeOpening:
    """A decoder of ``sensor_msgs/JointState`` (CDR); messages about other joints only are passed over."""

    def decode(payload: bytes) -> float | None:
        try:
            return joints.opening_m(decode_joint_state(payload)[1])
        except MessageError as error:
            raise JawError(str(error)) from None

    return decode


_decode_number = msgspec.json.Decoder(float).decode
