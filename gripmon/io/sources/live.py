"""A camera through ``cv2.VideoCapture``, or JPEGs over HTTP, that reconnects automatically."""

from __future__ import annotations

import logging
import re
import threading
import time
from typing import Annotated, Any, Literal, Protocol

import msgspec

from gripmon.io.sources.base import SourceError, Waiting
from gripmon.io.sources.newest import NewestFrame
from gripmon.io.sources.queued import Backlog
from gripmon.model.records import Frame, Image

_log = logging.getLogger(__name__)
_PAUSE_S = 0.25  # longest wait of the reading thread between two checks of the clock

Backend = Literal["v4l2", "ffmpeg", "gstreamer", "any"]
Pixels = Annotated[int, msgspec.Meta(ge=16, le=20000)]


class LiveSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="kind", tag="live"):
    """A camera; unsupported values of width, height, fps and format are logged, and the camera's own are used."""

    device: Annotated[
        int | str,
        msgspec.Meta(description="index (0), V4L2 path (/dev/video0), URL (rtsp://…, http://…) or GStreamer pipeline"),
    ]
    backend: Annotated[
        Backend | None,
        msgspec.Meta(description="OpenCV backend that opens the device; absent: chosen by the form of the device"),
    ] = None
    width_px: Annotated[Pixels | None, msgspec.Meta(description="image width to ask for (px)")] = None
    height_px: Annotated[Pixels | None, msgspec.Meta(description="image height to ask for (px)")] = None
    fps: Annotated[
        Annotated[float, msgspec.Meta(gt=0, le=10000)] | None, msgspec.Meta(description="frame rate to ask for (1/s)")
    ] = None
    fourcc: Annotated[
        Annotated[str, msgspec.Meta(min_length=4, max_length=4)] | None,
        msgspec.Meta(description="pixel format to ask for, four characters such as MJPG or YUYV"),
    ] = None
    open_timeout_s: Annotated[
        float, msgspec.Meta(gt=0, le=120, description="longest wait for a URL's connection (s)")
    ] = 5.0
    read_timeout_s: Annotated[
        float,
        msgspec.Meta(gt=0, le=120, description="a URL that sends nothing for this time is closed and opened again (s)"),
    ] = 3.0
    retry_first_s: Annotated[
        float,
        msgspec.Meta(gt=0, le=60, description="pause before the first new attempt to connect, doubled each time (s)"),
    ] = 0.5
    retry_longest_s: Annotated[
        float, msgspec.Meta(gt=0, le=600, description="longest pause between attempts to connect (s)")
    ] = 10.0


class LiveCamera(NewestFrame):
    """The newest frame of a camera; while there is none it retries forever, and ``read`` returns :class:`Waiting`.

    ``stamp_ns`` is the Unix time of the frame's arrival here, before decoding; frames that queued up on the way while
    the camera was silent are dropped (:class:`Backlog`).  ``seq`` counts arrivals, so dropped frames leave gaps.
    Images are BGR.  A URL over HTTP is asked for JPEGs first; what it can do about size and rate stands in the URL.
    """

    def __init__(self, settings: LiveSettings) -> None:
        self._camera = _CaptureReader(settings)
        super().__init__(self._camera, name="camera")

    @property
    def dropped(self) -> int:
        return super().dropped + self._camera.queued


class Backoff:
    """Pauses that double from the first to the longest; call :meth:`reset` after a success."""

    def __init__(self, first_s: float, longest_s: float) -> None:
        self._first_s, self._longest_s = first_s, longest_s
        self._next_s = first_s

    def next_s(self) -> float:
        pause_s = min(self._next_s, self._longest_s)
        self._next_s = 2.0 * pause_s
        return pause_s

    def reset(self) -> None:
        self._next_s = self._first_s


class _Stream(Protocol):
    """An open camera: wait for a frame; decode it, or say why that isn't possible; close it."""

    def grab(self) -> bool: ...
    def image(self) -> tuple[Image | None, str | None]: ...
    def release(self) -> None: ...


class _VideoCapture:
    """OpenCV's."""

    def __init__(self, capture: Any) -> None:
        self._capture = capture
        self.grab, self.release = capture.grab, capture.release

    @classmethod
    def open(cls, settings: LiveSettings, api: int, name: str) -> _VideoCapture | None:
        import cv2

        options: list[int] = []
        if api == cv2.CAP_FFMPEG:
            for prop, limit_s in (
                (cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, settings.open_timeout_s),
                (cv2.CAP_PROP_READ_TIMEOUT_MSEC, settings.read_timeout_s),
            ):
                options += [prop, round(1000.0 * limit_s)]
        capture = cv2.VideoCapture(settings.device, api, options)
        if not capture.isOpened():
            capture.release()
            return None
        _ask_for_options(capture, settings, name)
        return cls(capture)

    def image(self) -> tuple[Image | None, str | None]:
        decoded, image = self._capture.retrieve()
        return (image, None) if decoded else (None, "the frame can't be decoded")


