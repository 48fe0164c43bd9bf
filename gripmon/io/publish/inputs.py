"""The robot's report on the network: its jaw opening."""

from __future__ import annotations

import bisect
import logging
import threading
import time
from collections.abc import Callable
from typing import NamedTuple

import msgspec
import zenoh

from gripmon.io.ros2.node import JointOpening, MessageError, decode_joint_state, opening_between
from gripmon.io.wire import Link, in_zenohs_thread
from gripmon.io.wire.link import Malformed
from gripmon.model.errors import in_short
from gripmon.model.records import JawReading, MessageRefused, from_json, largest_bytes

_log = logging.getLogger(__name__)

LARGEST_OPENING_M = 0.5
"""Largest opening that a gripper file allows, m."""

BEYOND_TRAVEL_M = 1e-3
"""How far a reported opening may lie beyond the gripper's travel, m; the monitor rejects frames with more."""

MOST_REPORTS = 2048
"""Number of reports kept, for images older than the newest report: two seconds at 1 kHz."""


class ReportedOpening(NamedTuple):
    """An opening, and when the robot measured it (Unix ns; 0 if unknown)."""

    stamp_ns: int
    opening_m: float


DecodeOpening = Callable[[bytes], ReportedOpening | None]
"""Decodes an opening from a payload; None if the message is about something else.  Raises :class:`JawError`."""


class JawError(ValueError):
    """A payload that contains no jaw opening; the text says why, in one line."""


class StampedOpenings:
    """Reports in order of their stamps, for interpolating the opening at a given time."""

    def __init__(self) -> None:
        self._reports: list[tuple[ReportedOpening, float]] = []

    def __len__(self) -> int:
        return len(self._reports)

    def add(self, report: ReportedOpening, arrival_s: float, max_age_s: float) -> None:
        """Keep a report; drop those that arrived more than ``max_age_s`` before it (``arrival_s``: monotonic), and all
        reports if the robot's clock was set back by more than that.
        """
        reports = self._reports
        if reports and 1e-9 * (reports[-1][0].stamp_ns - report.stamp_ns) > max_age_s:
            reports.clear()
        while reports and (len(reports) >= MOST_REPORTS or arrival_s - reports[0][1] > max_age_s):
            del reports[0]
        bisect.insort(reports, (report, arrival_s), key=lambda kept: kept[0].stamp_ns)

    def clear(self) -> None:
        self._reports.clear()

    def apart_s(self, stamp_ns: int) -> float:
        """Stamp of the newest report minus ``stamp_ns``, s."""
        return 1e-9 * (self._reports[-1][0].stamp_ns - stamp_ns)

    def at(self, stamp_ns: int) -> float:
        """The opening (m), interpolated linearly between the reports before and after; outside all reports, the opening
        of the nearest one (no extrapolation).
        """
        after = bisect.bisect_left(self._reports, stamp_ns, key=lambda kept: kept[0].stamp_ns)
        if after in (0, len(self._reports)):
            return self._reports[min(after, len(self._reports) - 1)][0].opening_m
        (first, _), (last, _) = self._reports[after - 1 : after + 1]
        return opening_between((first.stamp_ns, first.opening_m), (last.stamp_ns, last.opening_m), stamp_ns)


class _Input:
    """Messages on a key: Zenoh's thread stores them, any thread may read.  Malformed messages are counted."""

    def __init__(self, link: Link, key: str, what: str) -> None:
        self._malformed = Malformed(what, key)
        self._key = key
        self._subscriber: zenoh.Subscriber[None] | None = None
        link.attach(self._attach)

    @property
    def malformed(self) -> int:
        """Number of malformed messages so far."""
        return self._malformed.count

    def _attach(self, session: zenoh.Session) -> None:
        self._subscriber = session.declare_subscriber(self._key, in_zenohs_thread(self._arrived))

    def _arrived(self, sample: zenoh.Sample) -> None:
        if sample.kind != zenoh.SampleKind.PUT:
            return
        try:
            if self._take(sample.payload):
                self._malformed.good()
        except (MessageRefused, ValueError) as error:
            self._malformed.add(str(error))
        except Exception as error:  # noqa: BLE001  Zenoh would swallow it, and it would stay unknown
            self._malformed.add(in_short(error))
            _log.debug("message on %s", self._key, exc_info=error)

    def _take(self, payload: zenoh.ZBytes) -> bool:
        """Store a message; False if it is about something else.  ValueError if it is malformed."""
        raise NotImplementedError


