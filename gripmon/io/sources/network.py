"""A camera on the network: the newest frame that its driver put on a Zenoh key, and how late it is."""

from __future__ import annotations

import logging
import time
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import msgspec

from gripmon.io.sources.base import READ_TIMEOUT_S, Waiting
from gripmon.io.sources.lateness import Lateness, clock_fault, lasting_fault
from gripmon.io.sources.newest import Newest
from gripmon.io.sources.payload import (
    PayloadError,
    WrongSizeError,
    file_image,
    raw_image,
    read_note,
)
from gripmon.io.wire import Link, in_zenohs_thread
from gripmon.io.wire.malformed import Malformed
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
        self._arrivals: Newest[Arrival] = Newest()
        self._handed_over = 0
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
        return not self._arrivals.ended and last_s is not None and time.monotonic() - last_s < self._silent_after_s

    @property
    def dropped(self) -> int:
        return self._arrivals.dropped

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
        # Payloads without end may all be malformed.
        while (left_s := deadline_s - time.monotonic()) > 0.0 and (arrival := self._arrivals.take(left_s)) is not None:
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
        if self._arrivals.ended:
            return None
        if fault:
            return Frame(self._next_seq(), self._stamp_now_ns(), None, None, self.key, fault, refusal)
        return Waiting(self._why_silent())

    def close(self) -> None:
        self._arrivals.end(discard=True)

    def _arrived(self, sample: Any) -> None:
        """Take a sample, in the network's thread."""
        arrival = Arrival(sample, time.time_ns(), time.monotonic())
        self._last_arrival_s = arrival.monotonic_s
        self._arrivals.put(arrival)

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
        seq = self._handed_over + self._arrivals.dropped_before
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