def _ask_for_options(capture: Any, settings: LiveSettings, name: str) -> None:
    import cv2

    if settings.fourcc is not None:
        capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*settings.fourcc))
    asked = {
        "width_px": (cv2.CAP_PROP_FRAME_WIDTH, settings.width_px),
        "height_px": (cv2.CAP_PROP_FRAME_HEIGHT, settings.height_px),
        "fps": (cv2.CAP_PROP_FPS, settings.fps),
    }
    for prop, value in asked.values():
        if value is not None:
            capture.set(prop, float(value))
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1.0)  # a queue in the driver would only add delay
    for key, (prop, value) in asked.items():
        if value is not None and abs(capture.get(prop) - value) > 0.01 * value:
            _log.warning("%s: %s is %g, not the %g asked for", name, key, capture.get(prop), value)


class _CaptureReader:
    """The blocking part: opens, reads, and opens again after a pause."""

    def __init__(self, settings: LiveSettings) -> None:
        self._settings = settings
        self._name = shown_name(settings.device)
        self._api = backend_number(settings)
        self._backoff = Backoff(settings.retry_first_s, settings.retry_longest_s)
        self._capture: _Stream | None = None
        self._stop = threading.Event()
        self._next_try_s = 0.0
        self._waiting = Waiting(f"{self._name}: connecting")
        self._seq = 0
        self.queued = 0
        """Frames that were dropped because they had queued up."""
        self._backlog = Backlog()
        self._delivers = False

    @property
    def connected(self) -> bool:
        return self._delivers

    def interrupt(self) -> None:
        self._stop.set()

    def close(self) -> None:
        self._release()

    def read(self) -> Frame | Waiting:
        if self._capture is None:
            pause_s = self._next_try_s - time.monotonic()
            if pause_s > 0.0:
                self._stop.wait(min(pause_s, _PAUSE_S))
                return self._waiting
            self._capture = self._connect()
            if self._capture is None:
                return self._lost("can't be opened")
            self._backlog = Backlog()
        if not self._capture.grab():
            return self._lost("delivers no frames" if self._delivers else "opens, but delivers no frame")
        stamp_ns, arrived_ns = time.time_ns(), time.monotonic_ns()
        if self._backlog.queued(1e-9 * stamp_ns):  # not by the monotonic clock, which stands still in suspend
            self._seq += 1
            self.queued += 1
            return Waiting(f"{self._name}: old frames that queued up are passed over")
        image, fault = self._capture.image()
        if not self._delivers:
            self._delivers = True
            _log.info("%s: connected", self._name)
        self._backoff.reset()
        seq, self._seq = self._seq, self._seq + 1
        return Frame(seq, stamp_ns, image, None, self._name, fault, arrived_ns=arrived_ns)

    def _connect(self) -> _Stream | None:
        settings = self._settings
        stream: _Stream | None = None
        if is_http(settings):
            from gripmon.io.sources.http_jpegs import HttpJpegs  # http and ssl: 0.02 s

            try:
                stream = HttpJpegs.open(str(settings.device), settings.open_timeout_s, settings.read_timeout_s)
            except OSError as error:
                _log.debug("%s: %s", self._name, error)
                return None
        return stream or _VideoCapture.open(settings, self._api, self._name)

    def _lost(self, what: str) -> Waiting:
        self._release()
        pause_s = self._backoff.next_s()
        self._next_try_s = time.monotonic() + pause_s
        self._waiting = Waiting(f"{self._name} {what}; next attempt after {pause_s:g} s")
        _log.warning("%s", self._waiting.reason)
        return self._waiting

    def _release(self) -> None:
        self._delivers = False
        if self._capture is not None:
            self._capture.release()
            self._capture = None


def is_http(settings: LiveSettings) -> bool:
    """Whether the device is a URL over HTTP that may be a stream of JPEGs."""
    device = str(settings.device)
    return settings.backend != "gstreamer" and "!" not in device and bool(re.match(r"https?://", device, re.IGNORECASE))


def shown_name(device: int | str) -> str:
    """The device for messages: without the user and password of a URL."""
    if isinstance(device, int):
        return f"camera {device}"
    return re.sub(r"(?<=://)[^/@\s]*@", "", device)


def backend_number(settings: LiveSettings) -> int:
    """OpenCV's number of the backend that opens the device; SourceError for a device of unknown form and
    for a missing backend.
    """
    import cv2

    apis = {"v4l2": cv2.CAP_V4L2, "ffmpeg": cv2.CAP_FFMPEG, "gstreamer": cv2.CAP_GSTREAMER, "any": cv2.CAP_ANY}
    backend = settings.backend if settings.backend is not None else _backend_by_form(settings.device)
    if backend != "any" and not cv2.videoio_registry.hasBackend(apis[backend]):
        raise SourceError(
            f"device: needs the {backend} backend, which this OpenCV lacks; a build of OpenCV with it, "
            "or an index, /dev/video…, or a URL"
        )
    return apis[backend]


def _backend_by_form(device: int | str) -> Backend:
    if isinstance(device, int):
        if device < 0:
            raise SourceError(f"device: {device} is not an index; 0 for the first camera")
        return "any"
    if device.startswith("/dev/"):
        return "v4l2"
    if "!" in device:
        return "gstreamer"
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]*://", device):
        return "ffmpeg"
    if device.isdecimal():
        raise SourceError(f"device: '{device}' is text; an index is a number without quotes, device: {device}")
    raise SourceError(
        f"device: '{shown_name(device)}' has no known form; an index (0), /dev/video0, a URL (rtsp://…) or a GStreamer "
        "pipeline (… ! appsink); a video file is source kind 'video'"
    )
