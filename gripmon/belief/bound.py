"""Where the gripper is, by all hypotheses, and how far off that may be at a stated risk.  Compiled."""

from __future__ import annotations

import math

import numpy as np

from gripmon.belief.keep import same_place
from gripmon.belief.state import SIZE, Bank
from gripmon.model.compiled import compiled
from gripmon.model.records import Array

SPLIT_M, SPLIT_RAD = 1e-5, 1e-4
"""Added to each sigma in squares, for what dropping the ties between rows makes too certain (measured with 17 states).
"""
LAPLACE = 1.3
"""The two shorter axes, integrated out around the longest, give at most so many times their share (1.28 by
quadrature)."""
_HALVINGS = 24  # of at most 40 sigmas: to a part in 400,000 of a sigma


@compiled
def place(bank: Bank, n: int, mean: Array) -> None:
    """``mean`` (23,) becomes that of all of ``n`` hypotheses that say the same as the heaviest, whatever they doubt: it
    doesn't jump between doubts.
    """
    best = 0
    for h in range(n):
        if bank.log_weight[h] > bank.log_weight[best]:
            best = h
    total = 0.0
    for j in range(SIZE):
        mean[j] = 0.0
    for h in range(n):
        if h == best or same_place(bank.mean[best], bank.covariance[best], bank.mean[h], bank.covariance[h]):
            weight = math.exp(bank.log_weight[h])
            total += weight
            for j in range(SIZE):
                mean[j] += weight * bank.mean[h, j]
    for j in range(SIZE):
        mean[j] /= total


@compiled
def tail(z: float, spread: float) -> float:
    """At most the probability that an error in three dimensions is longer than ``z`` of its longest axis' sigmas; the
    other axes add the factor ``spread``, never more than three equal axes.
    """
    one = math.erfc(z / math.sqrt(2.0))
    return min(LAPLACE * spread * one, one + math.sqrt(2.0 / math.pi) * z * math.exp(-0.5 * z * z), 1.0)


@compiled
def level(weights: Array, away: Array, sigma: Array, spread: Array, risk: float) -> float:
    """The length that the error exceeds with probability ``risk``: sum of weights tail((L - away) / sigma)."""
    low, high = 0.0, 0.0
    for h in range(len(weights)):
        high = max(high, away[h] + 40.0 * sigma[h])
    for _ in range(_HALVINGS):
        middle, total = 0.5 * (low + high), 0.0
        for h in range(len(weights)):
            total += weights[h] * tail(max(middle - away[h], 0.0) / sigma[h], spread[h])
        if total > risk:
            low = middle
        else:
            high = middle
    return high


@compiled
def bound(bank: Bank, n: int, mean: Array, asked: Array, floor: float, risk: float) -> float:
    """Bound on the length of ``asked`` g (``asked`` (3, 23)) about that of ``mean`` (23,); infinite without a risk."""
    if risk <= 0.0:
        return math.inf
    weights, away, sigma, spread = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    covariance = np.empty((3, 3))
    for h in range(n):
        weights[h], square = math.exp(bank.log_weight[h]), 0.0
        for i in range(3):
            shift = 0.0
            for j in range(SIZE):
                shift += asked[i, j] * (bank.mean[h, j] - mean[j])
            square += shift * shift
            for k in range(3):
                total = floor * floor if i == k else 0.0
                for j in range(SIZE):
                    if asked[i, j] != 0.0:
                        for m in range(SIZE):
                            total += asked[i, j] * bank.covariance[h, j, m] * asked[k, m]
                covariance[i, k] = total
        values = np.linalg.eigvalsh(covariance)
        away[h], sigma[h] = math.sqrt(square), math.sqrt(values[2])
        # P(|e| > L) is erfc times this for a long L (Laplace): the two other axes, independent, integrated out.
        narrow = (1.0 - values[1] / values[2]) * (1.0 - values[0] / values[2])
        spread[h] = 1.0 / math.sqrt(max(narrow, 1e-6))
    return level(weights, away, sigma, spread, risk)
