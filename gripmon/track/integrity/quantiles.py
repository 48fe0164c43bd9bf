"""How far a vector with a known covariance lies at most, but for a stated probability."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from gripmon.model.records import Array

LOG_RISK_SPACING = 0.05
_LOG_RISK = -LOG_RISK_SPACING * np.arange(281.0)
SQUARES = chdtri(np.array([[1.0], [3.0]]), 10.0**_LOG_RISK)
"""(2, 281) squares that normal errors along one axis, and along three equal ones, exceed with the probabilities 1 to
1e-14, in even steps of their logarithm.
"""

GUIDE_STEP = 0.25
_STEPS = np.arange(0.0, SQUARES.max(), GUIDE_STEP)
GUIDE = np.stack([np.searchsorted(row, _STEPS, side="right").clip(1, len(row) - 1) - 1 for row in SQUARES])
"""(2, n) where a square's place in the table is found from on, for each :data:`GUIDE_STEP`."""


class Tails(NamedTuple):
    """How probably normal vectors are longer than something: ``sigma`` (...,) along the longest axis of each, and the
    power of ten ``factor`` (...,) by which the two others raise the tail of that one.

    With variances ``v`` along the axes, the largest ``v_1``, the square of the length exceeds ``v_1 t`` for large ``t``
    with the probability of one axis alone times ``prod (1 - v_j / v_1)^(-1/2)`` (Zolotarev 1961), and never with more
    than that of three axes as long as the longest: the smaller of both is taken.  Exact for one axis and for three
    equal ones; else too small by up to a factor of 1.3 (1 % of the length), or too large.  A probability below 1e-14
    counts as that.
    """

    sigma: Array
    factor: Array

    @classmethod
    def of(cls, covariance: Array) -> Tails:
        """Of the covariances (..., 3, 3)."""
        variance = np.maximum(np.linalg.eigvalsh(covariance), 0.0)
        largest = np.maximum(variance[..., 2], 1e-300)
        left = np.maximum(1.0 - variance[..., :2] / largest[..., None], 1e-12)
        return cls(np.sqrt(largest), -0.5 * np.log10(left).sum(axis=-1))

    def radius(self, risk: Array) -> Array:
        """Lengths that are exceeded with the probabilities ``risk``."""
        log_risk = np.log10(np.maximum(risk, 1e-300))
        # The tables run from the certain to the improbable.
        one = np.interp(self.factor - log_risk, -_LOG_RISK, SQUARES[0])
        three = np.interp(-log_risk, -_LOG_RISK, SQUARES[1])
        return np.asarray(self.sigma * np.sqrt(np.minimum(one, three)))


def bounds(covariance: Array, risk: Array) -> Array:
    """(n,) radii that normal errors with the covariances (n, 3, 3) exceed with the probabilities ``risk`` (n,)."""
    return Tails.of(covariance).radius(risk)
