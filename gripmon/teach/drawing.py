"""Pictures of what was taught or measured, drawn over an enlarged image: positions in its pixels, lines to parts of a
pixel, readable text.
"""

from __future__ import annotations

import itertools

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.calibrate.plane import Coincidence
from gripmon.model.camera import Camera, LensSettings, make_camera
from gripmon.model.canvas import Canvas, Colour
from gripmon.model.geometry import invert
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Image
from gripmon.teach.views import TeachingImage
from gripmon.track.edges.taught import TaughtEdges, TaughtModel

_FONT = cv2.FONT_HERSHEY_SIMPLEX


def write(picture: Image, text: str, at: tuple[int, int], colour: Colour, size: float) -> None:
    """Write text with a dark outline, made of shifted copies: OpenCV's thicker letters are also wider.  ASCII only."""
    plain = text.encode("ascii", "replace").decode()
    for right, down in (*itertools.product((-1, 0, 1), repeat=2), (0, 0)):
        paint = colour if right == down == 0 else (0, 0, 0)
        cv2.putText(picture, plain, (at[0] + right, at[1] + down), _FONT, size, paint, 1, cv2.LINE_AA)


def text_size(text: str, size: float) -> tuple[int, int]:
    """Width and height of a text, px."""
    (across, up), _ = cv2.getTextSize(text, _FONT, size, 1)
    return int(across), int(up)


def enlargement(largest_px: float, to_px: float) -> int:
    """A round factor by which to enlarge lengths so that the largest is at most ``to_px`` long."""
    return max((k for k in (1, 2, 5, 10, 20, 50, 100, 200, 500) if k * largest_px <= to_px), default=1)


_ENLARGED_TO_PX = 24.0  # length in the picture at which the largest offset is drawn, at most
_SHARP_BGR, OUTLINE_BGR, CREASE_BGR, CORNER_BGR = (235, 150, 60), (60, 170, 255), (90, 220, 120), (60, 230, 240)
_DOUBTED_BGR, _TEXT_BGR = (70, 70, 250), (255, 255, 255)
_TITLE, _LABEL = 0.55, 0.45  # sizes of OpenCV's font
_MARGIN_PX, _GAP_PX, _ASIDE_PX = 10, 4, 10
_ROWS = (0, -1, 1, -2, 2, -3, 3, -4, 4, -5, 5, -6, 6)  # rows above and below its point in which a label may be placed
_SMALLEST_PX = 1200  # pictures are enlarged to at least this width


