"""A camera through ``cv2.VideoCapture``, or JPEGs over HTTP, that reconnects automatically."""

from __future__ import annotations

import logging
import re
import threading
import time
from typing import Annotated, Any, Literal, Protocol

import msgspec

from gripmon.io.sources.base import READ_TIMEOUT_S, SourceError, Waiting
from gripmon.io.sources.newest import Newest
from gripmon.io.sources.queued import Backlog
from gripmon.model.records import Frame, Image

_log = logging.getLogger(__name__)

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


class LiveCamera:
    """The newest frame of a camera; while there is none it retries forever, and ``read`` returns :class:`Waiting`.

    ``stamp_ns`` is the Unix time of the frame's arrival here, before decoding; frames that queued up on the way while
    the camera was silent are dropped (:class:`Backlog`).  ``seq`` counts arrivals, so dropped frames leave gaps.
    Images are BGR.  A URL over HTTP is asked for JPEGs first; what it can do about size and rate stands in the URL.

    A thread waits for the driver.  What it raises ends it; the next ``read`` raises that, after the last frame.
    """

    live = True

    def __init__(self, settings: LiveSettings, *, close_within_s: float = 0.5) -> None:
        """``close_within_s``: after it, a driver that has not returned is left behind."""
        self._settings = settings
        self._name = shown_name(settings.device)
        self._api = backend_number(settings)
        self._close_within_s = close_within_s
        self._newest: Newest[Frame] = Newest()
        self._waiting = f"{self._name}: connecting"
        self._fault: BaseException | None = None
        self._stop = threading.Event()
        self._delivers = False
        self._seq = self._queued = 0
        # A daemon thread: a driver that never returns must not keep the process alive.
        self._thread = threading.Thread(target=self._run, name="gripmon-camera", daemon=True)
        self._thread.start()

    @property
    def connected(self) -> bool:
        return self._delivers and not self._newest.ended

    @property
    def dropped(self) -> int:
        return self._newest.dropped + self._queued

    def read(self) -> Frame | Waiting | None:
        frame = self._newest.take(READ_TIMEOUT_S)
        if frame is not None or self._stop.is_set():
            return frame
        if self._fault is not None:
            raise self._fault
        return Waiting(self._waiting)

    def close(self) -> None:
        self._stop.set()
        self._newest.end(discard=True)
        if self._thread is not threading.current_thread():
            self._thread.join(self._close_within_s)
            if self._thread.is_alive():
                _log.warning("the camera driver has not returned after %.1f s; left behind", self._close_within_s)

    def _run(self) -> None:
        settings = self._settings
        pause_s = settings.retry_first_s
        try:
            while not self._stop.is_set():
                stream, wrong, before = self._connect(), "can't be opened", self._seq
                if stream is not None:
                    wrong = self._deliver(stream)
                if self._seq > before:
                    pause_s = settings.retry_first_s
                if not self._stop.is_set():
                    pause_s = min(pause_s, settings.retry_longest_s)
                    self._waiting = f"{self._name} {wrong}; next attempt after {pause_s:g} s"
                    _log.warning("%s", self._waiting)
                    self._stop.wait(pause_s)
                    pause_s *= 2.0
        except BaseException as error:  # noqa: BLE001  not handled here: the consumer raises it
            self._fault = error
        finally:
            self._newest.end()

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

    def _deliver(self, stream: _Stream) -> str:
        """Hand over frames while they come; what is wrong then."""
        backlog = Backlog()
        try:
            while not self._stop.is_set() and stream.grab():
                stamp_ns, arrived_ns, seq = time.time_ns(), time.monotonic_ns(), self._seq
                self._seq += 1
                if backlog.queued(1e-9 * stamp_ns):  # not by the monotonic clock, which stands still in suspend
                    self._queued += 1
                    self._waiting = f"{self._name}: old frames that queued up are passed over"
                    continue
                image, fault = stream.image()
                if not self._delivers:
                    self._delivers = True
                    _log.info("%s: connected", self._name)
                self._newest.put(Frame(seq, stamp_ns, image, None, self._name, fault, arrived_ns=arrived_ns))
                self._waiting = "the camera is silent"
            return "delivers no frames" if self._delivers else "opens, but delivers no frame"
        finally:
            self._delivers = False
            stream.release()


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
