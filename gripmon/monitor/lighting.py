"""How much the light at the fingers has changed: what shifts an edge into the dark by the shading beside it does so as
long as that shading stays.
"""

from __future__ import annotations

import math

import numpy as np

from gripmon.belief.state import Ints
from gripmon.model.records import Array
from gripmon.track.edges import Measurement

ANOTHER_LIGHT = math.log(2.0)
"""Change of the logarithm of grey levels by which a light is another one: a stop, of the two or three that lamp, shade
and hand make of a workplace.  Small changes shift edges in proportion.
"""
DARKEST = 8.0
"""Grey level under which shading isn't told by its logarithm: several times the noise of a camera."""


def own_side(look: Measurement, finger_of: Ints, lies_on: Ints, count: int) -> Ints:
    """(s,) on which side of each of ``count`` edges its finger lies, 0 or 1, along a search line; ``finger_of`` (s,),
    ``lies_on`` (n,) the edge of each search line.
    """
    p, out = look.prediction, np.zeros(count, np.int64)
    finger = finger_of[lies_on]
    for f in np.unique(finger):
        centre = p.uv_px[finger == f].mean(axis=0)
        for edge in np.unique(lies_on[finger == f]):
            of_edge = lies_on == edge
            inwards = centre - p.uv_px[of_edge].mean(axis=0)
            out[edge] = int(inwards @ p.normal[of_edge].mean(axis=0) > 0.0)
    return out


class Lighting:
    """Of one gripper: what its edges' own sides looked like when the present light began."""

    def __init__(self) -> None:
        self._then: Array | None = None
        self._kept = 1.0

    def kept(self, grey: Array, noise: float) -> float:
        """Which share of the light's shift in the last frame is left, by the ``grey`` levels (s, p) beside the edges
        on their own sides, NaN where none is seen, each with standard deviation ``noise``.
        """
        now = np.maximum(grey.mean(axis=1), DARKEST)
        if self._then is None:
            self._then = now
            return 1.0
        both = np.isfinite(now) & np.isfinite(self._then)
        if not both.any():
            return 1.0
        change = np.log(now[both] / self._then[both])
        by_noise = 2.0 * noise**2 / (grey.shape[1] * now[both] ** 2)
        square = max(float(np.median(np.square(change) - by_noise)), 0.0)  # of a few something lies in front
        before, self._kept = self._kept, math.exp(-0.5 * square / ANOTHER_LIGHT**2)
        self._then = np.where(np.isfinite(self._then), self._then, now)
        out = min(self._kept / before, 1.0)
        if square > ANOTHER_LIGHT**2:  # what follows is compared with this one
            self._then, self._kept = now, 1.0
        return out
