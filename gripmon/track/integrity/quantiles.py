"""How far a vector with a known covariance lies at most, but for a stated probability."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import stats

from gripmon.model.records import Array

_LOG_RISK = np.linspace(-14.0, 0.0, 281)
_SQUARES = stats.chi2.isf(10.0**_LOG_RISK, np.array([[1.0], [3.0]]))

LARGEST_LOG_FACTOR = 14.0
"""By how much two equal axes would raise the tail of the third, as a power of ten: more than any risk has."""


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
        return cls(np.sqrt(largest), np.minimum(-0.5 * np.log10(left).sum(axis=-1), LARGEST_LOG_FACTOR))

    def radius(self, risk: Array) -> Array:
        """Lengths that are exceeded with the probabilities ``risk``."""
        log_risk = np.log10(np.maximum(risk, 1e-300))
        one = np.interp(log_risk - self.factor, _LOG_RISK, _SQUARES[0])
        three = np.interp(log_risk, _LOG_RISK, _SQUARES[1])
        return np.asarray(self.sigma * np.sqrt(np.minimum(one, three)))

    def beyond(self, radius: Array) -> Array:
        """Probabilities of lengths above ``radius``; 1 for a negative one."""
        square = np.square(np.maximum(radius, 0.0) / self.sigma)
        # The tables run from the improbable to the certain: their squares fall.
        one = np.interp(square, _SQUARES[0, ::-1], _LOG_RISK[::-1]) + self.factor
        three = np.interp(square, _SQUARES[1, ::-1], _LOG_RISK[::-1])
        return np.asarray(10.0 ** np.minimum(one, three))


def bounds(covariance: Array, risk: Array) -> Array:
    """(n,) radii that normal errors with the covariances (n, 3, 3) exceed with the probabilities ``risk`` (n,)."""
    return Tails.of(covariance).radius(risk)