def draw_taught(
    camera: Camera, gripper: Gripper, cam_T_grip: Array, image: TeachingImage, taught: TaughtEdges, model: TaughtModel
) -> Image:
    """The teaching image, BGR, with the sharp model's edges, the taught ones, and the taught corners by name."""
    points_grip_m = gripper.points_grip_m(image.jaw_opening_m if gripper.has_jaw else None)
    known = np.flatnonzero(taught.known).tolist()
    lines = {edge: _line(camera, gripper, cam_T_grip, points_grip_m, taught, edge) for edge in known}
    canvas = Canvas.about(image.image, np.concatenate([uv_px for uv_px, _ in lines.values()]), _SMALLEST_PX)
    largest_px = max((float(np.nanmax(np.abs(shift))) for _, shift in lines.values()), default=0.0)
    enlarged = enlargement(canvas.zoom * largest_px, _ENLARGED_TO_PX)
    for edge, (uv_px, shift_px) in lines.items():
        colour = CREASE_BGR if taught.crease[edge] else OUTLINE_BGR
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
        canvas.circle(np.array(corner.uv_px), 5.0, CORNER_BGR)
        labels.put(name, canvas.pixel(np.array(corner.uv_px)), CORNER_BGR)
    for edge, (uv_px, shift_px) in lines.items():
        text = f"{gripper.edge_ids[edge]} {np.linalg.norm(shift_px[len(uv_px) // 2]):.2f}"
        labels.put(text, canvas.pixel(uv_px[len(uv_px) // 2]), CREASE_BGR if taught.crease[edge] else OUTLINE_BGR)
    return canvas.picture


def draw_doubted(
    camera: Camera,
    gripper: Gripper,
    cam_T_grip: Array,
    image: TeachingImage,
    doubted: NDArray[np.bool_],
    visible: NDArray[np.bool_],
    why: str,
) -> Image:
    """The image, BGR, with the gripper's ``visible`` (e,) edges at the reference, and those that make the bound as
    large, ``doubted`` (e,), in red; ``why`` in words above.
    """
    points_grip_m = gripper.points_grip_m(image.jaw_opening_m if gripper.has_jaw else None)
    edges = np.flatnonzero(visible)
    outlines = gripper.outlines_m(points_grip_m, edges, 33) @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3]
    lines = [uv_px[np.isfinite(uv_px).all(axis=1)] for uv_px in map(camera.project, outlines)]
    height, width = image.image.shape[:2]
    drawn = np.concatenate([np.zeros((0, 2)), *lines])
    inside = ((drawn >= 0.0) & (drawn < (width, height))).all(axis=1)
    around = drawn[inside] if inside.any() else np.array([[0.0, 0.0], [width - 1.0, height - 1.0]])
    canvas = Canvas.about(image.image, around, _SMALLEST_PX)
    for edge, uv_px in zip(edges.tolist(), lines, strict=True):
        canvas.line(uv_px, _DOUBTED_BGR if doubted[edge] else _SHARP_BGR, 3 if doubted[edge] else 1)
    Labels(canvas.picture).title("gripper at the reference (blue); what costs most (red)", why)
    return canvas.picture


def _line(
    camera: Camera, gripper: Gripper, cam_T_grip: Array, points_grip_m: Array, taught: TaughtEdges, edge: int
) -> tuple[Array, Array]:
    """The sharp edge's taught part (n, 2), px, and its shift across itself (n, 2)."""
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


_PAPER = 60
_JOINT_BGR = (200, 200, 200)


def draw_gripper(camera: Camera, gripper: Gripper, cam_T_grip: Array) -> Image:
    """Draw outlines orange, creases green, corners by name, other points grey."""
    paper = np.full((camera.height_px, camera.width_px), _PAPER, np.uint8)
    canvas = Canvas(paper, max(1, -(-_SMALLEST_PX // camera.width_px)))
    eye_grip_m = invert(cam_T_grip)[:3, 3]
    points_m = gripper.points_grip_m(None, eye_grip_m)
    view = gripper.edge_view(points_m, eye_grip_m)
    cam_m = points_m @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3]
    uv_px = camera.project(cam_m)
    lines = gripper.outlines_m(cam_m, np.arange(len(gripper.edge_ids)), 65, cam_T_grip[:3, :3])
    ends_seen: set[int] = set()
    for edge in np.flatnonzero(view.visible).tolist():
        a, b = gripper.edge_points[edge].tolist()
        line = camera.project(lines[edge])
        line = line[np.isfinite(line).all(axis=1) & (np.abs(line) < 1e4).all(axis=1)]
        if len(line) > 1:
            canvas.line(line, CREASE_BGR if view.crease[edge] else OUTLINE_BGR)
            ends_seen |= {a, b}
    corners = set(gripper.corner_points.tolist())
    labels = Labels(canvas.picture)
    labels.title(
        f"{gripper.name}: outlines (orange), creases (green), corners (yellow)",
        f"{int(view.visible.sum())} edges of {len(gripper.edge_ids)} show",
    )
    for p in sorted(ends_seen):
        if np.isfinite(uv_px[p]).all() and (np.abs(uv_px[p]) < 1e4).all():
            canvas.circle(uv_px[p], 5.0 if p in corners else 2.0, CORNER_BGR if p in corners else _JOINT_BGR)
            if p in corners:
                labels.put(gripper.point_ids[p], canvas.pixel(uv_px[p]), CORNER_BGR)
    return canvas.picture


class Labels:
    """Texts in a picture that neither overlap nor leave it; one that was moved away is tied to its point by a line."""

    def __init__(self, picture: Image) -> None:
        self._picture = picture
        self.boxes: list[tuple[int, int, int, int]] = []

    def title(self, *lines: str) -> None:
        """Write lines at the top, as large as fits."""
        width, top = self._picture.shape[1] - 2 * _MARGIN_PX, _MARGIN_PX
        for line in lines:
            scale = min(_TITLE, _TITLE * width / text_size(line, _TITLE)[0])
            across, up = text_size(line, scale)
            write(self._picture, line, (_MARGIN_PX, top + up), _TEXT_BGR, scale)
            self.boxes.append((_MARGIN_PX, top, _MARGIN_PX + across, top + up + _GAP_PX))
            top += up + 2 * _GAP_PX

    def put(self, text: str, at: tuple[int, int], colour: Colour) -> None:
        """Write a text beside a point (x, y), as close as there is room; to its right if there is none."""
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


_WIDTH_PX = 1400
_RESIDUALS_TO_PX = 25.0
_USED: Colour = (120, 220, 90)
_UNUSED: Colour = (70, 70, 250)
_MEASURED_BGR: Colour = (40, 220, 250)
_CAPTION_PX, _CAPTION_GREY = 36, 24
_AXES: tuple[tuple[str, Colour], ...] = (("x", (80, 80, 255)), ("y", (80, 230, 80)))


def draw_on_plate(image: Image, lens: LensSettings, found: Coincidence) -> Image:
    """The image, BGR and enlarged, with the plate's points (green, red if left out), the gripper's corners by name
    (yellow), and lines from where the calibration predicts each of them towards where it was measured, enlarged by the
    factor in the caption; the gripper's axes at the TCP.
    """
    canvas = Canvas(image, int(np.clip(round(_WIDTH_PX / lens.width_px), 1, 4)))
    residuals, used = found.plate.residuals_px[0], found.plate.used[0]
    sizes = np.linalg.norm(residuals[used], axis=1)
    largest_px = max(float(np.quantile(sizes, 0.95)), float(np.linalg.norm(found.residuals_px, axis=1).max()), 1e-6)
    enlarged = enlargement(largest_px, _RESIDUALS_TO_PX)
    for uv_px, residual, good in zip(found.sighting.uv_px, residuals, used.tolist(), strict=True):
        colour = _USED if good else _UNUSED
        canvas.circle(uv_px, 3.0, colour)
        if good:
            canvas.line(np.array([uv_px - residual, uv_px + (enlarged - 1) * residual]), colour)
    labels = Labels(canvas.picture)
    # The axes, a third of the corners' extent long.
    reach_m = 0.33 * float(np.abs(found.corners_m[:, :2]).max())
    ends_m = np.vstack([np.zeros(3), reach_m * np.eye(3)[:2]])
    axes_px = make_camera(lens).project(ends_m @ found.cam_T_grip[:3, :3].T + found.cam_T_grip[:3, 3])
    if np.isfinite(axes_px).all():
        for k, (name, colour) in enumerate(_AXES, start=1):
            canvas.line(axes_px[[0, k]], colour, thickness=2)
            labels.put(name, canvas.pixel(axes_px[k]), colour)
    for name, uv_px, residual in zip(found.corners.names, found.corners.uv_px, found.residuals_px, strict=True):
        canvas.circle(uv_px, 5.0, _MEASURED_BGR)
        canvas.line(np.array([uv_px - residual, uv_px + (enlarged - 1) * residual]), _MEASURED_BGR)
        labels.put(name, canvas.pixel(uv_px), _MEASURED_BGR)
    caption = (
        f"{int(used.sum())} points of the plate (green), {int(np.count_nonzero(~used))} left out (red), "
        f"{len(found.corners.names)} corners (yellow); residuals x {enlarged}"
    )
    strip = np.full((_CAPTION_PX, canvas.picture.shape[1], 3), _CAPTION_GREY, np.uint8)
    Labels(strip).title(caption)
    return np.vstack([canvas.picture, strip])
