"""How far a knock moves a camera's mount: a mixture of normal distributions, in place of "anywhere".

Brackets slip by millimetres.  The sizes approximate a log-normal length of 3 mm in the median, for four of five knocks
from 1 to 10 mm (assumed before anything was measured here; mounts that were hit in this project's own recordings moved
by 0.9 to 4.5 mm).  One knock in three goes along the fingers and doesn't turn the camera: what the fingers' sides can't
show has its own share, so that it isn't taken for improbable because it is special.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from gripmon.model.records import Array

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


_ANYWHERE = np.stack([np.diag([sigma_m**2] * 3 + [TURN_SIGMA_RAD**2] * 3) for sigma_m in ANY_SIGMA_M])


def log_likely(shift_m: Array) -> Array:
    """(n,) natural logarithms of how likely knocks in any direction shift the TCP by ``shift_m`` (n, 3), over that of
    no shift at all.
    """
    sigma = np.array(ANY_SIGMA_M)
    density = np.array(ANY_SHARE) / sigma**3
    beyond = 0.5 * np.square(shift_m).sum(axis=1)[:, None] / sigma**2
    return np.asarray(logsumexp(-beyond, axis=1, b=density / density.sum()))


class Knocks(NamedTuple):
    """Kinds of knocks, c of them: how probable each is once there is one, ``share`` (c,), and the ``covariance``
    (c, 6, 6) of the motion, ``along`` (c,) those along the fingers.
    """

    share: Array
    covariance: Array
    along: NDArray[np.bool_]

    @classmethod
    def of(cls, axis_cam: Array) -> Knocks:
        """With fingers in the direction ``axis_cam`` (3,), camera frame; zero: all knocks go anywhere."""
        length = float(np.linalg.norm(axis_cam))
        if length == 0.0:
            return cls(np.array(ANY_SHARE), _ANYWHERE, np.zeros(len(ANY_SHARE), dtype=np.bool_))
        count = len(ANY_SHARE) + len(ALONG_SHARE)
        covariance, way = np.zeros((count, 6, 6)), axis_cam / length
        covariance[: len(ANY_SHARE)] = _ANYWHERE
        covariance[len(ANY_SHARE) :, :3, :3] = np.square(ALONG_SIGMA_M)[:, None, None] * np.outer(way, way)
        share = [(1.0 - ALONG_OF_ALL) * np.array(ANY_SHARE), ALONG_OF_ALL * np.array(ALONG_SHARE)]
        return cls(np.concatenate(share), covariance, np.arange(count) >= len(ANY_SHARE))

    @property
    def spread(self) -> Array:
        """(6, 6) covariance of the motion by any knock."""
        return np.asarray(np.einsum("c,cij->ij", self.share, self.covariance))
