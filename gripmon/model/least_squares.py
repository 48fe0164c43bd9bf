"""Robust non-linear least squares, also on manifolds: the one minimiser of the off-line methods.

Levenberg-Marquardt (Marquardt, "An algorithm for least-squares estimation of nonlinear parameters", 1963) with columns
scaled to unit length, so that metres, radians and pixels can be mixed.  A problem provides its cost and equations as
functions of its own state type (an array, a transform, several of them); ``retract`` moves a state by a step, on the
manifold if it lies on one.  Costs are sums of squared whitened residuals, or of a robust loss of them.

``scipy.optimize.least_squares`` does the same for plain vectors with dense Jacobians, without normal equations
assembled view by view; problems of that kind use it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Generic, TypeVar

import numpy as np
from scipy.special import chdtri

from gripmon.model.records import Array

S = TypeVar("S")
Equations = tuple[Array, Array]
"""Normal matrix ``JᵀWJ`` (p, p) and right-hand side ``JᵀWr`` (p,), r measured less predicted."""

TUKEY = 4.685
"""Residual, in standard deviations, beyond which Tukey's biweight is zero: 95 % efficiency for normal errors (Holland
and Welsch, "Robust regression using iteratively reweighted least-squares", 1977).
"""
_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-4, 1e-12, 1e12
_DETERMINED = 1e13
"""Condition number of scaled normal equations above which the solution is rounding noise (doubles have 16 digits)."""


@dataclass(frozen=True, slots=True)
class Minimum(Generic[S]):
    """Result of a minimisation: the best ``state`` with its ``cost``, also where the iterations ran out."""

    state: S
    cost: float


def chi_square_limit(chance: float, dimensions: int = 6) -> float:
    """Squared normalised length that ``dimensions`` normal errors exceed with probability ``chance``."""
    return float(chdtri(dimensions, chance))


def joint_weight(covariance: Array) -> Array:
    """Inverse of a covariance (n d, n d), also where each d numbers have one of their own: (n, d, d).

    Not by ``scipy.linalg.block_diag``: importing it takes 0.05 s and 7 MB of every monitor.
    """
    if covariance.ndim == 2:
        return np.asarray(np.linalg.inv(covariance))
    count, size = covariance.shape[:2]
    weight = np.zeros((count, size, count, size))
    weight[range(count), :, range(count)] = np.linalg.inv(covariance)
    return weight.reshape(count * size, count * size)


CONTRADICTION_SQUARE = chi_square_limit(1e-5)
"""Gate for six numbers that should agree: noise exceeds it once in 100,000 frames, the default integrity risk."""


def minimise(
    start: S,
    cost: Callable[[S], float],
    equations: Callable[[S], Equations],
    retract: Callable[[S, Array], S],
    *,
    iterations: int = 100,
    tolerance: float = 1e-10,
    damping: float = _DAMPING,
) -> Minimum[S]:
    """The state near ``start`` with the least cost.

    A forbidden state costs infinity (or NaN) and is never accepted.  Stops when the cost decreases by less than a
    fraction ``tolerance``, or when that little is predicted of a step that fails.  A small ``damping`` makes this
    Gauss-Newton.  Directions that the equations don't determine are left alone.
    """
    state, current = start, cost(start)
    for _ in range(iterations):
        normal, side = equations(state)
        size = np.sqrt(np.maximum(normal.diagonal(), 1e-300))
        scaled, wanted = normal / np.outer(size, size), side / size
        while True:
            step = np.linalg.solve(scaled + damping * np.eye(len(size)), wanted)
            trial = retract(state, step / size)
            new = cost(trial)
            if new < current:
                break
            if damping >= _MOST_DAMPING or step @ (wanted + damping * step) <= tolerance * current:
                return Minimum(state, current)
            damping *= 10.0
        gain = current - new
        state, current, damping = trial, new, max(0.1 * damping, _LEAST_DAMPING)
        if gain <= tolerance * current:
            break
    return Minimum(state, current)


def fit(
    start: S,
    linearised: Callable[[S], tuple[Array, Array]],
    retract: Callable[[S, Array], S],
    *,
    iterations: int = 20,
    tolerance: float = 1e-12,
) -> Minimum[S]:
    """:func:`minimise` for a small problem with a good start: ``linearised`` gives whitened Jacobian rows (m, p) or (n,
    d, p), and residuals (m,) or (n, d), measured less predicted.
    """

    def cost(state: S) -> float:
        return float(np.square(linearised(state)[1]).sum())

    def equations(state: S) -> Equations:
        return normal_equations(*linearised(state))

    return minimise(start, cost, equations, retract, iterations=iterations, tolerance=tolerance, damping=_LEAST_DAMPING)


def normal_equations(rows: Array, values: Array, weights: Array | None = None) -> Equations:
    """From whitened Jacobian rows (n, d, p) and residuals (n, d), or (m, p) and (m,), with ``weights`` (n,)."""
    if weights is not None:
        root = np.sqrt(weights)
        rows, values = rows * root.reshape(-1, *[1] * (rows.ndim - 1)), values * root[:, None]
    a, b = rows.reshape(-1, rows.shape[-1]), values.ravel()
    return a.T @ a, a.T @ b


def covariance_of(normal: Array, variance: float = 1.0) -> Array:
    """(p, p), ``variance`` times the inverse of a normal matrix.  :class:`numpy.linalg.LinAlgError` if it leaves a
    direction undetermined.
    """
    size = np.sqrt(np.maximum(normal.diagonal(), 1e-300))
    scaled = normal / np.outer(size, size)
    if not np.isfinite(scaled).all() or np.linalg.cond(scaled) > _DETERMINED:
        raise np.linalg.LinAlgError("the equations leave a direction undetermined")
    out: Array = variance * np.linalg.inv(scaled) / np.outer(size, size)
    return out


def whitening(covariance: Array) -> Array:
    """(..., d, d) matrix that makes errors with a covariance (..., d, d) independent with unit variance."""
    out: Array = np.linalg.inv(np.linalg.cholesky(covariance))
    return out


def tukey_weights(sizes: Array, width: float) -> Array:
    """Weights (n,) for residuals with norms ``sizes`` (n,): Tukey's biweight, 0 from ``width`` to infinity."""
    out: Array = np.square(1.0 - np.square(np.minimum(sizes / width, 1.0)))
    return out


def tukey_cost(sizes: Array, width: float) -> float:
    """The sum of the loss that belongs to :func:`tukey_weights`: squared for small norms, ``width²/3`` at most."""
    return float((width**2 / 3.0 * (1.0 - (1.0 - np.square(np.minimum(sizes / width, 1.0))) ** 3)).sum())


def robust_scale(sizes: Array, dimensions: int) -> float:
    """Standard deviation of one coordinate, from the norms (n,) of residual vectors with ``dimensions`` coordinates:
    the median norm over the chi distribution's median; up to half of them may be outliers.
    """
    return float(np.median(sizes)) / _chi_median(dimensions)


@cache
def _chi_median(dimensions: int) -> float:
    return float(np.sqrt(chdtri(dimensions, 0.5)))
