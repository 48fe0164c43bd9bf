"""The robot's reports on the network: its jaw opening."""

from __future__ import annotations

import logging

import msgspec
import zenoh

from gripmon.io.jaw import LARGEST_OPENING_M, Openings, ReportedOpening
from gripmon.io.wire import Link, in_zenohs_thread
from gripmon.io.wire.malformed import Malformed
from gripmon.model.errors import in_short
from gripmon.model.jaw import JawError
from gripmon.model.records import JawReading, MessageRefused, from_json, largest_bytes

_log = logging.getLogger(__name__)


class ZenohJaw:
    """The jaw opening that the robot sends on a key: Zenoh's thread stores what arrives, any thread may read.

    A malformed message, or an opening that this gripper can't have, is counted and reported; the previous opening stays
    in use until it is too old.
    """

    def __init__(self, link: Link, key: str, *, travel_m: tuple[float, float] = (0.0, LARGEST_OPENING_M)) -> None:
        """``travel_m``: smallest and largest opening.  A reading older than the link's ``jaw_max_age_s`` isn't used."""
        self._malformed = Malformed("jaw message", key)
        self._openings = Openings(travel_m, link.settings.jaw_max_age_s)
        self.opening_m = self._openings.opening_m
        self._key = key
        self._subscriber: zenoh.Subscriber[None] | None = None
        link.attach(self._attach)

    @property
    def malformed(self) -> int:
        """Number of malformed messages so far."""
        return self._malformed.count

    def fault(self) -> str:
        """What is wrong with the readings, in a few words for a person; empty if nothing is."""
        return ", ".join(fault for fault in (self._openings.fault(), self._malformed.fault()) if fault)

    def _attach(self, session: zenoh.Session) -> None:
        self._subscriber = session.declare_subscriber(self._key, in_zenohs_thread(self._arrived))

    def _arrived(self, sample: zenoh.Sample) -> None:
        if sample.kind != zenoh.SampleKind.PUT:
            return
        try:
            if len(sample.payload) > (most := largest_bytes(JawReading)):  # before a copy of it is made
                raise JawError(f"{len(sample.payload)} bytes; a number, or at most {most} bytes of JSON")
            self._openings.take(opening_of_json(sample.payload.to_bytes()))
            self._malformed.good()
        except ValueError as error:
            self._malformed.add(str(error))
        except Exception as error:  # noqa: BLE001  Zenoh would swallow it, and it would stay unknown
            self._malformed.add(in_short(error))
            _log.debug("message on %s", self._key, exc_info=error)


def opening_of_json(payload: bytes) -> ReportedOpening:
    """Decode ``{"stamp_ns": …, "opening_m": …}``, or a bare number (m).  Raises :class:`JawError`."""
    try:
        if payload[:64].lstrip()[:1] == b"{":
            reading = from_json(payload, JawReading)
            return ReportedOpening(reading.stamp_ns, reading.opening_m)
        return ReportedOpening(0, _decode_number(payload))
    except MessageRefused as error:
        raise JawError(str(error)) from None
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise JawError(f'{error}; a number of metres, or {{"stamp_ns": …, "opening_m": …}}') from None


_decode_number = msgspec.json.Decoder(float).decode
