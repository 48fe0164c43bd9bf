"""How far a vector with a known covariance lies at most, but for a stated probability."""

from __future__ import annotations

import math

import numpy as np
from scipy import stats

from gripmon.records import Array

_FREEDOM = np.linspace(1.0, 3.0, 9)
_LOG_RISK = np.linspace(-12.0, math.log10(0.9), 121)
_BEYOND = (stats.chi2.isf(10.0 ** _LOG_RISK[:, None], _FREEDOM) - _FREEDOM) / np.sqrt(2.0 * _FREEDOM)


def bounds(covariance: Array, risk: Array) -> Array:
    """(n,) radii that normal errors with the covariances (n, 3, 3) exceed with the probabilities ``risk`` (n,).

    The square of the length is a weighted sum of chi-squares; a shifted and scaled chi-square with the same mean,
    variance and skewness stands in for it (Hall 1983; Buckley and Eagleson 1988): exact for one direction and for two
    or three equal ones, else too short by 4 % at most down to 1e-7 and by 6 % down to 1e-12 (without the skewness by 8
    and 14 %).  A risk below 1e-12 counts as that, one of 0.9 and more as 0.9.
    """
    trace = np.einsum("nii->n", covariance)
    square = np.einsum("nij,nij->n", covariance, covariance)
    cube = np.einsum("nij,nij->n", covariance @ covariance, covariance)
    ratio = square / np.maximum(cube, 1e-300)
    freedom = np.minimum(np.maximum(square * ratio * ratio, 1.0), 3.0)
    step = _LOG_RISK[1] - _LOG_RISK[0]
    row = (np.log10(np.maximum(risk, 1e-300)) - _LOG_RISK[0]) / step
    row = np.minimum(np.maximum(row, 0.0), len(_LOG_RISK) - 1.001)
    column = np.minimum((freedom - 1.0) / (_FREEDOM[1] - _FREEDOM[0]), len(_FREEDOM) - 1.001)
    i, j = row.astype(int), column.astype(int)
    f, g = row - i, column - j
    table = _BEYOND
    near, far = (
        table[i, j] + g * (table[i, j + 1] - table[i, j]),
        table[i + 1, j] + g * (table[i + 1, j + 1] - table[i + 1, j]),
    )
    return np.sqrt(np.maximum(trace + np.sqrt(2.0 * square) * (near + f * (far - near)), 0.0))
