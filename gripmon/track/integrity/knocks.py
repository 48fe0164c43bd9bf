"""How a camera's mount may have moved since it was seen: it creeps, it vibrates, and rarely it is knocked.

How far a knock moves it is a mixture of normal distributions, in place of "anywhere".

Brackets slip by millimetres.  The sizes approximate a log-normal length of 3 mm in the median, for four of five knocks
from 1 to 10 mm (assumed before anything was measured here; mounts that were hit in this project's own recordings moved
by 0.9 to 4.5 mm).  One knock in three goes along the fingers and doesn't turn the camera: what the fingers' sides can't
show has its own share, so that it isn't taken for improbable because it is special.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from gripmon.model.compiled import compiled
from gripmon.model.least_squares import CONTRADICTION_SQUARE
from gripmon.model.records import Array
from gripmon.model.symmetric import diagonalise

ANY_SHARE = (0.40, 0.45, 0.15)
ANY_SIGMA_M = (1.3e-3, 2.6e-3, 5.5e-3)
"""Of knocks in any direction: how many have which standard deviation along each axis, m."""

TURN_SIGMA_RAD = 0.02
"""Standard deviation of the turn of these about each axis, rad."""

ALONG_SHARE = (0.35, 0.45, 0.20)
ALONG_SIGMA_M = (1.7e-3, 3.8e-3, 8.5e-3)
"""Of knocks along the fingers: likewise, m; nothing across them, and no turn."""

ALONG_OF_ALL = 1.0 / 3.0
"""Share of the knocks along the fingers."""

VIBRATION_FRAMES = 20.0
"""Proven frames over which the mount's vibration is learnt."""

KNOCK_UNSEEN_PROBABILITY = 1e-3
"""Probability that the mount was knocked where nothing has shown it: while something hides the fingers' ends, since the
gripper touches things then, and between the reference's images and the first frame.  A policy, once for each such
occlusion, since the average rate of knocks is too low for both (docs/integrity.md).
"""


def log_likely(shift_m: Array) -> Array:
    """(n,) natural logarithms of how likely knocks in any direction shift the TCP by ``shift_m`` (n, 3), over that of
    no shift at all.
    """
    sigma = np.array(ANY_SIGMA_M)
    density = np.array(ANY_SHARE) / sigma**3
    beyond = 0.5 * np.square(shift_m).sum(axis=1)[:, None] / sigma**2
    return np.asarray(logsumexp(-beyond, axis=1, b=density / density.sum()))


@compiled
def kinds_of(axis_cam: Array) -> tuple[Array, Array, NDArray[np.bool_], Array]:
    """Kinds of knocks, c of them, with fingers in the direction ``axis_cam`` (3,), camera frame; zero: all go anywhere.
    How probable each is once there is one (c,), the covariance (c, 6, 6) of the motion, whether it goes along the
    fingers (c,), and the covariance (6, 6) of the motion by any knock.
    """
    square, anywhere = 0.0, len(ANY_SHARE)
    for i in range(3):
        square += axis_cam[i] * axis_cam[i]
    count, others = (anywhere + len(ALONG_SHARE), 1.0 - ALONG_OF_ALL) if square > 0.0 else (anywhere, 1.0)
    share, covariance, along = np.empty(count), np.zeros((count, 6, 6)), np.zeros(count, np.bool_)
    spread = np.zeros((6, 6))
    for c in range(count):
        along[c] = c >= anywhere
        share[c] = ALONG_OF_ALL * ALONG_SHARE[c - anywhere] if along[c] else others * ANY_SHARE[c]
        for i in range(6):
            if c < anywhere:
                covariance[c, i, i] = ANY_SIGMA_M[c] ** 2 if i < 3 else TURN_SIGMA_RAD**2
            elif i < 3:
                for k in range(3):
                    covariance[c, i, k] = ALONG_SIGMA_M[c - anywhere] ** 2 * axis_cam[i] * axis_cam[k] / square
        spread += share[c] * covariance[c]
    return share, covariance, along, spread


@compiled
def least_known(covariance: Array, axis: Array, cosine: float) -> Array:
    """(3,) the direction in which a fit with the ``covariance`` (6, 6) knows a position least, if its angle to the
    ``axis`` (3,) has more than this ``cosine``; else the axis.
    """
    matrix, vectors, most = covariance[:3, :3].copy(), np.empty((3, 3)), 0
    diagonalise(matrix, vectors)
    for k in range(1, 3):
        if matrix[k, k] > matrix[most, most]:
            most = k
    along, length = 0.0, 0.0
    for k in range(3):
        along += vectors[k, most] * axis[k]
        length += axis[k] * axis[k]
    return vectors[:, most].copy() if abs(along) > cosine * math.sqrt(length) else axis


def swinging(swing: Array, way: Array, noise: Array) -> Array:
    """(6,) variance of the mount's vibration after one more ``way`` (6,) between consecutive poses; ``noise`` (6,):
    variances that the poses' own errors add to it, which is taken off.  Negative where there happens to be less.
    """
    # A knock is not a vibration, but what rings after it is.
    most = CONTRADICTION_SQUARE * (noise + np.maximum(swing, 0.0))
    return np.asarray(swing + (np.minimum(np.square(way), most) - noise - swing) / VIBRATION_FRAMES)


class Mount:
    """The motions that one mount is expected to make."""

    def __init__(self, creep: Array, jumps_per_month: float, play: Sequence[float]):
        """``creep`` (6,): variance that its slow motion grows by in a second, m² and rad²; ``play`` (6,): standard
        deviations of where it stands, to and fro, from one pose of the arm to another, m and rad.
        """
        self._creep, self._jumps_per_s = creep, jumps_per_month / (30.0 * 86_400.0)
        self._play: Array = np.square(play)
        self._swing: Array = np.zeros(6)
        self.swing: Array = self._swing
        """(6,) variance of the way between proven poses that their errors don't explain, m² and rad²: vibration."""
        self.to_and_fro: Array = self._play
        """(6,) variance of where it stands from one frame to another, but for creep and knocks, m² and rad²: it
        vibrates, and with the next pose of the arm goes on to another place of its play, however long it stood still.
        """

    def learn(self, way: Array, noise: Array) -> None:
        """Learn the vibration from the ``way`` (6,) between two proven poses, ``noise`` (6,) as :func:`swinging`."""
        self._swing = swinging(self._swing, way, noise)
        self.swing = np.maximum(self._swing, 0.0)
        self.to_and_fro = np.maximum(self.swing, self._play)

    def creep(self, elapsed_s: float) -> Array:
        """(6,) variance of the slow motion in a time; a clock that was set back is no time."""
        return np.asarray(self._creep * max(elapsed_s, 0.0))

    def knocked(self, elapsed_s: float, hidden: bool) -> float:
        """Probability of a knock in a time; ``hidden``: something hides what would show it."""
        return max(self._jumps_per_s * elapsed_s, KNOCK_UNSEEN_PROBABILITY if hidden else 0.0)
