"""Publish images on the network as a camera driver does: one by one, or a source in real time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Literal

import numpy as np
import zenoh

from gripmon.io.sources import USUAL_FPS, Source
from gripmon.io.wire import Link
from gripmon.model.records import Frame, FrameNote, Image, to_json

_LOOK_AGAIN_S = 0.05
_LAST_WORD_S = 0.2


class Feeder:
    """Sends frames when they are due; counts ``sent`` and ``unsent`` ones; ``reason``: why the last one wasn't sent."""

    def __init__(
        self, link: Link, key: str, frame_format: FrameFormat = "raw", *, jpeg_quality: int = 90, recorded_stamps: bool
    ) -> None:
        """``recorded_stamps``: send the frames' own time stamps instead of the sending time."""
        self.sent = self.unsent = 0
        self.reason = ""
        self._link, self._recorded_stamps = link, recorded_stamps
        self._publisher: FramePublisher | None = None

        def declare(session: zenoh.Session) -> None:
            self._publisher = FramePublisher(session, key, frame_format, jpeg_quality=jpeg_quality)

        link.attach(declare)

    def run(self, begin: Callable[[], Source], *, fps: float | None = None, loop: bool = False) -> None:
        """Send a source's frames at the pace of their stamps or at ``fps``; a live camera's frames immediately.  With
        ``loop`` it repeats forever.  ``begin`` opens the source for each pass; it is closed here.

        Waits first for a monitor or a router, so that no frame is lost while that starts.
        """
        while self._link.fault():
            time.sleep(_LOOK_AGAIN_S)
        for frame, due_s in _paced(begin, fps, loop):
            time.sleep(max(due_s - time.monotonic(), 0.0))
            self._send(frame)
        time.sleep(_LAST_WORD_S)  # the last message is still being sent

    def _send(self, frame: Frame) -> None:
        assert self._publisher is not None
        try:
            if frame.image is None:
                raise ValueError(frame.fault)
            stamp_ns = frame.stamp_ns if self._recorded_stamps else time.time_ns()
            self._publisher.put(frame.image, stamp_ns=stamp_ns, jaw_opening_m=frame.jaw_opening_m)
        except ValueError as error:
            self.unsent, self.reason = self.unsent + 1, f"{frame.name}: {error}"
            return
        self.sent += 1


def _paced(begin: Callable[[], Source], fps: float | None, loop: bool) -> Iterator[tuple[Frame, float]]:
    """Yield frames and their due times (monotonic, s)."""
    start_s, passed_s = time.monotonic(), 0.0
    while True:
        source, first_ns, count, since_s = begin(), None, 0, 0.0
        try:
            while (item := source.read()) is not None:
                if not isinstance(item, Frame):
                    continue
                first_ns = item.stamp_ns if first_ns is None else first_ns
                since_s = 1e-9 * (item.stamp_ns - first_ns) if fps is None else count / fps
                yield item, start_s if source.live else start_s + passed_s + since_s
                count += 1
        finally:
            source.close()
        if not loop or source.live or count == 0:
            return
        # The last frame lasts as long as the others on average.
        passed_s += since_s * count / max(count - 1, 1) if count > 1 else 1.0 / (fps or USUAL_FPS)


FrameFormat = Literal["raw", "jpeg", "png"]

_RAW = {
    (2, "uint8"): "mono8",
    (2, "uint16"): "mono16",
    (2, "float32"): "32FC1",
    (3, "uint8"): "bgr8",
    (3, "uint16"): "bgr16",
}


class FramePublisher:
    """Publishes one camera's frames on a key.

    Normal priority, below the monitor's transforms; on a congested link frames are dropped instead of blocking.
    """

    def __init__(
        self, session: zenoh.Session, key: str, frame_format: FrameFormat = "raw", *, jpeg_quality: int = 90
    ) -> None:
        """``jpeg_quality``: 1 to 100 (%)."""
        self._publisher = session.declare_publisher(key)
        self._format, self._jpeg_quality = frame_format, jpeg_quality

    def put(self, image: Image, *, stamp_ns: int | None = None, jaw_opening_m: float | None = None) -> None:
        """Publish an image, (H, W) or (H, W, 3) BGR; ``stamp_ns``: capture time, Unix ns.

        Raises ValueError for an array that isn't an image of the publisher's format.
        """
        if self._format == "raw":
            height, width = image.shape[:2]
            payload, encoding = np.ascontiguousarray(image).tobytes(), zenoh.Encoding.ZENOH_BYTES
            note = FrameNote(
                stamp_ns=stamp_ns, jaw_opening_m=jaw_opening_m, width=width, height=height, encoding=raw_encoding(image)
            )
        else:
            payload = self._file(image)
            encoding = zenoh.Encoding.IMAGE_JPEG if self._format == "jpeg" else zenoh.Encoding.IMAGE_PNG
            note = FrameNote(stamp_ns=stamp_ns, jaw_opening_m=jaw_opening_m)
        self._publisher.put(payload, encoding=encoding, attachment=to_json(note))

    def _file(self, image: Image) -> bytes:
        import cv2

        if self._format == "jpeg" and image.dtype != np.uint8:
            raise ValueError(f"pixels of type {image.dtype} don't fit into JPEG; uint8")
        options = [cv2.IMWRITE_JPEG_QUALITY, self._jpeg_quality] if self._format == "jpeg" else []
        return cv2.imencode(f".{self._format}", image, options)[1].tobytes()


def raw_encoding(image: Image) -> str:
    """The name of an array's pixel format; ValueError for an array that has none."""
    encoding = _RAW.get((image.ndim, image.dtype.name))
    if encoding is None or (image.ndim == 3 and image.shape[2] != 3):
        right = "H x W or H x W x 3, uint8 or uint16; or H x W, float32"
        raise ValueError(f"no image: shape {image.shape}, {image.dtype}; {right}")
    return encoding
