"""An image's grey levels, their noise, and how sharp its edges are."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array, Image

Grey = NDArray[np.float32]
_TOP = 200.0
_DIM = 100.0
_SAMPLES = (33, 400)
_EDGE = float(np.sqrt(2.0 * np.pi))
"""For a blurred edge, height over greatest slope is this times the blur's standard deviation."""


def to_grey(image: Image) -> Grey:
    """Grey levels up to about 255 for any camera image: 8 bit as they are unless dark, which are brightened; 16 bit (of
    which 10 or 12 may be in use) and float scaled by their content.
    """
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    grey = np.nan_to_num(np.ascontiguousarray(grey, np.float32), posinf=0.0, neginf=0.0)
    top = float(np.percentile(grey[::4, ::4], 99.5))
    if top > 0.0 and (image.dtype != np.uint8 or top < _DIM):
        grey = (grey * (_TOP / top)).astype(np.float32)
    return np.minimum(grey, np.float32(255.0))


def to_bytes(grey: Grey) -> NDArray[np.uint8]:
    """Bytes, as OpenCV's own detectors expect."""
    return np.clip(np.rint(grey), 0.0, 255.0).astype(np.uint8)


def noise_of(grey: Grey) -> float:
    """Standard deviation of the image's noise, robust against its content (Immerkaer, "Fast noise variance estimation",
    1996, with a median); at least that of rounding.
    """
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    return max(float(np.median(np.abs(cv2.filter2D(grey, cv2.CV_32F, kernel)))) / (6.0 * 0.6745), 0.3)


def edge_blur_px(grey: Grey, start: Array, end: Array) -> float:
    """Median standard deviation (px) of the blur of edges, one across each of the lines from ``start`` to ``end`` (n,
    2); infinity if there are none.
    """
    if not len(start):
        return float("inf")
    length = np.linalg.norm(end - start, axis=1)
    samples = int(np.clip(2.0 * length.max(), *_SAMPLES))
    share = np.linspace(0.0, 1.0, samples)[None, :, None]
    where = (start[:, None] * (1.0 - share) + end[:, None] * share).astype(np.float32)
    levels = cv2.remap(grey, where[:, :, 0], where[:, :, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    spacing = length / (samples - 1)
    # Over three samples: between two the noise would look like a slope.
    slope = np.abs(levels[:, 3:] - levels[:, :-3]).max(axis=1) / (3.0 * spacing)
    height = np.abs(levels[:, :4].mean(axis=1) - levels[:, -4:].mean(axis=1))
    return float(np.median(height / np.maximum(slope, 1e-6))) / _EDGE


def sharpest_blur_px(grey: Grey) -> float:
    """Standard deviation (px) of the blur of the image's strongest edges, whatever they are."""
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.0)
    slope = np.hypot(*(cv2.Sobel(smooth, cv2.CV_32F, *o, ksize=3, scale=0.125) for o in ((1, 0), (0, 1))))
    square = np.ones((31, 31), np.uint8)
    height = cv2.dilate(smooth, square) - cv2.erode(smooth, square)
    strongest = np.argpartition(slope.ravel(), -400)[-400:]
    blur = np.median(height.ravel()[strongest] / np.maximum(slope.ravel()[strongest], 1e-6)) / _EDGE
    return float(np.sqrt(max(float(blur) ** 2 - 1.0, 0.0)))
