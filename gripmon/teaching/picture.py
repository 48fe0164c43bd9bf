"""A picture of what was taught: the sharp model, the taught lines with enlarged offsets, and the corners."""

from __future__ import annotations

import cv2
import numpy as np

from gripmon.camera import Camera
from gripmon.corners.profiles import full_scale
from gripmon.corners.taught import TaughtEdges, TaughtModel
from gripmon.gripper import Gripper
from gripmon.records import Array, Image
from gripmon.teaching.views import TeachingImage

Picture = Image

_ENLARGED_TO_PX = 12.0  # the largest offset is drawn at most so long
_ENLARGEMENTS = (1, 2, 5, 10, 20, 50, 100)
_SHARP_BGR, _OUTLINE_BGR, _CREASE_BGR, _CORNER_BGR, _TEXT_BGR = (
    (235, 150, 60),
    (60, 170, 255),
    (90, 220, 120),
    (60, 230, 240),
    (255, 255, 255),
)
_SMALLEST_PX = 1200  # pictures are enlarged to at least this width
_SHIFT = 4  # binary digits of a pixel in OpenCV's drawing


def draw(
    camera: Camera, gripper: Gripper, cam_T_grip: Array, image: TeachingImage, taught: TaughtEdges, model: TaughtModel
) -> Picture:
    """The teaching image, BGR, with the sharp model's edges, the taught ones, and the taught corners by name."""
    zoom = max(1, -(-_SMALLEST_PX // camera.width_px))
    canvas = cv2.resize(_grey(image.image), None, fx=zoom, fy=zoom, interpolation=cv2.INTER_LINEAR)
    picture = cv2.cvtColor(canvas, cv2.COLOR_GRAY2BGR)
    points_grip_m = gripper.points_grip_m(image.jaw_opening_m if gripper.has_jaw else None)
    known = np.flatnonzero(taught.known).tolist()
    lines = {edge: _line(camera, gripper, cam_T_grip, points_grip_m, taught, edge) for edge in known}
    largest_px = max((float(np.nanmax(np.abs(shift))) for _, shift in lines.values()), default=0.0)
    enlarged = max((k for k in _ENLARGEMENTS if k * largest_px <= _ENLARGED_TO_PX), default=1)
    for edge, (uv_px, shift_px) in lines.items():
        colour = _CREASE_BGR if taught.crease[edge] else _OUTLINE_BGR
        _polyline(picture, uv_px, zoom, _SHARP_BGR)
        _polyline(picture, uv_px + enlarged * shift_px, zoom, colour)
        middle, shift = uv_px[len(uv_px) // 2], shift_px[len(uv_px) // 2]
        _arrow(picture, middle, middle + enlarged * shift, zoom, colour)
        _text(picture, f"{gripper.edge_ids[edge]} {np.linalg.norm(shift):.2f}", middle, zoom, colour, 0.4)
    for name, corner in model.corners.items():
        u, v = (_fixed(x, zoom) for x in corner.uv_px)
        cv2.circle(picture, (u, v), 5 << _SHIFT, _CORNER_BGR, 1, cv2.LINE_AA, _SHIFT)
        _text(picture, name, np.add(corner.uv_px, (3.0, -4.0)), zoom, _CORNER_BGR, 0.45)
    legend = f"{gripper.name}: sharp model (blue), taught outlines (orange), creases (green); px; offsets x {enlarged}"
    _text(picture, legend, np.array([6.0, 12.0]), zoom, _TEXT_BGR, 0.5)
    return picture


def _grey(image: Image) -> Picture:
    scaled = image.astype(np.float32) * (255.0 / full_scale(image))
    grey = cv2.cvtColor(scaled, cv2.COLOR_BGR2GRAY) if scaled.ndim == 3 else scaled
    return np.asarray(np.clip(grey, 0.0, 255.0), dtype=np.uint8)


def _line(
    camera: Camera, gripper: Gripper, cam_T_grip: Array, points_grip_m: Array, taught: TaughtEdges, edge: int
) -> tuple[Array, Array]:
    """The sharp edge's taught part (n, 2), px, and by how much it is shifted across itself (n, 2)."""
    start, end = points_grip_m[gripper.edge_points[edge]]
    fraction = np.linspace(taught.share[edge, 0], taught.share[edge, 1], 33)
    sharp = start + fraction[:, None] * (end - start)
    real = sharp + taught.shift_at_m(np.full(len(fraction), edge), fraction)
    uv_px, real_px = (camera.project(p @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3]) for p in (sharp, real))
    seen = np.isfinite(uv_px).all(axis=1)
    uv_px, shift_px = uv_px[seen], (real_px - uv_px)[seen]
    along = np.gradient(uv_px, axis=0)
    along /= np.linalg.norm(along, axis=1)[:, None]
    return uv_px, shift_px - np.einsum("ni,ni->n", shift_px, along)[:, None] * along


def _fixed(value: float, zoom: int) -> int:
    """A coordinate of the image in OpenCV's fixed-point coordinates of the enlarged picture."""
    return round(((value + 0.5) * zoom - 0.5) * (1 << _SHIFT))


def _polyline(picture: Picture, uv_px: Array, zoom: int, colour: tuple[int, int, int]) -> None:
    points = np.array([[_fixed(u, zoom), _fixed(v, zoom)] for u, v in uv_px.tolist()], np.int32)
    cv2.polylines(picture, [points], False, colour, 1, cv2.LINE_AA, _SHIFT)


def _arrow(picture: Picture, start: Array, end: Array, zoom: int, colour: tuple[int, int, int]) -> None:
    _polyline(picture, np.array([start, end]), zoom, colour)


def _text(picture: Picture, text: str, at_px: Array, zoom: int, colour: tuple[int, int, int], size: float) -> None:
    """With a shadow; OpenCV's font knows ASCII only."""
    u, v = round(float(at_px[0]) * zoom) + 6, round(float(at_px[1]) * zoom) - 4
    plain = text.encode("ascii", "replace").decode()
    for paint, shift in (((0, 0, 0), 1), (colour, 0)):
        cv2.putText(picture, plain, (u + shift, v + shift), cv2.FONT_HERSHEY_SIMPLEX, size, paint, 1, cv2.LINE_AA)
