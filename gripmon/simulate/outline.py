"""How much of each finger's outline can be seen: what there is to see of it, less what something else hides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array
from gripmon.simulate.bodies import Bodies
from gripmon.simulate.scene import SceneState
from gripmon.simulate.solids import hidden_by

_POINTS_PER_EDGE = 24


@dataclass(frozen=True, slots=True)
class OutlineSeen:
    """Shares (f,) of each finger's edges: of those of its tip, and of all of them in the image.

    1 where nothing but the gripper itself hides any; edges that the gripper hides don't count.
    """

    tips: Array
    edges: Array


class Outline:
    """Points on the edges of a gripper's model; only contours, so that a wrong model is judged by the true one."""

    def __init__(self, gripper: Gripper) -> None:
        share = (np.arange(_POINTS_PER_EDGE) + 0.5) / _POINTS_PER_EDGE
        start, end = gripper.edge_points.T
        corner = np.zeros(len(gripper.point_finger), dtype=bool)
        corner[gripper.corner_points] = True
        self._start, self._end = np.repeat(start, _POINTS_PER_EDGE), np.repeat(end, _POINTS_PER_EDGE)
        self._share = np.tile(share, len(start))[:, None]
        self._tip = corner[self._start] & corner[self._end]
        self._finger = gripper.point_finger[self._start]
        self._fingers = len(gripper.finger_ids)

    def seen(self, camera: Camera, bodies: Bodies, state: SceneState) -> OutlineSeen:
        """Shares in a scene's state."""
        grip = state.points_grip_m
        points = (1.0 - self._share) * grip[self._start] + self._share * grip[self._end]
        points = points @ state.cam_T_grip[:3, :3].T + state.cam_T_grip[:3, 3]
        uv = camera.project(points)
        with np.errstate(invalid="ignore"):
            inside = (uv >= 0.0).all(axis=1) & (uv <= (camera.width_px - 1.0, camera.height_px - 1.0)).all(axis=1)
        own, other = np.zeros(len(points), dtype=bool), bodies.covered(state, points)
        for body in bodies.placed(state):
            if bodies.is_gripper(body.solid):
                own |= hidden_by(body, points)
            else:
                other |= hidden_by(body, points)
        tips = self._shares(~own & self._tip, ~other & inside)
        return OutlineSeen(tips, self._shares(~own & inside, ~other))

    def _shares(self, there: NDArray[np.bool_], seen: NDArray[np.bool_]) -> Array:
        total = np.bincount(self._finger, there, self._fingers)
        return np.bincount(self._finger, there & seen, self._fingers) / np.maximum(total, 1.0)
