"""A curve along a whole finger, in a large image, has no more points than a gripper file holds."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from gripmon.model.camera import BrownConradyLens, make_camera
from gripmon.model.gripper.model import MOST_VIA
from gripmon.teach.curved_edges import smooth_curve

MIDDLE, RADIUS_PX = np.array([640.0, 700.0]), 300.0


def on_arc(turn: np.ndarray) -> np.ndarray:
    return MIDDLE + RADIUS_PX * np.column_stack([np.cos(turn), -np.sin(turn)])


def test_a_long_curve_is_thinned_and_stays_where_it_is() -> None:
    camera = make_camera(
        BrownConradyLens(width_px=1280, height_px=720, fx_px=1000.0, fy_px=1000.0, cx_px=640.0, cy_px=360.0)
    )
    v, u = np.indices((720, 1280))
    out_px = np.hypot(u - MIDDLE[0], v - MIDDLE[1]) - RADIUS_PX
    covered = np.clip(0.5 - out_px / 2.0, 0.0, 1.0)
    images = np.array([level + (60.0 - level) * covered for level in (10.0, 120.0, 150.0, 200.0, 250.0)], np.float32)
    seen: Any = SimpleNamespace(matte=SimpleNamespace(images=images, noise=1.0), blur_px=0.8)
    pieces = on_arc(np.linspace(0.2, np.pi - 0.2, 81))
    uv_px, _ = smooth_curve(camera, seen, covered > 0.5, pieces, (False, False))
    assert len(uv_px) == MOST_VIA + 2
    away = np.abs(np.linalg.norm(uv_px - MIDDLE, axis=1) - RADIUS_PX)
    assert away.max() < 0.2
    assert np.linalg.norm(np.diff(uv_px, axis=0), axis=1).max() < 2.0 * 0.875 * np.pi * RADIUS_PX / MOST_VIA
