"""A camera on the network: the newest frame that its driver put on a Zenoh key, and how late it is."""

from __future__ import annotations

import logging
import threading
import time
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import msgspec

from gripmon.io.sources.base import READ_TIMEOUT_S, Waiting
from gripmon.io.sources.payload import (
    PayloadError,
    WrongSizeError,
    file_image,
    raw_image,
    read_note,
)
from gripmon.io.wire import MOST_DRIFT, Link, in_zenohs_thread
from gripmon.io.wire.link import Malformed
from gripmon.io.wire.session import KEY_PATTERN
from gripmon.model.images import JPEG, PNG
from gripmon.model.records import Frame, FrameNote, Image, Refusal, largest_bytes

if TYPE_CHECKING:
    import zenoh

_log = logging.getLogger(__name__)

FILES = {"jpeg": JPEG, "png": PNG}
_PADDING_BYTES = 1 << 20
_MOST_PIXEL_BYTES = 8  # no encoding has more
LARGEST_ATTACHMENT_BYTES = largest_bytes(FrameNote)

Format = Literal["auto", "raw", "jpeg", "png"]


SilentAfter = Annotated[
    float,
    msgspec.Meta(gt=0.0, le=3600.0, description="time without a frame after which the camera counts as lost (s)"),
]


class NetworkSettings(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="kind", tag="zenoh"
):
    """A camera whose driver publishes its frames; ``docs/howto/network_camera.md`` describes the protocol."""

    key: (
        Annotated[
            str,
            msgspec.Meta(
                pattern=KEY_PATTERN,
                description="Zenoh key of the frames, without wildcards; absent: gripmon/<robot>/<camera_name>/image",
            ),
        ]
        | None
    ) = None
    format: Annotated[
        Format, msgspec.Meta(description="auto: raw, JPEG or PNG, recognised by content; ROS 2 has source.kind ros2")
    ] = "auto"
    silent_after_s: SilentAfter = 1.0


class Content(NamedTuple):
    """A decoded payload; ``stamp_ns`` None if the capture time is unknown."""

    image: Image
    stamp_ns: int | None
    jaw_opening_m: float | None


def largest_bytes_of(size_px: tuple[int, int]) -> int:
    """No payload of a camera with images of (width, height) is larger."""
    return _MOST_PIXEL_BYTES * size_px[0] * size_px[1] + _PADDING_BYTES


class PayloadDecoder:
    """Payloads of one camera -> images.  A pure function of its input: no clock, no state."""

    def __init__(self, frame_format: Format, size_px: tuple[int, int]) -> None:
        """``size_px`` is (width, height) of every image."""
        self._format, self._size_px = frame_format, size_px
        self.largest_bytes = largest_bytes_of(size_px)

    def decode(self, payload: bytes, encoding: str, attachment: bytes | None) -> Content:
        """``encoding`` is Zenoh's.  Raises :class:`PayloadError` for everything that is wrong."""
        if len(payload) > self.largest_bytes:
            raise PayloadError(f"{len(payload)} bytes; at most {self.largest_bytes} for an image of this camera")
        note = read_note(attachment)
        kind = self._kind(payload, encoding, note)
        if kind == "raw":
            image = raw_image(payload, note, self._size_px)
        else:
            if not payload.startswith(FILES[kind]):
                raise PayloadError(f"no {kind.upper()} file: it begins with {payload[:8].hex() or 'nothing'}")
            image = file_image(payload, self._size_px)
        return Content(image, note.stamp_ns, note.jaw_opening_m)

    def _kind(self, payload: bytes, encoding: str, note: FrameNote) -> Literal["raw", "jpeg", "png"]:
        if self._format in ("raw", "jpeg", "png"):
            return self._format
        media_type = encoding.partition(";")[0]
        if media_type in ("image/jpeg", "image/png"):
            return "jpeg" if media_type == "image/jpeg" else "png"
        if note.width is None and payload.startswith(JPEG):
            return "jpeg"
        if note.width is None and payload.startswith(PNG):
            return "png"
        return "raw"


class Arrival(NamedTuple):
    """What came (``sample``, as the network gives it), and when."""

    sample: Any
    unix_ns: int
    monotonic_s: float


