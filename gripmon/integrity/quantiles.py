"""How far a vector with a known covariance lies at most, but for a stated probability."""

from __future__ import annotations

import math

import numpy as np
from scipy import stats

from gripmon.records import Array

_FREEDOM = np.linspace(1.0, 3.0, 9)
_LOG_RISK = np.linspace(-12.0, math.log10(0.9), 121)
_RADIUS_SQUARE = stats.chi2.isf(10.0 ** _LOG_RISK[:, None], _FREEDOM) / _FREEDOM


def bounds(covariance: Array, risk: Array) -> Array:
    """(n,) radii that normal errors with the covariances (n, 3, 3) exceed with the probabilities ``risk`` (n,).

    The square of the length is a weighted sum of chi-squares; a scaled chi-square with the same mean and variance
    stands in for it (Satterthwaite 1946): exact for one direction and for three equal ones.  A risk below 1e-12 counts
    as that, one of 0.9 and more as 0.9.
    """
    trace = np.einsum("nii->n", covariance)
    square = np.einsum("nij,nij->n", covariance, covariance)
    freedom = np.minimum(np.maximum(trace * trace / np.maximum(square, 1e-300), 1.0), 3.0)
    step = _LOG_RISK[1] - _LOG_RISK[0]
    row = (np.log10(np.maximum(risk, 1e-300)) - _LOG_RISK[0]) / step
    row = np.minimum(np.maximum(row, 0.0), len(_LOG_RISK) - 1.001)
    column = np.minimum((freedom - 1.0) / (_FREEDOM[1] - _FREEDOM[0]), len(_FREEDOM) - 1.001)
    i, j = row.astype(int), column.astype(int)
    f, g = row - i, column - j
    table = _RADIUS_SQUARE
    near, far = (
        table[i, j] + g * (table[i, j + 1] - table[i, j]),
        table[i + 1, j] + g * (table[i + 1, j + 1] - table[i + 1, j]),
    )
    return np.sqrt(trace * (near + f * (far - near)))
