"""Which pixels of a gripper are looked at: small patches on its fingers, and some beside them for the background."""

from __future__ import annotations

import importlib
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.geometry import invert
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array

PATCH_SIDE_POINTS = 4
"""Points along a patch's side: a shade, two slopes of light and 13 numbers of texture."""

POINTS = PATCH_SIDE_POINTS * PATCH_SIDE_POINTS

PITCH_PX = 3.0
"""Between points, px: the lens blurs by 0.6 px (sigma), so that nearer ones tell the same."""

MOST_PATCHES = 96
"""On a finger while it is learnt; the most telling ones are kept."""

MOST_BACKGROUND_PATCHES = 16
"""Beside a finger: enough to tell a third of them from a half."""

BORDER_PX = 3
"""Patches keep this far inside the finger, px: its model is right to about a pixel, and the lens blurs."""

BESIDE_PX = (6, 40)
"""From where to where beside a finger the background is looked at, px: clear of its border, and near it."""

EDGE_SAMPLES = 17
"""Points on each edge between which the depth of a finger without faces is interpolated."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Patches of :data:`POINTS` points each, row by row.

    ``points_grip_m`` (n, POINTS, 3) at the opening of the layout; ``finger`` (n,) with which they move; ``guard`` (n,):
    the patch lies beside the finger, at its mean depth.
    """

    points_grip_m: Array
    finger: NDArray[np.intp]
    guard: NDArray[np.bool_]


def get_ready(gripper: Gripper) -> None:
    """Import now what a finger without faces needs: at a frame it would take as long as dozens of frames."""
    if {face.finger for face in gripper.faces} != set(range(len(gripper.finger_ids))):
        importlib.import_module("scipy.interpolate")


def lay_out(camera: Camera, gripper: Gripper, cam_T_grip: Array, jaw_opening_m: float | None) -> Layout:
    """Patches for a gripper seen at ``cam_T_grip`` (4, 4); none for a finger that doesn't show, or is too small."""
    depths = finger_depths_m(camera, gripper, cam_T_grip, jaw_opening_m)
    anywhere = np.any([np.isfinite(d) for d in depths], axis=0).astype(np.uint8)
    free = 1 - _dilated(anywhere, BESIDE_PX[0])
    points, finger, guard = [], [], []
    for f, depth_m in enumerate(depths):
        shown = np.isfinite(depth_m).astype(np.uint8)
        if not shown.any():
            continue
        uv_px = _patches_in(1 - _dilated(1 - shown, BORDER_PX), MOST_PATCHES)
        u, v = np.rint(uv_px).astype(int).T
        beside_px = _patches_in(_dilated(shown, BESIDE_PX[1]) & free, MOST_BACKGROUND_PATCHES)
        z_m = np.append(depth_m[v, u], np.full(len(beside_px), np.nanmean(depth_m)))
        xy = camera.undistort(np.concatenate([uv_px, beside_px]))
        place = (np.column_stack([xy, np.ones(len(xy))]) * z_m[:, None] - cam_T_grip[:3, 3]) @ cam_T_grip[:3, :3]
        points.append(place.reshape(-1, POINTS, 3))
        finger.append(np.full(len(points[-1]), f))
        guard.append(np.arange(len(points[-1])) >= len(uv_px) // POINTS)
    if not points:
        return Layout(np.zeros((0, POINTS, 3)), np.zeros(0, dtype=np.intp), np.zeros(0, dtype=bool))
    every, whose, aside = np.concatenate(points), np.concatenate(finger), np.concatenate(guard)
    sound = np.isfinite(every).all(axis=(1, 2))
    return Layout(every[sound], whose[sound], aside[sound])


def finger_depths_m(camera: Camera, gripper: Gripper, cam_T_grip: Array, jaw_opening_m: float | None) -> list[Array]:
    """Depth (h, w) of each finger's nearest surface at every pixel, NaN beside it."""
    points_grip_m = gripper.points_grip_m(jaw_opening_m)
    points_cam_m = points_grip_m @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3]
    visible = gripper.edge_view(points_grip_m, invert(cam_T_grip)[:3, 3]).visible
    return [_finger_depth_m(camera, gripper, points_cam_m, visible, f) for f in range(len(gripper.finger_ids))]


