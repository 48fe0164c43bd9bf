"""Where a person would put the corners of two fingertips for ``gripmon calibrate plane --infer``, a few pixels off."""

from __future__ import annotations

import numpy as np

from gripmon.model.camera import Camera
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array

_CONTACT_M = 2e-4
"""So close to the foremost point a point touches the plate."""
_RISE = 0.35
"""Of the rising edge's length: some way up, where the edge still shows."""


def rough_corners(
    camera: Camera, gripper: Gripper, cam_T_grip: Array, jaw_opening_m: float, rng: np.random.Generator, off_px: float
) -> tuple[dict[str, Array], dict[str, Array]]:
    """True pixels (2,) and rough ones, up to ``off_px`` off in u and v, by the names for a gripper without a file:
    ``left_inner_near`` and so on, the left finger on the left of the image and the near side above.  ValueError where
    two fingertips of three corners or more don't stand on one plane.
    """
    points = gripper.points_grip_m(jaw_opening_m)
    uv = camera.project(points @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3])
    touching = points[:, 2] > points[:, 2].max() - _CONTACT_M
    tips = [np.flatnonzero(touching & (gripper.point_finger == k)) for k in range(len(gripper.finger_ids))]
    if len(tips) != 2 or min(map(len, tips)) < 3:
        raise ValueError("gripper: standing on a plate takes two fingertips with three corners or more in one plane")
    out = {}
    for side, tip in zip(("left", "right"), sorted(tips, key=lambda t: float(uv[t, 0].mean())), strict=True):
        near, far = sorted(tip[np.argsort(np.abs(points[tip, 0]))[:2]], key=lambda k: float(uv[k, 1]))
        outer = min(set(tip.tolist()) - {near, far}, key=lambda k: float(np.abs(points[k, 1] - points[near, 1])))
        out[f"{side}_inner_near"], out[f"{side}_inner_far"] = uv[near], uv[far]
        out[f"{side}_outer_near"] = uv[outer]
        foot, top = points[far], points[_above(gripper, far, touching)]
        rise = (cam_T_grip[:3, :3] @ (foot + _RISE * (top - foot)) + cam_T_grip[:3, 3])[None]
        out[f"{side}_rise_far"] = camera.project(rise)[0]
    return out, {name: at + rng.uniform(-off_px, off_px, 2) for name, at in out.items()}


def _above(gripper: Gripper, foot: int, touching: Array) -> int:
    """The other end of the edge that rises from a corner."""
    for a, b in gripper.edge_points.tolist():
        if foot in (a, b) and not touching[b if a == foot else a]:
            return int(b if a == foot else a)
    raise ValueError(f"gripper: no edge rises from {gripper.point_ids[foot]}")
