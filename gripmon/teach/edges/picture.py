"""A picture of what was taught: the sharp model, the taught lines with enlarged offsets, and the corners."""

from __future__ import annotations

import cv2
import numpy as np

from gripmon.model.camera import Camera
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Image
from gripmon.teach.canvas import Canvas, Colour, enlargement, text_size, write
from gripmon.teach.edges.views import TeachingImage
from gripmon.track.edges.taught import TaughtEdges, TaughtModel

_ENLARGED_TO_PX = 12.0  # the largest offset is drawn at most so long
_SHARP_BGR, _OUTLINE_BGR, _CREASE_BGR, _CORNER_BGR, _TEXT_BGR = (
    (235, 150, 60),
    (60, 170, 255),
    (90, 220, 120),
    (60, 230, 240),
    (255, 255, 255),
)
_TITLE, _LABEL = 0.55, 0.45  # sizes of OpenCV's font
_MARGIN_PX, _GAP_PX, _ASIDE_PX = 10, 4, 10
_ROWS = (0, -1, 1, -2, 2, -3, 3, -4, 4, -5, 5, -6, 6)  # lines above and below its place that a label may stand in
_SMALLEST_PX = 1200  # pictures are enlarged to at least this width


def draw(
    camera: Camera, gripper: Gripper, cam_T_grip: Array, image: TeachingImage, taught: TaughtEdges, model: TaughtModel
) -> Image:
    """The teaching image, BGR, with the sharp model's edges, the taught ones, and the taught corners by name."""
    zoom = max(1, -(-_SMALLEST_PX // camera.width_px))
    canvas = Canvas(image.image, zoom)
    points_grip_m = gripper.points_grip_m(image.jaw_opening_m if gripper.has_jaw else None)
    known = np.flatnonzero(taught.known).tolist()
    lines = {edge: _line(camera, gripper, cam_T_grip, points_grip_m, taught, edge) for edge in known}
    largest_px = max((float(np.nanmax(np.abs(shift))) for _, shift in lines.values()), default=0.0)
    enlarged = enlargement(largest_px, _ENLARGED_TO_PX)
    for edge, (uv_px, shift_px) in lines.items():
        colour = _CREASE_BGR if taught.crease[edge] else _OUTLINE_BGR
        canvas.line(uv_px, _SHARP_BGR)
        canvas.line(uv_px + enlarged * shift_px, colour)
        middle, shift = uv_px[len(uv_px) // 2], shift_px[len(uv_px) // 2]
        canvas.line(np.array([middle, middle + enlarged * shift]), colour)
    labels = Labels(canvas.picture)
    labels.title(
        f"{gripper.name}: sharp model (blue), taught outlines (orange), creases (green)",
        f"offsets in px, drawn {enlarged} times as large",
    )
    for name, corner in model.corners.items():
        canvas.circle(np.array(corner.uv_px), 5.0, _CORNER_BGR)
        labels.put(name, canvas.pixel(np.array(corner.uv_px)), _CORNER_BGR)
    for edge, (uv_px, shift_px) in lines.items():
        text = f"{gripper.edge_ids[edge]} {np.linalg.norm(shift_px[len(uv_px) // 2]):.2f}"
        labels.put(text, canvas.pixel(uv_px[len(uv_px) // 2]), _CREASE_BGR if taught.crease[edge] else _OUTLINE_BGR)
    return canvas.picture


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


class Labels:
    """Texts in a picture, none over another and all of them inside; one that had to give way is tied to its place."""

    def __init__(self, picture: Image) -> None:
        self._picture = picture
        self.boxes: list[tuple[int, int, int, int]] = []

    def title(self, *lines: str) -> None:
        """At the top, as large as fits."""
        width, top = self._picture.shape[1] - 2 * _MARGIN_PX, _MARGIN_PX
        for line in lines:
            scale = min(_TITLE, _TITLE * width / text_size(line, _TITLE)[0])
            across, up = text_size(line, scale)
            write(self._picture, line, (_MARGIN_PX, top + up), _TEXT_BGR, scale)
            self.boxes.append((_MARGIN_PX, top, _MARGIN_PX + across, top + up + _GAP_PX))
            top += up + 2 * _GAP_PX

    def put(self, text: str, at: tuple[int, int], colour: Colour) -> None:
        """Beside a place (x, y), as near as there is room; nowhere free: right of it."""
        across, up = text_size(text, _LABEL)
        height, width = self._picture.shape[:2]
        step = up + _GAP_PX
        beside = ((at[0] + _ASIDE_PX, at[1] - _GAP_PX + k * step) for k in _ROWS)
        before = ((at[0] - _ASIDE_PX - across, at[1] - _GAP_PX + k * step) for k in _ROWS)
        places = [place for pair in zip(beside, before, strict=True) for place in pair]
        for x, y in places:
            box = x - _GAP_PX, y - up - _GAP_PX, x + across + _GAP_PX, y + _GAP_PX
            inside = box[0] >= 0 and box[1] >= 0 and box[2] <= width and box[3] <= height
            if inside and not any(_overlap(box, other) for other in self.boxes):
                break
        else:
            (x, y), *_ = places
            box = x, y - up, x + across, y
        self.boxes.append(box)
        if abs(y - at[1]) > step:
            end = x if x > at[0] else x + across
            cv2.line(self._picture, at, (end, y - up // 2), colour, 1, cv2.LINE_AA)
        write(self._picture, text, (x, y), colour, _LABEL)


def _overlap(a: tuple[int, int, int, int], b: tuple[int, int, int, int]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
