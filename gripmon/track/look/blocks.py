"""Blocks of pixels inside the fingers: where they may lie, how a motion shows in them, and which tell most of it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array
from gripmon.track.look.layout import BORDER_PX, finger_depths_m

BLOCK_PX = 8
"""Side of a block, px; its outermost pixels only serve for gradients."""

INNER = np.arange(BLOCK_PX**2).reshape(BLOCK_PX, BLOCK_PX)[1:-1, 1:-1].ravel()
"""Places of a block's inner pixels among all of its."""


def blocks_in(
    camera: Camera, gripper: Gripper, cam_T_grip: Array, jaw_opening_m: float | None
) -> tuple[Array, NDArray[np.uint16]]:
    """Points (p, n, 3), gripper frame, of all blocks that lie inside a finger; and (p, 3) column and row of their first
    pixel, and the number of the finger.
    """
    depths = finger_depths_m(camera, gripper, cam_T_grip, jaw_opening_m)
    nearest = np.fmin.reduce(depths)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * BORDER_PX + 1,) * 2)
    points, places = [np.zeros((0, BLOCK_PX**2, 3))], [np.zeros((0, 3), dtype=np.uint16)]
    reach = np.arange(BLOCK_PX)
    within = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    for f, depth_m in enumerate(depths):
        own = (np.isfinite(depth_m) & (depth_m <= nearest)).astype(np.uint8)
        own = np.asarray(cv2.erode(own, disc, borderType=cv2.BORDER_CONSTANT, borderValue=0), dtype=np.uint8)
        rows, columns = (np.arange(0, size - BLOCK_PX + 1, BLOCK_PX) for size in own.shape)
        corner = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 1, 2)
        block = corner + within
        block = block[own[block[..., 1], block[..., 0]].all(axis=1)]
        flat = block.reshape(-1, 2)
        xy = camera.undistort(flat.astype(float))
        z_m = depth_m[flat[:, 1], flat[:, 0]]
        place = (np.column_stack([xy, np.ones(len(xy))]) * z_m[:, None] - cam_T_grip[:3, 3]) @ cam_T_grip[:3, :3]
        place = place.reshape(-1, BLOCK_PX**2, 3)
        sound = np.isfinite(place).all(axis=(1, 2))
        points.append(place[sound])
        first = block[sound, 0]
        places.append(np.column_stack([first, np.full(len(first), f)]).astype(np.uint16))
    return np.concatenate(points), np.concatenate(places)


def gradients(mean: Array) -> tuple[Array, Array]:
    """(p, inner) each, of blocks (p, n): central differences, as of the interpolation between pixels."""
    square = mean.reshape(-1, BLOCK_PX, BLOCK_PX)
    across = 0.5 * (square[:, 1:-1, 2:] - square[:, 1:-1, :-2])
    down = 0.5 * (square[:, 2:, 1:-1] - square[:, :-2, 1:-1])
    return across.reshape(len(mean), -1), down.reshape(len(mean), -1)


def jacobian_of(mean: Array, flow: Array, weight: Array) -> Array:
    """(p, inner, 7): how a motion changes what blocks (p, n) show where they were, less gain and offset of light."""
    gradient = np.stack(gradients(mean), axis=-1)
    out = -np.einsum("pnk,pnkj->pnj", gradient, flow[:, INNER])
    weight, mean = weight[:, INNER], mean[:, INNER]
    total = np.maximum(weight.sum(axis=1), 1e-300)[:, None]
    learnt = mean - (weight * mean).sum(axis=1, keepdims=True) / total
    out -= np.einsum("pn,pnj->pj", weight, out)[:, None] / total[:, None]
    own = np.maximum((weight * learnt**2).sum(axis=1), 1e-300)[:, None]
    out -= learnt[..., None] * (np.einsum("pn,pnj->pj", weight * learnt, out) / own)[:, None]
    return np.ascontiguousarray(out)


def most_telling(jacobian: Array, weight: Array, most: int) -> NDArray[np.intp]:
    """Blocks that together tell most of the weakest motions: each in turn adds most to the information's determinant.

    The opening is left out: it is mostly known.
    """
    of_block = np.einsum("pn,pni,pnj->pij", weight, jacobian[..., :6], jacobian[..., :6])
    whole = of_block.sum(axis=0)
    so_far = np.diag(np.maximum(whole.diagonal(), 1e-12)) * (1e-3 / max(len(weight), 1))
    left = np.ones(len(weight), dtype=bool)
    for _ in range(min(most, len(weight))):
        gain = np.einsum("ij,pij->p", np.linalg.inv(so_far), of_block)
        best = int(np.argmax(np.where(left, gain, -1.0)))
        left[best] = False
        so_far = so_far + of_block[best]
    return np.flatnonzero(~left)
