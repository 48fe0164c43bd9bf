"""Encoded images, and those that are kept in case of an alert."""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.pixels import to_8_bit
from gripmon.record.keeping import Moments
from gripmon.record.recorder import Picture, RecordingSettings, Row


def encode_picture(image: NDArray[np.generic], settings: RecordingSettings) -> Picture:
    """Compress an image and compute its quality statistics (on 8-bit grey values)."""
    shown = to_8_bit(image)
    if settings.image_format == "png":
        exact = image.astype(np.uint16, copy=False) if image.dtype == np.uint16 else shown
        _, blob = cv2.imencode(".png", exact, (cv2.IMWRITE_PNG_COMPRESSION, 1))
    else:
        _, blob = cv2.imencode(".jpg", shown, (cv2.IMWRITE_JPEG_QUALITY, settings.jpeg_quality))
    return measured_picture(blob.tobytes(), f"image/{settings.image_format}", shown)


def measured_picture(blob: bytes, media_type: str, image: NDArray[np.generic]) -> Picture:
    """An encoded image with the quality statistics of its pixels."""
    shown = to_8_bit(image)
    grey = shown if shown.ndim == 2 else cv2.cvtColor(shown, cv2.COLOR_BGR2GRAY)
    mean, deviation = cv2.meanStdDev(grey)
    laplacian = cv2.Laplacian(grey, cv2.CV_16S)
    return Picture(
        blob=blob,
        media_type=media_type,
        mean_grey=float(mean[0, 0]),
        contrast_grey=float(deviation[0, 0]),
        saturated_percent=100.0 * float(np.count_nonzero(grey >= 254)) / grey.size,
        sharpness=float(cv2.meanStdDev(laplacian)[1][0, 0]),
    )


class PictureRing:
    """Rows with pictures of the last ``span_ns`` of capture time, at most ``limit_bytes``; the oldest are dropped."""

    def __init__(self, span_ns: int, limit_bytes: int) -> None:
        self._span_ns, self._limit_bytes = span_ns, limit_bytes
        self._rows: deque[Row] = deque()
        self.bytes = 0

    def __len__(self) -> int:
        return len(self._rows)

    def push(self, row: Row) -> None:
        rows, stamp_ns = self._rows, row.record.stamp_ns
        if rows and stamp_ns < rows[-1].record.stamp_ns:
            rows.clear()  # the clock was set back: the age of the others is unknown
            self.bytes = 0
        rows.append(row)
        self.bytes += row.picture_bytes
        while rows and (self.bytes > self._limit_bytes or stamp_ns - rows[0].record.stamp_ns > self._span_ns):
            self.bytes -= rows.popleft().picture_bytes

    def take(self, moments: Moments) -> list[Row]:
        """Remove and return the rows near the moments, in order."""
        taken = [row for row in self._rows if moments.near(row.record.stamp_ns)]
        self._rows = deque(row for row in self._rows if not moments.near(row.record.stamp_ns))
        self.bytes -= sum(row.picture_bytes for row in taken)
        return taken
