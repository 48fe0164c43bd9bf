"""Images that show the gripper displaced are moved back to where the others show it."""

from __future__ import annotations

import cv2
import numpy as np

from gripmon.model.staying import Edges
from gripmon.teach.image_outline import _displaced, _moved_back
from gripmon.teach.matte import Matte
from gripmon.teach.silhouette import Stations, Transitions


def test_a_turned_image_is_moved_back_wherever_its_outline_shows() -> None:
    """Of an outline in view only one part may be measured, which isn't about the same centre as the whole."""
    shape, turn_rad, shift_px = (200, 300), 0.01, np.array([0.6, -0.4])
    rng = np.random.default_rng(5)
    usual = np.asarray(cv2.GaussianBlur(rng.uniform(0.0, 255.0, shape).astype(np.float32), (0, 0), 6.0), np.float32)
    matrix = np.array([[1.0, -turn_rad, shift_px[0]], [turn_rad, 1.0, shift_px[1]]])
    turned = cv2.warpAffine(usual, matrix, shape[::-1], flags=cv2.INTER_CUBIC)
    images = np.stack([turned, usual, usual]).astype(np.float32)

    angle = np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False)
    normal = np.column_stack([np.cos(angle), np.sin(angle)])
    uv_px = np.array([150.0, 100.0]) + normal * [100.0, 60.0]
    stations = Stations(uv_px, normal, np.ones(len(angle), bool))
    seen = np.zeros((3, len(angle)))
    seen[0] = ((uv_px @ matrix[:, :2].T + matrix[:, 2] - uv_px) * normal).sum(axis=1)
    usable = uv_px[:, 0] > 180.0
    none = np.zeros(len(angle))
    found = Transitions(none, none[None], usable, 0.7, seen, np.ones((3, len(angle))), np.ones(3), *3 * (none,))
    flat = np.zeros(shape, np.float32)
    edges = Edges(flat, flat, flat > 0, flat > 0, 0.0)
    matte = Matte(usual, flat > 0, edges, 1.0, images, np.zeros((3, 2)), (0, 1, 2), {})

    back = _moved_back(matte, _displaced(stations, found), uv_px[usable]).images
    inner = np.s_[20:-20, 20:-20]
    off, off_before = (np.abs(image[inner] - usual[inner]).max() for image in (back[0], turned))
    assert off < 0.1 * off_before