def _dilated(mask: NDArray[np.uint8], radius_px: int) -> NDArray[np.uint8]:
    """Grown by a disc, whose time goes by the pixels that are looked at: those about what is to grow."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius_px + 1,) * 2)
    left, top, width, height = cv2.boundingRect(mask)
    about = np.s_[
        max(top - radius_px, 0) : top + height + radius_px, max(left - radius_px, 0) : left + width + radius_px
    ]
    grown = np.zeros_like(mask)
    grown[about] = cv2.dilate(mask[about], disc)
    return grown


def _patches_in(mask: NDArray[np.uint8], most: int) -> Array:
    """Points (p * POINTS, 2), px, of patches side by side that lie wholly inside a mask, ``most`` evenly chosen."""
    height, width = mask.shape
    step = PATCH_SIDE_POINTS * PITCH_PX
    reach = np.arange(PATCH_SIDE_POINTS) * PITCH_PX
    corner = np.stack(np.meshgrid(np.arange(0, width - step, step), np.arange(0, height - step, step)), axis=-1)
    own = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    uv_px = corner.reshape(-1, 1, 2) + own
    index = np.rint(uv_px).astype(int)
    uv_px = uv_px[mask[index[..., 1], index[..., 0]].all(axis=1)]
    if len(uv_px) > most:
        uv_px = uv_px[np.linspace(0, len(uv_px) - 1, most).round().astype(int)]
    return np.asarray(uv_px.reshape(-1, 2), dtype=float)


def _finger_depth_m(
    camera: Camera, gripper: Gripper, points_cam_m: Array, visible: NDArray[np.bool_], finger: int
) -> Array:
    """Depth (h, w) of a finger's nearest surface at every pixel, NaN beside it."""
    faces = [face.points for face in gripper.faces if face.finger == finger]
    depth_m = np.full((camera.height_px, camera.width_px), np.nan)
    if not faces:
        edges = gripper.edge_points[visible & (gripper.edge_finger == finger)]
        _fill_between_edges(camera, points_cam_m[edges], depth_m)
    for loop in faces:
        corners = points_cam_m[loop]
        normal = np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0)
        if normal @ corners.mean(axis=0) >= 0.0:  # it looks away
            continue
        u, v = _pixels_within(camera, corners)
        xy = camera.undistort(np.column_stack([u, v]).astype(float))
        with np.errstate(divide="ignore", invalid="ignore"):
            z_m = (normal @ corners.mean(axis=0)) / (xy @ normal[:2] + normal[2])
        depth_m[v, u] = np.fmin(depth_m[v, u], np.where(z_m > 0.0, z_m, np.nan))
    return depth_m


def _pixels_within(camera: Camera, corners_cam_m: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Columns and rows of the pixels inside a polygon; none where part of it lies outside the lens."""
    uv_px = camera.project(corners_cam_m)
    mask = np.zeros((camera.height_px, camera.width_px), dtype=np.uint8)
    # Beyond some thousand pixels OpenCV's fixed-point polygons overflow.
    if np.isfinite(uv_px).all() and np.abs(uv_px).max() < 30000.0:
        cv2.fillPoly(mask, [np.rint(uv_px).astype(np.int32)], 1)
    v, u = np.nonzero(mask)
    return u, v


def _fill_between_edges(camera: Camera, ends_cam_m: Array, depth_m: Array) -> None:
    """Depths (h, w) inside the hull of a finger's visible edges (e, 2, 3), which has no faces: exact on planes that its
    edges surround.
    """
    share = np.linspace(0.0, 1.0, EDGE_SAMPLES)[:, None, None]
    along = ((1.0 - share) * ends_cam_m[:, 0] + share * ends_cam_m[:, 1]).reshape(-1, 3)
    uv_px = camera.project(along)
    sound = np.isfinite(uv_px).all(axis=1)
    along, uv_px = along[sound], uv_px[sound]
    if len(along) < PATCH_SIDE_POINTS:
        return
    from scipy.interpolate import LinearNDInterpolator
    from scipy.spatial import QhullError

    # One over the depth is linear in ideal coordinates on a plane.
    try:
        inverse = LinearNDInterpolator(along[:, :2] / along[:, 2:], 1.0 / along[:, 2])
    except QhullError:  # all on one line: the finger is seen from its end, or edge-on
        return
    v, u = np.mgrid[0 : camera.height_px, 0 : camera.width_px].reshape(2, -1)
    low, high = uv_px.min(axis=0), uv_px.max(axis=0)
    near = (u >= low[0]) & (u <= high[0]) & (v >= low[1]) & (v <= high[1])
    u, v = u[near], v[near]
    if len(u):
        depth_m[v, u] = 1.0 / inverse(camera.undistort(np.column_stack([u, v]).astype(float)))
