"""A video file, every frame in order."""

from __future__ import annotations

import logging
import math
import threading
from pathlib import Path
from typing import Annotated

import msgspec

from gripmon.io.sources.base import SourceError
from gripmon.model.records import Frame

_log = logging.getLogger(__name__)
_NS = 1_000_000_000


class VideoSettings(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="kind", tag="video"
):
    """A video file that FFmpeg reads."""

    path: Annotated[str, msgspec.Meta(min_length=1, description="the video file")]
    fps: (
        Annotated[
            float, msgspec.Meta(gt=0, le=10000, description="replaces the container's time stamps by frame / fps (1/s)")
        ]
        | None
    ) = None


class VideoSource:
    """Frames with the container's time stamps, counted from its beginning, as a container knows no Unix time.

    Containers round (Matroska to 1 ms).  A frame whose stamp doesn't rise becomes a frame with a fault: give ``fps``
    for files without usable stamps.  Images are BGR, also of grey videos.
    """

    live = False
    connected = True
    dropped = 0

    def __init__(self, settings: VideoSettings, relative_to: Path) -> None:
        import cv2

        self._path = relative_to / settings.path
        if not self._path.is_file():
            raise SourceError(f"path: there is no file {self._path}; a video file")
        self._capture = cv2.VideoCapture(str(self._path), cv2.CAP_FFMPEG)
        if not self._capture.isOpened():
            raise SourceError(f"path: {self._path} can't be opened as a video; a complete file in a format of FFmpeg's")
        self._stamp_property = cv2.CAP_PROP_POS_MSEC
        self._announced = round(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))  # an estimate in some containers
        self._fps = settings.fps
        self._seq = 0
        self._last_stamp_ns = -1
        self._open = True
        self._lock = threading.Lock()  # a capture that is released while it reads would crash

    def read(self) -> Frame | None:
        with self._lock:
            return self._next_frame()

    def close(self) -> None:
        with self._lock:
            self._end()

    def _next_frame(self) -> Frame | None:
        if not self._open:
            return None
        if not self._capture.grab():
            if self._seq < self._announced - 1:
                _log.warning("%s ends after %d of %d frames; is it truncated?", self._path, self._seq, self._announced)
            self._end()
            return None
        stamp_ns, fault = self._stamp()
        decoded, image = self._capture.retrieve()
        if not decoded:
            fault = "the video frame can't be decoded"
        frame = Frame(self._seq, stamp_ns, image if fault is None else None, None, self._path.name, fault)
        self._seq += 1
        self._last_stamp_ns = stamp_ns
        return frame

    def _end(self) -> None:
        self._open = False
        self._capture.release()

    def _stamp(self) -> tuple[int, str | None]:
        if self._fps is not None:
            return round(self._seq * _NS / self._fps), None
        stamp_ms = self._capture.get(self._stamp_property)
        stamp_ns = round(stamp_ms * 1e6) if math.isfinite(stamp_ms) else -1
        if stamp_ns <= self._last_stamp_ns:
            return max(self._last_stamp_ns, 0), "the container's time stamp does not rise; give source.fps"
        return stamp_ns, None
