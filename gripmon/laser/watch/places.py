"""Poses that pulses come from: an arm and a lens are off by the same at each of them again and again."""

from __future__ import annotations

import numpy as np

from gripmon.laser.watch.beliefs import PLACES
from gripmon.model.geometry import rotation_angle
from gripmon.model.records import Array

SAME_M, SAME_RAD = 5e-3, 0.02
"""How far apart poses of one place are at most: less than what an arm's error changes over."""


class Places:
    """The last places, each with the first pose (4, 4) that was seen there."""

    def __init__(self) -> None:
        self._poses: dict[int, Array] = {}  # least recently visited first

    @property
    def poses(self) -> tuple[Array, ...]:
        """Of all places, the last visited one last."""
        return tuple(self._poses.values())

    def find(self, base_T_ee: Array) -> int | None:
        """The index of a pose's place; it is the last visited one from now on."""
        for place, pose in reversed(self._poses.items()):
            near = float(np.linalg.norm(pose[:3, 3] - base_T_ee[:3, 3])) <= SAME_M
            if near and rotation_angle(pose[:3, :3].T @ base_T_ee[:3, :3]) <= SAME_RAD:
                self._poses[place] = self._poses.pop(place)
                return place
        return None

    def take(self, base_T_ee: Array) -> int:
        """A place for a pose that has none, an older one's if there is none left."""
        place = len(self._poses) if len(self._poses) < PLACES else next(iter(self._poses))
        self._poses.pop(place, None)
        self._poses[place] = base_T_ee.copy()
        return place
