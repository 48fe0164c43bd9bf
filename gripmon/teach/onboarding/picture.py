"""A picture of a gripper on a plate: the plate's points, the corners, and residuals, enlarged."""

from __future__ import annotations

import itertools

import cv2
import numpy as np

from gripmon.calibrate.plane import Coincidence
from gripmon.model.camera import LensSettings, make_camera
from gripmon.model.records import Array, Image
from gripmon.track.edges.profiles import full_scale

_WIDTH_PX = 1400
_LARGEST_ZOOM = 4
_ENLARGED_TO_PX = 25.0
_ENLARGEMENTS = (1, 2, 5, 10, 20, 50, 100, 200, 500)
_SHIFT = 4
_Colour = tuple[int, int, int]
_USED: _Colour = (120, 220, 90)
_UNUSED: _Colour = (70, 70, 250)
_CORNER: _Colour = (40, 220, 250)
_AXES: tuple[tuple[str, _Colour], ...] = (("x", (80, 80, 255)), ("y", (80, 230, 80)))
_TEXT: _Colour = (255, 255, 255)
_STRIP = 24
_SIZE = 0.8


def draw(image: Image, lens: LensSettings, found: Coincidence) -> Image:
    """The image, BGR and enlarged, with the plate's points (green, red if left out), the gripper's corners by name
    (yellow), and arrows from where the calibration has each of them to where it was measured, enlarged as it says; the
    gripper's axes at the TCP.
    """
    zoom = int(np.clip(round(_WIDTH_PX / lens.width_px), 1, _LARGEST_ZOOM))
    picture = cv2.cvtColor(cv2.resize(_grey(image), None, fx=zoom, fy=zoom), cv2.COLOR_GRAY2BGR)
    residuals, used = found.plate.residuals_px[0], found.plate.used[0]
    sizes = np.linalg.norm(residuals[used], axis=1)
    largest_px = max(float(np.quantile(sizes, 0.95)), float(np.linalg.norm(found.residuals_px, axis=1).max()), 1e-6)
    enlarged = max((k for k in _ENLARGEMENTS if k * largest_px <= _ENLARGED_TO_PX), default=1)
    for uv_px, residual, good in zip(found.sighting.uv_px, residuals, used.tolist(), strict=True):
        colour = _USED if good else _UNUSED
        _circle(picture, uv_px, 3.0, zoom, colour)
        if good:
            _line(picture, uv_px - residual, uv_px + (enlarged - 1) * residual, zoom, colour)
    _axes(picture, lens, found, zoom)
    for name, uv_px, residual in zip(found.corners.names, found.corners.uv_px, found.residuals_px, strict=True):
        _circle(picture, uv_px, 5.0, zoom, _CORNER)
        _line(picture, uv_px - residual, uv_px + (enlarged - 1) * residual, zoom, _CORNER)
        # Away from the middle, where the plate's points are: the fingers are darker, and of one shade.
        _label(picture, name, uv_px, zoom, _CORNER, left=bool(uv_px[0] < 0.5 * lens.width_px))
    left_out = int(np.count_nonzero(~used))
    legend = (
        f"{int(used.sum())} points of the plate (green), {left_out} left out (red), "
        f"{len(found.corners.names)} corners (yellow); residuals x {enlarged}"
    )
    return _with_caption(picture, legend)


def _grey(image: Image) -> Image:
    scaled = image.astype(np.float32) * (255.0 / full_scale(image))
    grey = cv2.cvtColor(scaled, cv2.COLOR_BGR2GRAY) if scaled.ndim == 3 else scaled
    return np.asarray(np.clip(grey, 0.0, 255.0), dtype=np.uint8)


def _axes(picture: Image, lens: LensSettings, found: Coincidence, zoom: int) -> None:
    """A third of the corners' reach along x and y."""
    reach_m = 0.33 * float(np.abs(found.corners_m[:, :2]).max())
    ends_m = np.vstack([np.zeros(3), reach_m * np.eye(3)[:2]])
    uv_px = make_camera(lens).project(ends_m @ found.cam_T_grip[:3, :3].T + found.cam_T_grip[:3, 3])
    if not np.isfinite(uv_px).all():
        return
    for k, (name, colour) in enumerate(_AXES, start=1):
        _line(picture, uv_px[0], uv_px[k], zoom, colour, thickness=2)
        _text(picture, name, uv_px[k], zoom, colour)


def _fixed(at_px: Array, zoom: int) -> tuple[int, int]:
    """In OpenCV's fixed-point coordinates of the enlarged picture."""
    u, v = (round(((x + 0.5) * zoom - 0.5) * (1 << _SHIFT)) for x in at_px.tolist())
    return u, v


def _circle(picture: Image, at_px: Array, radius_px: float, zoom: int, colour: _Colour) -> None:
    cv2.circle(picture, _fixed(at_px, zoom), round(radius_px * (1 << _SHIFT)), colour, 1, cv2.LINE_AA, _SHIFT)


def _line(picture: Image, start: Array, end: Array, zoom: int, colour: _Colour, thickness: int = 1) -> None:
    cv2.line(picture, _fixed(start, zoom), _fixed(end, zoom), colour, thickness, cv2.LINE_AA, _SHIFT)


def _label(picture: Image, name: str, at_px: Array, zoom: int, colour: _Colour, *, left: bool) -> None:
    """A corner's name beside it."""
    (width, height), _ = cv2.getTextSize(name, cv2.FONT_HERSHEY_SIMPLEX, _SIZE, 1)
    away = np.array([-width - 12.0 if left else 12.0, 1.6 * height]) / zoom
    _text(picture, name, at_px + away, zoom, colour)


def _text(picture: Image, text: str, at_px: Array, zoom: int, colour: _Colour) -> None:
    """With a dark outline, of the same weight: thicker letters are wider.  OpenCV's font knows ASCII only."""
    u, v = (round(float(x) * zoom) for x in at_px)
    plain = text.encode("ascii", "replace").decode()
    for right, down in (*itertools.product((-2, 0, 2), repeat=2), (0, 0)):
        paint = colour if right == down == 0 else (0, 0, 0)
        cv2.putText(picture, plain, (u + right, v + down), cv2.FONT_HERSHEY_SIMPLEX, _SIZE, paint, 1, cv2.LINE_AA)


def _with_caption(picture: Image, text: str) -> Image:
    """The words below, on a strip of their own, as large as the width allows."""
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 1.0, 1)
    size = min(1.2 * _SIZE, 0.96 * picture.shape[1] / width)
    strip = np.full((round(2.4 * size * height) + 8, picture.shape[1], 3), _STRIP, np.uint8)
    place = (round(0.01 * picture.shape[1]), round(0.5 * (len(strip) + size * height)))
    cv2.putText(strip, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, _TEXT, 1, cv2.LINE_AA)
    return np.vstack([picture, strip])