class ArrivingCamera(ABC):
    """The newest frame that a driver published; older ones that were not read are counted as dropped.

    The network's thread only puts each sample into a slot for one; it is decoded in :meth:`read`, in the caller's
    thread, so dropped frames cost nothing.  ``seq`` counts arrivals, without malformed payloads.

    A malformed payload is counted, logged once, and ignored as long as good ones come.  If only malformed ones come,
    ``read`` returns a frame with the fault after ``READ_TIMEOUT_S``.

    ``stamp_ns`` is the driver's stamp, else the network's, else the arrival here.
    """

    live = True

    def __init__(self, key: str, silent_after_s: float) -> None:
        """``key``: where frames come from, for messages."""
        self.key = key
        self._silent_after_s = silent_after_s
        self._malformed = Malformed("frame", key)
        self._changed = threading.Condition()
        self._slot: Arrival | None = None
        self._closed = False
        self._dropped = self._dropped_before = self._handed_over = 0
        self._newest: tuple[float, int] | None = None  # of good payloads: monotonic time of arrival, stamp
        self._last_arrival_s: float | None = None
        self._clock_fault = ""
        self._lateness = Lateness()

    @abstractmethod
    def _content(self, arrival: Arrival) -> Content:
        """The decoded sample.  Raises :class:`PayloadError` for everything that is wrong."""

    @abstractmethod
    def _why_silent(self) -> str:
        """Why nothing comes, for a person."""

    @property
    def connected(self) -> bool:
        last_s = self._last_arrival_s
        return not self._closed and last_s is not None and time.monotonic() - last_s < self._silent_after_s

    @property
    def dropped(self) -> int:
        return self._dropped

    @property
    def malformed(self) -> int:
        """Number of payloads so far that were not a frame of this camera."""
        return self._malformed.count

    def fault(self) -> str:
        """What is wrong with payloads or stamps, in a few words for people; empty if nothing is."""
        faults = (self._malformed.fault(), self._clock_fault, lasting_fault(self.key, self._lateness.lasting_s))
        return "; ".join(fault for fault in faults if fault)

    def read(self) -> Frame | Waiting | None:
        deadline_s = time.monotonic() + READ_TIMEOUT_S
        fault, refusal = "", Refusal.NOT_AN_IMAGE
        while (arrival := self._take(deadline_s)) is not None:
            try:
                content = self._content(arrival)
            except Exception as error:  # noqa: BLE001  malformed input from anyone must not end the monitor
                if not isinstance(error, PayloadError):
                    _log.debug("a payload on %s", self.key, exc_info=error)
                fault = str(error) or type(error).__name__
                refusal = Refusal.WRONG_SIZE if isinstance(error, WrongSizeError) else Refusal.NOT_AN_IMAGE
                self._malformed.add(fault)
                continue
            self._malformed.good()
            return self._frame(arrival, content)
        if self._closed:
            return None
        if fault:
            return Frame(self._next_seq(), self._stamp_now_ns(), None, None, self.key, fault, refusal)
        return Waiting(self._why_silent())

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._slot = None
            self._changed.notify_all()

    def _arrived(self, sample: Any) -> None:
        """Take a sample, in the network's thread."""
        arrival = Arrival(sample, time.time_ns(), time.monotonic())
        with self._changed:
            if self._closed:
                return
            if self._slot is not None:
                self._dropped += 1
            self._slot = arrival
            self._last_arrival_s = arrival.monotonic_s
            self._changed.notify_all()

    def _take(self, deadline_s: float) -> Arrival | None:
        """The next sample that has arrived, or arrives until the deadline."""
        with self._changed:
            left_s = deadline_s - time.monotonic()
            if left_s <= 0.0:  # payloads without end may all be malformed
                return None
            self._changed.wait_for(lambda: self._slot is not None or self._closed, left_s)
            arrival, self._slot = self._slot, None
            self._dropped_before = self._dropped
            return arrival

    def _frame(self, arrival: Arrival, content: Content) -> Frame:
        stamp_ns = arrival.unix_ns if content.stamp_ns is None else content.stamp_ns
        self._newest = arrival.monotonic_s, stamp_ns
        self._clock_fault = clock_fault(self.key, stamp_ns, arrival.unix_ns)
        arrived_ns = round(1e9 * arrival.monotonic_s)
        waited_ns = self._lateness.waited_ns(stamp_ns, arrived_ns, arrival.unix_ns)
        return Frame(
            self._next_seq(), stamp_ns, content.image, content.jaw_opening_m, self.key,
            arrived_ns=arrived_ns - waited_ns,
        )  # fmt: skip

    def _next_seq(self) -> int:
        seq = self._handed_over + self._dropped_before
        self._handed_over += 1
        return seq

    def _stamp_now_ns(self) -> int:
        """Now, on the camera's clock: a bad payload has no time, and another clock's would look like a jump."""
        if self._newest is None:
            return time.time_ns()
        arrival_s, stamp_ns = self._newest
        return stamp_ns + round(1e9 * (time.monotonic() - arrival_s))