class ZenohJaw(_Input):
    """The jaw opening that the robot sends: interpolated at an image's stamp if the reports have stamps of the same
    clock, else the newest.

    Age counts from arrival, so that the robot's clock need not agree with ours.  Zenoh's thread stores what arrives;
    any thread may read.  A malformed message, or an opening that this gripper can't have, is counted and reported; the
    previous opening stays in use until it is too old.
    """

    def __init__(
        self,
        link: Link,
        key: str,
        decode: DecodeOpening | None = None,
        *,
        travel_m: tuple[float, float] = (0.0, LARGEST_OPENING_M),
    ) -> None:
        """``decode`` reads payloads, by default :func:`opening_of_json`; ``travel_m``: smallest and largest opening.

        A reading older than the link's ``jaw_max_age_s`` is not used.
        """
        self._decode = decode or opening_of_json
        self._travel_m = travel_m
        self._max_age_s = link.settings.jaw_max_age_s
        self._lock = threading.Lock()  # guards the attributes below against Zenoh's thread
        self._newest_m: float | None = None
        self._arrival_s = 0.0
        self._stamped = StampedOpenings()
        self._apart_s: float | None = None  # reports' stamps minus the images', if their clocks differ
        super().__init__(link, key, "jaw message")

    def opening_m(self, stamp_ns: int | None = None) -> float | None:
        """The opening at an image's stamp, or the newest (m); None if none arrived within ``jaw_max_age_s``.

        Stamps farther apart than that come from different clocks: it then returns the newest; :meth:`fault` says so.
        """
        with self._lock:
            if self._newest_m is None or self._is_old():
                return None
            self._apart_s = None
            if stamp_ns is None or not len(self._stamped):
                return self._newest_m
            apart_s = self._stamped.apart_s(stamp_ns)
            if abs(apart_s) > self._max_age_s:
                self._apart_s = apart_s
                return self._newest_m
            return self._stamped.at(stamp_ns)

    def fault(self) -> str:
        """What is wrong with the readings, in a few words for a person; empty if nothing is."""
        missing = ""
        with self._lock:
            if self._newest_m is None:
                missing = "no jaw opening received"
            elif self._is_old():
                missing = f"no jaw opening for {self._max_age_s:g} s or longer"
            elif self._apart_s is not None:
                when = "later" if self._apart_s > 0.0 else "earlier"
                missing = (
                    f"jaw openings have stamps {abs(self._apart_s):.3g} s {when} than the images: the newest is taken"
                )
        return ", ".join(fault for fault in (missing, self._malformed.fault()) if fault)

    def _is_old(self) -> bool:
        return time.monotonic() - self._arrival_s > self._max_age_s

    def _take(self, payload: zenoh.ZBytes) -> bool:
        arrival_s = time.monotonic()
        reported = self._decode(_bounded(payload))
        if reported is None:
            return False
        self._check(reported.opening_m)
        with self._lock:
            self._newest_m, self._arrival_s = reported.opening_m, arrival_s
            if reported.stamp_ns > 0:
                self._stamped.add(reported, arrival_s, self._max_age_s)
            else:
                self._stamped.clear()  # a robot stamps either all its reports or none
        return True

    def _check(self, opening_m: float) -> None:
        low_m, high_m = self._travel_m
        # Written so that NaN fails as well.
        if not low_m - BEYOND_TRAVEL_M <= opening_m <= high_m + BEYOND_TRAVEL_M:
            raise JawError(f"opening {opening_m:g} m; {low_m:g} to {high_m:g} m as the gripper file says")


LARGEST_BYTES = 1 << 18
"""Largest payload accepted: a JointState of some thousand joints."""


def _bounded(payload: zenoh.ZBytes) -> bytes:
    if len(payload) > LARGEST_BYTES:
        raise JawError(f"{len(payload)} bytes; at most {LARGEST_BYTES}")
    return payload.to_bytes()


def opening_of_json(payload: bytes) -> ReportedOpening:
    """Decode ``{"stamp_ns": …, "opening_m": …}``, or a bare number (m).  Raises :class:`JawError`."""
    try:
        if payload[:64].lstrip()[:1] == b"{":
            reading = from_json(payload, JawReading)
            return ReportedOpening(reading.stamp_ns, reading.opening_m)
        if len(payload) > largest_bytes(JawReading):
            raise JawError(f"{len(payload)} bytes; a number, or at most {largest_bytes(JawReading)} bytes of JSON")
        return ReportedOpening(0, _decode_number(payload))
    except MessageRefused as error:
        raise JawError(str(error)) from None
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise JawError(f'{error}; a number of metres, or {{"stamp_ns": …, "opening_m": …}}') from None


def opening_of_joints(joints: JointOpening) -> DecodeOpening:
    """Return a decoder of ``sensor_msgs/JointState`` (CDR); it ignores messages that are only about other joints."""

    def decode(payload: bytes) -> ReportedOpening | None:
        try:
            stamp_ns, positions = decode_joint_state(payload)
            opening_m = joints.opening_m(positions)
            return None if opening_m is None else ReportedOpening(stamp_ns, opening_m)
        except MessageError as error:
            raise JawError(str(error)) from None

    return decode


_decode_number = msgspec.json.Decoder(float).decode


_WAITING_MOST = 64
