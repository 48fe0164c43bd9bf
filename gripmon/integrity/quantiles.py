"""How far a vector with a known covariance lies at most, but for a stated probability."""

from __future__ import annotations

import numpy as np
from scipy import stats

from gripmon.records import Array

_LOG_RISK = np.linspace(-14.0, 0.0, 281)
_SQUARES = stats.chi2.isf(10.0**_LOG_RISK, np.array([[1.0], [3.0]]))

LARGEST_LOG_FACTOR = 14.0
"""By how much two equal axes would raise the tail of the third, as a power of ten: more than any risk has."""


def bounds(covariance: Array, risk: Array) -> Array:
    """(n,) radii that normal errors with the covariances (n, 3, 3) exceed with the probabilities ``risk`` (n,).

    With variances ``v`` along the axes, the largest ``v_1``, the square of the length exceeds ``v_1 t`` for large ``t``
    with the probability of one axis alone times ``prod (1 - v_j / v_1)^(-1/2)`` (Zolotarev 1961), and never with more
    than that of three axes as long as the longest: the smaller bound is taken.  Exact for one axis and for three equal
    ones; else up to 1.3 times as probable as stated (the bound 1 % too short), or less.  A risk below 1e-14 counts as
    that.
    """
    variance = np.maximum(np.linalg.eigvalsh(covariance), 0.0)
    largest = np.maximum(variance[:, 2], 1e-300)
    left = np.maximum(1.0 - variance[:, :2] / largest[:, None], 1e-12)
    factor = np.minimum(-0.5 * np.log10(left).sum(axis=1), LARGEST_LOG_FACTOR)
    log_risk = np.log10(np.maximum(risk, 1e-300))
    one = np.interp(log_risk - factor, _LOG_RISK, _SQUARES[0])
    three = np.interp(log_risk, _LOG_RISK, _SQUARES[1])
    return np.asarray(np.sqrt(largest * np.minimum(one, three)))