class NetworkCamera(ArrivingCamera):
    """A camera whose driver puts its frames on a Zenoh key."""

    def __init__(self, settings: NetworkSettings, link: Link, image_key: str, size_px: tuple[int, int]) -> None:
        """``image_key`` is where settings without a key listen."""
        super().__init__(settings.key or image_key, settings.silent_after_s)
        self._decoder = PayloadDecoder(settings.format, size_px)
        self._link = link
        self._subscriber: zenoh.Subscriber[None] | None = None
        link.attach(self._attach)

    def close(self) -> None:
        import zenoh

        super().close()
        subscriber, self._subscriber = self._subscriber, None
        if subscriber is not None:
            try:
                subscriber.undeclare()
            except zenoh.ZError:
                return  # the session was closed before

    def _attach(self, session: zenoh.Session) -> None:
        self._subscriber = session.declare_subscriber(self.key, in_zenohs_thread(self._receive))

    def _receive(self, sample: zenoh.Sample) -> None:
        import zenoh

        if sample.kind == zenoh.SampleKind.PUT:
            self._arrived(sample)

    def _content(self, arrival: Arrival) -> Content:
        sample: zenoh.Sample = arrival.sample
        size = len(sample.payload)
        if size > self._decoder.largest_bytes:
            raise PayloadError(f"{size} bytes; at most {self._decoder.largest_bytes} for an image of this camera")
        attachment = sample.attachment
        if attachment is not None and len(attachment) > LARGEST_ATTACHMENT_BYTES:
            raise PayloadError(f"an attachment of {len(attachment)} bytes; at most {LARGEST_ATTACHMENT_BYTES}")
        content = self._decoder.decode(
            sample.payload.to_bytes(), str(sample.encoding), None if attachment is None else attachment.to_bytes()
        )
        if content.stamp_ns is None and sample.timestamp is not None:
            return content._replace(stamp_ns=sample.timestamp.get_time_as_ntp64().as_nanos())
        return content

    def _why_silent(self) -> str:
        network = self._link.fault()
        silence = f"{self.key} is silent" if self._last_arrival_s is not None else f"nothing on {self.key} yet"
        return f"{silence} ({network})" if network else silence


def clock_fault(key: str, stamp_ns: int, unix_ns: int) -> str:
    """By how much a driver's stamp is off, in coarse words that rarely change; empty if it may be right.

    Controllers compute a transform's age from it.
    """
    late_s = 1e-9 * (unix_ns - stamp_ns)
    for limit_s, words in (
        (86_400.0, "a day"),
        (3_600.0, "an hour"),
        (60.0, "a minute"),
        (MOST_LATE_S, "some seconds"),
    ):
        if abs(late_s) >= limit_s:
            return (
                f"stamps on {key} are {words} or more {'behind' if late_s > 0.0 else 'ahead of'} this machine's clock"
            )
    return ""


MOST_LATE_S = 3.0
"""Stamps that are always further off than this are of another time or clock, and useless for the age."""

WINDOW_S = 60.0
"""Delays are compared by the fastest frame of each window: long enough to contain one without a queue before it (s)."""

SURE_FRAMES = 3
"""Frames in a row with stamps below an earlier one, or ahead of all before, from which on the driver's clock was set:
of frames that overtook each other the next one is above it, and one wrong stamp has right ones after it.
"""

