"""A picture of a camera calibration: residuals over the image, where the target was seen, and how each view fits.

Drawn with OpenCV, as the laser's: a PNG from plotly needs a browser.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from gripmon.calibrate.intrinsics import IntrinsicsResult
from gripmon.calibrate.sighting import Sighting
from gripmon.model.records import Array, Image

_MAP_PX = 900
_SIDE_PX = 380
_TOP_PX = 64
_CELLS = 12
_LONGEST_PX = 28.0
"""Of an arrow as long as three standard deviations."""
_INK, _PALE, _GOOD, _BAD, _EMPTY = (40, 40, 40), (245, 245, 245), (150, 90, 20), (40, 40, 210), (205, 205, 225)
_SUBPIXEL_BITS = 4
_Colour = tuple[int, int, int]


@dataclass(frozen=True)
class _Frame:
    """Where the image lies in the picture."""

    scale: float
    width: int
    height: int

    def at(self, uv_px: Array) -> Array:
        out: Array = (uv_px + 0.5) * self.scale + np.array([0.0, _TOP_PX])
        return out


def draw_maps(result: IntrinsicsResult, sightings: Sequence[Sighting]) -> Image:
    """BGR.  Cells of the image in which no point was seen are tinted; arrows are residuals, enlarged as it says; red
    ones were left out.  On the right each view's root mean square residual.
    """
    size = (result.camera.width_px, result.camera.height_px)
    scale = _MAP_PX / size[0]
    frame = _Frame(scale, _MAP_PX, round(scale * size[1]))
    picture = np.full((max(frame.height, 240) + _TOP_PX, frame.width + _SIDE_PX, 3), 255, np.uint8)
    _coverage(picture, frame, sightings, size)
    enlarged = _LONGEST_PX / max(3.0 * result.rms_px, 1e-6)
    for sighting, residual, used in zip(sightings, result.residuals_px, result.used, strict=True):
        start = frame.at(sighting.uv_px)
        length = np.linalg.norm(residual, axis=1, keepdims=True) * enlarged
        # What is far off would cross the whole picture.
        arrow = np.nan_to_num(residual) * enlarged * np.minimum(1.0, 2.0 * _LONGEST_PX / np.maximum(length, 1e-9))
        for a, b, good in zip(start, start + np.nan_to_num(arrow), used.tolist(), strict=True):
            colour = _GOOD if good else _BAD
            line(picture, a, b, colour)
            disc(picture, a, 1.5, colour)
    centre = frame.at(np.array([[result.camera.cx_px, result.camera.cy_px]]))[0]
    at = (round(float(centre[0])), round(float(centre[1])))
    cv2.drawMarker(picture, at, _INK, cv2.MARKER_CROSS, 18, 1, cv2.LINE_AA)
    _bars(picture, frame, result, sightings)
    _titles(picture, frame, result, sightings, enlarged / scale)
    return picture


def _coverage(picture: Image, frame: _Frame, sightings: Sequence[Sighting], size: tuple[int, int]) -> None:
    rows = max(1, round(_CELLS * size[1] / size[0]))
    points = np.concatenate([s.uv_px for s in sightings]) / np.array(size)
    counts, _, _ = np.histogram2d(points[:, 1], points[:, 0], bins=(rows, _CELLS), range=((0, 1), (0, 1)))
    edges_x = np.rint(np.linspace(0, frame.width, _CELLS + 1)).astype(int)
    edges_y = np.rint(np.linspace(0, frame.height, rows + 1)).astype(int) + _TOP_PX
    for r, c in np.ndindex(*counts.shape):
        corners = (int(edges_x[c]), int(edges_y[r])), (int(edges_x[c + 1]) - 1, int(edges_y[r + 1]) - 1)
        cv2.rectangle(picture, *corners, _PALE if counts[r, c] else _EMPTY, -1)
    cv2.rectangle(picture, (0, _TOP_PX), (frame.width - 1, frame.height + _TOP_PX - 1), _INK, 1)


def _bars(picture: Image, frame: _Frame, result: IntrinsicsResult, sightings: Sequence[Sighting]) -> None:
    rms = result.view_rms_px
    left, width = frame.width + 16, _SIDE_PX - 32
    step = min(26.0, (frame.height - 10) / len(rms))
    longest = max(max(rms), 1e-9)
    for k, (value, sighting, used) in enumerate(zip(rms, sightings, result.used, strict=True)):
        top = round(_TOP_PX + k * step)
        high = max(round(step) - 2, 1)
        colour = (225, 200, 170) if used.mean() > 0.5 else (190, 190, 240)
        cv2.rectangle(picture, (left, top), (left + round(width * value / longest), top + high), colour, -1)
        if step >= 13.0:
            text = f"{value:.3f}  {Path(sighting.name).name}"[:44]
            write(picture, text, (left + 4, top + high - 5), 0.4)


def _titles(
    picture: Image, frame: _Frame, result: IntrinsicsResult, sightings: Sequence[Sighting], enlarged: float
) -> None:
    out = sum(int((~u).sum()) for u in result.used)
    total = sum(len(s) for s in sightings)
    lines = (
        f"{result.model}, {len(sightings)} views, {total - out} points, {result.rms_px:.3f} px; {out} left out (red)",
        f"residuals {enlarged:.0f} times enlarged; cross: principal point; tinted: no point seen there",
    )
    for k, text in enumerate(lines):
        write(picture, text, (8, 24 + 24 * k), 0.55)
    write(picture, "rms of each view (px)", (frame.width + 16, 48), 0.55)


def write(image: Image, text: str, at: tuple[int, int], size: float = 0.42) -> None:
    """A text that begins at a place (px)."""
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, _INK, 1, cv2.LINE_AA)


def line(image: Image, start: Array, end: Array, colour: _Colour, width: int = 1) -> None:
    """A line between two places (2,), px."""
    first, last = (np.rint(point * 2**_SUBPIXEL_BITS).astype(int).tolist() for point in (start, end))
    cv2.line(image, first, last, colour, width, cv2.LINE_AA, _SUBPIXEL_BITS)


def disc(image: Image, at: Array, radius: float, colour: _Colour) -> None:
    """A filled disc at a place (2,), px."""
    x, y = (round(v * 2**_SUBPIXEL_BITS) for v in at.tolist())
    cv2.circle(image, (x, y), round(radius * 2**_SUBPIXEL_BITS), colour, -1, cv2.LINE_AA, _SUBPIXEL_BITS)
