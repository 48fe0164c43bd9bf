"""How much of each finger's outline is visible in a simulated frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array
from gripmon.simulate import Simulator
from gripmon.simulate.solids import hidden_by

_POINTS_PER_EDGE = 24


@dataclass(frozen=True, slots=True)
class OutlineSeen:
    """Visible shares (f,) of each finger's edges: of those of its tip, and of all that are in the image.

    1 if nothing but the gripper itself hides any; edges hidden by the gripper don't count.
    """

    tips: Array
    edges: Array


def outline_seen(simulator: Simulator, index: int) -> OutlineSeen:
    """Of points on the edges of the gripper's model; contours only, so that a wrong model is judged by the true one."""
    gripper, camera, bodies, state = simulator.gripper, simulator.camera, simulator.bodies, simulator.state(index)
    start, end = np.repeat(gripper.edge_points, _POINTS_PER_EDGE, axis=0).T
    share = np.tile((np.arange(_POINTS_PER_EDGE) + 0.5) / _POINTS_PER_EDGE, len(gripper.edge_points))[:, None]
    points = (1.0 - share) * state.points_grip_m[start] + share * state.points_grip_m[end]
    points = points @ state.cam_T_grip[:3, :3].T + state.cam_T_grip[:3, 3]
    uv = camera.project(points)
    with np.errstate(invalid="ignore"):
        inside = (uv >= 0.0).all(axis=1) & (uv <= (camera.width_px - 1.0, camera.height_px - 1.0)).all(axis=1)
    own, other = np.zeros(len(points), dtype=bool), bodies.covered(state, points)
    for body in bodies.placed(state):
        if any(body.solid is solid for solid in (*bodies.fingers, *bodies.carriers)):
            own |= hidden_by(body, points)
        else:
            other |= hidden_by(body, points)
    tip = np.isin(start, gripper.corner_points) & np.isin(end, gripper.corner_points)
    finger, fingers = gripper.point_finger[start], len(gripper.finger_ids)

    def shares(there: NDArray[np.bool_], seen: NDArray[np.bool_]) -> Array:
        total = np.bincount(finger, there, fingers)
        return np.bincount(finger, there & seen, fingers) / np.maximum(total, 1.0)

    return OutlineSeen(shares(~own & tip, ~other & inside), shares(~own & inside, ~other))
