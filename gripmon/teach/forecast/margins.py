"""How far fingertips are from the image's border, and how far the camera may move until too few of them are in view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gripmon.model.geometry import exp_rotation, make_transform
from gripmon.model.records import Array
from gripmon.teach.forecast.visibility import Rig, Sight, see

SOUGHT_M = 1.0
"""How far a shift of the camera is followed."""

SOUGHT_RAD = np.pi
"""How far a turn of the camera is followed."""

STEP_PX = 16.0
"""Image motion between two looks on the way: a gap in the view that is narrower than this may be passed over."""

_RATE_STEP = 1e-6
_HALVINGS = 24
_SIDES = ("left", "right", "top", "bottom")


@dataclass(frozen=True, slots=True)
class Border:
    """Distance of the visible corners from the image's border: the smallest on each side, px; and the smallest of all,
    with the corner and the side.
    """

    by_side_px: dict[str, float]
    smallest_px: float
    corner: str
    side: str


@dataclass(frozen=True, slots=True)
class Freedom:
    """How far the camera may move alone along each axis before the monitor can't measure any more.

    ``limits`` (6, 2): shift (m) along, then turn (rad) about the camera's own x, y, z, to the negative and to the
    positive side, all as amounts; NaN where the view suffices as far as was sought.  ``reasons`` (6 pairs) what is
    missing beyond.
    """

    limits: Array
    reasons: tuple[tuple[str | None, str | None], ...]


def moved_camera(cam_T_grip: Array, motion: Array) -> Array:
    """``cam_T_grip`` (4, 4) after the camera has shifted by ``motion[:3]`` (m) and turned about its own centre by the
    rotation vector ``motion[3:]`` (rad), both in the axes that it had before.
    """
    back = exp_rotation(motion[3:]).T
    return make_transform(back @ cam_T_grip[:3, :3], back @ (cam_T_grip[:3, 3] - motion[:3]))


def border(rig: Rig, sight: Sight) -> Border | None:
    """Where the visible corners come nearest to the image's border; None if no corner is visible."""
    if not sight.corners:
        return None
    which = np.flatnonzero(sight.visible)
    u, v = sight.uv_px[which].T
    distances = np.stack([u, rig.camera.width_px - 1.0 - u, v, rig.camera.height_px - 1.0 - v])
    side, corner = np.unravel_index(int(distances.argmin()), distances.shape)
    return Border(
        dict(zip(_SIDES, distances.min(axis=1).tolist(), strict=True)),
        float(distances.min()),
        rig.gripper.corner_ids[which[corner]],
        _SIDES[side],
    )


def freedom(rig: Rig, cam_T_grip: Array, jaw_opening_m: float | None) -> Freedom:
    """How far the camera may shift and turn along each of its axes while the jaws stand at an opening."""
    limits, reasons = np.full((6, 2), np.nan), []
    for axis in range(6):
        pair: list[str | None] = []
        for k, sign in enumerate((-1.0, 1.0)):
            way = np.zeros(6)
            way[axis] = sign
            limits[axis, k], reason = _limit(rig, cam_T_grip, jaw_opening_m, way)
            pair.append(reason)
        reasons.append((pair[0], pair[1]))
    return Freedom(limits, tuple(reasons))


def sideways_m(rig: Rig, cam_T_grip: Array, jaw_opening_m: float | None) -> float:
    """The shortest shift of the camera along its x or y, either way, after which the monitor can't measure; infinite
    for none.  Found in steps that are coarser than those of :func:`freedom`, to a hundredth of a step.
    """
    ways = np.concatenate([np.eye(6)[:2], -np.eye(6)[:2]])
    limits = [_limit(rig, cam_T_grip, jaw_opening_m, way, 4.0 * STEP_PX, halvings=7)[0] for way in ways]
    return float(np.nan_to_num(limits, nan=np.inf).min())


def _limit(
    rig: Rig,
    cam_T_grip: Array,
    jaw_opening_m: float | None,
    way: Array,
    step_px: float = STEP_PX,
    halvings: int = _HALVINGS,
) -> tuple[float, str | None]:
    """The amount of a motion ``way`` (6,), a unit along one axis, after which the view doesn't suffice, and why; NaN
    for never.
    """
    sought = SOUGHT_M if way[:3].any() else SOUGHT_RAD
    good, bad = 0.0, 0.0
    sight = see(rig, cam_T_grip, jaw_opening_m)
    while sight.enough:
        if bad >= sought:
            return float("nan"), None
        good = bad
        bad = min(bad + _step(rig, cam_T_grip, jaw_opening_m, way, good, sight, step_px), sought)
        sight = see(rig, moved_camera(cam_T_grip, bad * way), jaw_opening_m)
    for _ in range(halvings if bad > 0.0 else 0):
        middle = 0.5 * (good + bad)
        there = see(rig, moved_camera(cam_T_grip, middle * way), jaw_opening_m)
        if there.enough:
            good = middle
        else:
            bad, sight = middle, there
    return bad, sight.reason


def _step(
    rig: Rig, cam_T_grip: Array, jaw_opening_m: float | None, way: Array, amount: float, sight: Sight, step_px: float
) -> float:
    """How much farther moves the visible corners by ``step_px`` at most."""
    gripper = rig.gripper
    points_m = gripper.points_grip_m(jaw_opening_m)[gripper.corner_points[sight.visible]]
    pose = moved_camera(cam_T_grip, (amount + _RATE_STEP) * way)
    moved_px = rig.camera.project(points_m @ pose[:3, :3].T + pose[:3, 3]) - sight.uv_px[sight.visible]
    rate = float(np.nanmax(np.linalg.norm(moved_px, axis=1), initial=0.0)) / _RATE_STEP
    # Near the lens's axis a shift along it moves nothing, yet.
    farthest = (0.05 if way[3:].any() else 0.02) * (1.0 if way[3:].any() else 1.0 + 50.0 * amount)
    return min(step_px / max(rate, 1e-12), farthest)