_AHEAD_NS = 100_000_000
"""A frame that is faster than all before by more than this has to be confirmed by others."""

_FAR_NS = 2**63


class Lateness:
    """Compares each frame's (arrival - stamp) with the smallest one so far.

    The difference is a lower bound on the frame's delay: the fastest one may have been delayed, too.  The smallest one
    rises with the fastest frames of the windows as far as clocks may drift apart (:data:`MOST_DRIFT`), and where stamps
    show that the driver's clock was set back; a delay that lasts is never forgotten.  What rises by less can't be told
    from drift.
    """

    def __init__(self) -> None:
        self._smallest_ns = _FAR_NS
        self._window_ns = self._before_ns = _FAR_NS  # the smallest of this window and of the one before
        self._window_ends_ns: int | None = None
        self._latest_stamp_ns = -_FAR_NS
        self._late_ns = (-_FAR_NS, -_FAR_NS)  # how late the frame with the latest stamp was, and the one before it
        self._below = self._ahead = 0  # frames in a row with earlier stamps; that are faster than all before
        self._of_this_time = False

    @property
    def lasting_s(self) -> float:
        """By how much the fastest frame of the last whole window was slower than the fastest one, s; 0 if unknown."""
        if self._before_ns == _FAR_NS or not self._of_this_time:
            return 0.0
        return 1e-9 * (self._before_ns - self._smallest_ns)

    def waited_ns(self, stamp_ns: int, arrived_ns: int, unix_ns: int) -> int:
        """``arrived_ns`` by the monotonic clock, ``unix_ns`` the same by this machine's clock."""
        late_ns = arrived_ns - stamp_ns
        self._ahead = self._ahead + 1 if late_ns < self._smallest_ns - _AHEAD_NS and self._smallest_ns < _FAR_NS else 0
        if 0 < self._ahead < SURE_FRAMES:
            return 0
        self._follow_the_clock(stamp_ns, late_ns)
        if self._window_ends_ns is None or arrived_ns >= self._window_ends_ns:
            self._follow_the_drift()
            self._window_ends_ns = arrived_ns + round(1e9 * WINDOW_S)
        self._window_ns = min(self._window_ns, late_ns)
        self._smallest_ns = min(self._smallest_ns, late_ns)
        waited_ns = late_ns - self._smallest_ns
        fastest_ns = unix_ns - stamp_ns - waited_ns
        self._of_this_time = abs(fastest_ns) < 1e9 * MOST_LATE_S
        return waited_ns if self._of_this_time else 0

    def _follow_the_clock(self, stamp_ns: int, late_ns: int) -> None:
        """No link makes stamps go back, except for frames that overtake each other."""
        if stamp_ns < self._latest_stamp_ns:
            self._below += 1
            if self._below < SURE_FRAMES:
                return
            # By the slower one of both: the latest stamp may be the wrong one, and a delay is forgotten by nothing.
            self._smallest_ns += max(late_ns - max(self._late_ns), 0)
            self._window_ns = self._before_ns = _FAR_NS
            self._late_ns = (late_ns, late_ns)
        self._latest_stamp_ns, self._late_ns, self._below = stamp_ns, (late_ns, self._late_ns[0]), 0

    def _follow_the_drift(self) -> None:
        """At a window's end."""
        window_ns, self._window_ns = self._window_ns, _FAR_NS
        if self._before_ns < _FAR_NS and abs(window_ns - self._before_ns) <= 1e9 * MOST_DRIFT * WINDOW_S:
            self._smallest_ns += window_ns - self._before_ns  # both ways: what comes and goes leaves nothing behind
        self._before_ns = window_ns


def lasting_fault(key: str, lasting_s: float) -> str:
    """What is said of a delay that lasts, in coarse words that rarely change; empty if there is none."""
    for limit_s, words in ((MOST_LATE_S, "some seconds"), (1.0, "a second"), (0.1, "a tenth of a second")):
        if lasting_s >= limit_s:
            why = "a slow link, or the driver's clock was set back (restart the monitor after that)"
            return f"frames on {key} come {words} or more later than they did: {why}"
    return ""
