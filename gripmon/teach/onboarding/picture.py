"""A picture of a gripper on a plate: the plate's points, the corners, and residuals, enlarged."""

from __future__ import annotations

import numpy as np

from gripmon.calibrate.plane import Coincidence
from gripmon.model.camera import LensSettings, make_camera
from gripmon.model.records import Image
from gripmon.teach.canvas import Canvas, Colour, enlargement, text_size, write

_WIDTH_PX = 1400
_LARGEST_ZOOM = 4
_ENLARGED_TO_PX = 25.0
_USED: Colour = (120, 220, 90)
_UNUSED: Colour = (70, 70, 250)
_CORNER: Colour = (40, 220, 250)
_AXES: tuple[tuple[str, Colour], ...] = (("x", (80, 80, 255)), ("y", (80, 230, 80)))
_TEXT: Colour = (255, 255, 255)
_STRIP = 24
_SIZE = 0.8


def draw(image: Image, lens: LensSettings, found: Coincidence) -> Image:
    """The image, BGR and enlarged, with the plate's points (green, red if left out), the gripper's corners by name
    (yellow), and arrows from where the calibration has each of them to where it was measured, enlarged as it says; the
    gripper's axes at the TCP.
    """
    zoom = int(np.clip(round(_WIDTH_PX / lens.width_px), 1, _LARGEST_ZOOM))
    canvas = Canvas(image, zoom)
    residuals, used = found.plate.residuals_px[0], found.plate.used[0]
    sizes = np.linalg.norm(residuals[used], axis=1)
    largest_px = max(float(np.quantile(sizes, 0.95)), float(np.linalg.norm(found.residuals_px, axis=1).max()), 1e-6)
    enlarged = enlargement(largest_px, _ENLARGED_TO_PX)
    for uv_px, residual, good in zip(found.sighting.uv_px, residuals, used.tolist(), strict=True):
        colour = _USED if good else _UNUSED
        canvas.circle(uv_px, 3.0, colour)
        if good:
            canvas.line(np.array([uv_px - residual, uv_px + (enlarged - 1) * residual]), colour)
    _axes(canvas, lens, found)
    for name, uv_px, residual in zip(found.corners.names, found.corners.uv_px, found.residuals_px, strict=True):
        canvas.circle(uv_px, 5.0, _CORNER)
        canvas.line(np.array([uv_px - residual, uv_px + (enlarged - 1) * residual]), _CORNER)
        # Away from the middle, where the plate's points are: the fingers are darker, and of one shade.
        width, height = text_size(name, _SIZE)
        u, v = canvas.pixel(uv_px)
        aside = -width - 12 if uv_px[0] < 0.5 * lens.width_px else 12
        write(canvas.picture, name, (u + aside, v + round(1.6 * height)), _CORNER, _SIZE)
    left_out = int(np.count_nonzero(~used))
    legend = (
        f"{int(used.sum())} points of the plate (green), {left_out} left out (red), "
        f"{len(found.corners.names)} corners (yellow); residuals x {enlarged}"
    )
    return _with_caption(canvas.picture, legend)


def _axes(canvas: Canvas, lens: LensSettings, found: Coincidence) -> None:
    """A third of the corners' reach along x and y."""
    reach_m = 0.33 * float(np.abs(found.corners_m[:, :2]).max())
    ends_m = np.vstack([np.zeros(3), reach_m * np.eye(3)[:2]])
    uv_px = make_camera(lens).project(ends_m @ found.cam_T_grip[:3, :3].T + found.cam_T_grip[:3, 3])
    if not np.isfinite(uv_px).all():
        return
    for k, (name, colour) in enumerate(_AXES, start=1):
        canvas.line(uv_px[[0, k]], colour, thickness=2)
        write(canvas.picture, name, canvas.pixel(uv_px[k]), colour, _SIZE)


def _with_caption(picture: Image, text: str) -> Image:
    """The words below, on a strip of their own, as large as the width allows."""
    width, height = text_size(text, 1.0)
    size = min(1.2 * _SIZE, 0.96 * picture.shape[1] / width)
    strip = np.full((round(2.4 * size * height) + 8, picture.shape[1], 3), _STRIP, np.uint8)
    place = (round(0.01 * picture.shape[1]), round(0.5 * (len(strip) + size * height)))
    write(strip, text, place, _TEXT, size)
    return np.vstack([picture, strip])
