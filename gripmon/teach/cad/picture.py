"""A gripper model drawn as a camera sees it."""

from __future__ import annotations

import numpy as np

from gripmon.model.camera import Camera
from gripmon.model.geometry import invert
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Image
from gripmon.teach.drawing import CORNER_BGR, CREASE_BGR, OUTLINE_BGR, Canvas, Labels

_PAPER = 60
_JOINT_BGR = (200, 200, 200)
_WIDTH_PX = 1200


def draw_gripper(camera: Camera, gripper: Gripper, cam_T_grip: Array) -> Image:
    """Draw outlines orange, creases green, corners by name, other points grey."""
    paper = np.full((camera.height_px, camera.width_px), _PAPER, np.uint8)
    canvas = Canvas(paper, max(1, -(-_WIDTH_PX // camera.width_px)))
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
