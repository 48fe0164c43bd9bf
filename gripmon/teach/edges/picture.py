"""A picture of what was taught: the sharp model, the taught lines with enlarged offsets, and the corners."""

from __future__ import annotations

import cv2
import numpy as np

from gripmon.model.camera import Camera
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Image
from gripmon.teach.edges.views import TeachingImage
from gripmon.track.edges.profiles import full_scale
from gripmon.track.edges.taught import TaughtEdges, TaughtModel

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
_TITLE, _LABEL = 0.55, 0.45  # sizes of OpenCV's font
_MARGIN_PX, _GAP_PX, _ASIDE_PX = 10, 4, 10
_ROWS = (0, -1, 1, -2, 2, -3, 3, -4, 4, -5, 5, -6, 6)  # lines above and below its place that a label may stand in
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
    labels = Labels(picture)
    labels.title(
        f"{gripper.name}: sharp model (blue), taught outlines (orange), creases (green)",
        f"offsets in px, drawn {enlarged} times as large",
    )
    for name, corner in model.corners.items():
        u, v = (_fixed(x, zoom) for x in corner.uv_px)
        cv2.circle(picture, (u, v), 5 << _SHIFT, _CORNER_BGR, 1, cv2.LINE_AA, _SHIFT)
        labels.put(name, _pixel(corner.uv_px, zoom), _CORNER_BGR)
    for edge, (uv_px, shift_px) in lines.items():
        text = f"{gripper.edge_ids[edge]} {np.linalg.norm(shift_px[len(uv_px) // 2]):.2f}"
        labels.put(text, _pixel(uv_px[len(uv_px) // 2], zoom), _CREASE_BGR if taught.crease[edge] else _OUTLINE_BGR)
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


def _pixel(uv_px: Array | tuple[float, float], zoom: int) -> tuple[int, int]:
    u, v = (round((x + 0.5) * zoom - 0.5) for x in uv_px)
    return u, v


class Labels:
    """Texts in a picture, none over another and all of them inside; one that had to give way is tied to its place."""

    def __init__(self, picture: Picture) -> None:
        self._picture = picture
        self.boxes: list[tuple[int, int, int, int]] = []

    def title(self, *lines: str) -> None:
        """At the top, as large as fits."""
        width, top = self._picture.shape[1] - 2 * _MARGIN_PX, _MARGIN_PX
        for line in lines:
            scale = min(_TITLE, _TITLE * width / _size(line, _TITLE)[0])
            across, up = _size(line, scale)
            self._write(line, (_MARGIN_PX, top + up), _TEXT_BGR, scale)
            self.boxes.append((_MARGIN_PX, top, _MARGIN_PX + across, top + up + _GAP_PX))
            top += up + 2 * _GAP_PX

    def put(self, text: str, at: tuple[int, int], colour: tuple[int, int, int]) -> None:
        """Beside a place (x, y), as near as there is room; nowhere free: right of it."""
        across, up = _size(text, _LABEL)
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
        self._write(text, (x, y), colour, _LABEL)

    def _write(self, text: str, at: tuple[int, int], colour: tuple[int, int, int], scale: float) -> None:
        """With a shadow; OpenCV's font knows ASCII only."""
        plain = text.encode("ascii", "replace").decode()
        for paint, shift in (((0, 0, 0), 1), (colour, 0)):
            place = at[0] + shift, at[1] + shift
            cv2.putText(self._picture, plain, place, cv2.FONT_HERSHEY_SIMPLEX, scale, paint, 1, cv2.LINE_AA)


def _size(text: str, scale: float) -> tuple[int, int]:
    """Width and height, px."""
    (across, up), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
    return int(across), int(up)


def _overlap(a: tuple[int, int, int, int], b: tuple[int, int, int, int]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
