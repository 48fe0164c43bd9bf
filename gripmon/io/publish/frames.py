"""Images on the network, as a camera's driver puts them there for a monitor whose source is ``zenoh``."""

from __future__ import annotations

from typing import Literal

import numpy as np
import zenoh

from gripmon.model.records import FrameNote, Image, to_json

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

    Ordinary priority, below the monitor's transforms, and dropped rather than waited for when a link is congested.
    """

    def __init__(
        self, session: zenoh.Session, key: str, frame_format: FrameFormat = "raw", *, jpeg_quality: int = 90
    ) -> None:
        """``jpeg_quality``: 1 to 100 %."""
        self._publisher = session.declare_publisher(key)
        self._format, self._jpeg_quality = frame_format, jpeg_quality

    def put(self, image: Image, *, stamp_ns: int | None = None, jaw_opening_m: float | None = None) -> None:
        """Publish an image, H x W or H x W x 3 (BGR); ``stamp_ns``: Unix time of its capture.

        Raises ValueError for an array that is no image of the format.
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
    """The name of an array's pixel format; ValueError for one that has none."""
    encoding = _RAW.get((image.ndim, image.dtype.name))
    if encoding is None or (image.ndim == 3 and image.shape[2] != 3):
        raise ValueError(f"no image: shape {image.shape}, {image.dtype}; H x W or H x W x 3, uint8 or uint16")
    return encoding
