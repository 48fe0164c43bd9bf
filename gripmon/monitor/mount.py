"""How a camera's mount may have moved since it was seen: it creeps, it vibrates, and rarely it is knocked."""

from __future__ import annotations

import numpy as np

from gripmon.model.least_squares import CONTRADICTION_SQUARE
from gripmon.model.records import Array
from gripmon.monitor.settings import MonitorSettings

VIBRATION_FRAMES = 20.0
"""Proven frames over which the mount's vibration is learnt."""

KNOCK_UNSEEN_PROBABILITY = 1e-3
"""Probability that the mount was knocked where nothing has shown it: while something hides the fingers' ends, since the
gripper touches things then, and between the reference's images and the first frame.  A policy, once for each such
occlusion, since the average rate of knocks is too low for both (docs/integrity.md).
"""


def swinging(swing: Array, way: Array, noise: Array) -> Array:
    """(6,) variance of the mount's vibration after one more ``way`` (6,) between consecutive poses; ``noise`` (6,):
    variances that the poses' own errors add to it, which is taken off.  Negative where there happens to be less.
    """
    # A knock is not a vibration, but what rings after it is.
    most = CONTRADICTION_SQUARE * (noise + np.maximum(swing, 0.0))
    return np.asarray(swing + (np.minimum(np.square(way), most) - noise - swing) / VIBRATION_FRAMES)


class Mount:
    """The motions that one mount is expected to make."""

    def __init__(self, settings: MonitorSettings):
        creep = settings.smoothing
        self._creep = np.square([creep.creep_m_per_sqrt_s] * 3 + [creep.creep_rad_per_sqrt_s] * 3)
        self._jumps_per_s = settings.policy.mount_jumps_per_month / (30.0 * 86_400.0)
        self._swing: Array = np.zeros(6)

    @property
    def swing(self) -> Array:
        """(6,) variance of the way between proven poses that their errors don't explain, m² and rad²: vibration."""
        return np.maximum(self._swing, 0.0)

    def learn(self, way: Array, noise: Array) -> None:
        """Learn the vibration from the ``way`` (6,) between two proven poses, ``noise`` (6,) as :func:`swinging`."""
        self._swing = swinging(self._swing, way, noise)

    def creep(self, elapsed_s: float) -> Array:
        """(6,) variance of the slow motion in a time; a clock that was set back is no time."""
        return np.asarray(self._creep * max(elapsed_s, 0.0))

    def knocked(self, elapsed_s: float, hidden: bool) -> float:
        """Probability of a knock in a time; ``hidden``: something hides what would show it."""
        return max(self._jumps_per_s * elapsed_s, KNOCK_UNSEEN_PROBABILITY if hidden else 0.0)
