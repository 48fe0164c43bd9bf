"""What a hypothesis remembers of each row given g, compiled: how it fades, moves with g, and learns.

h hypotheses, e edges with two rows each, k states of a row; everything else as in :class:`~gripmon.belief.state.Bank`.
"""

from __future__ import annotations

import math

import numpy as np

from gripmon.belief.state import (
    LIGHT,
    SIZE,
    Bank,
    Seen,
)
from gripmon.model.compiled import compiled
from gripmon.model.records import Array

LEAST_APART = 1e-8
"""Standard deviation, m and rad, of what p gains in a frame beside d: of rows it changes 1e-10 px^2."""


@compiled
def root_of(matrix: Array, root: Array) -> float:
    """Cholesky's lower ``root`` (n, n) of a positive ``matrix``; half the logarithm of its determinant, NaN if it isn't
    positive.
    """
    half = 0.0
    for i in range(len(matrix)):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= root[i, k] * root[j, k]
            if j < i:
                root[i, j] = rest / root[j, j]
            elif rest > 0.0:
                root[i, i] = math.sqrt(rest)
                half += math.log(root[i, i])
            else:
                return math.nan
        for j in range(i + 1, len(matrix)):
            root[i, j] = 0.0
    return half


@compiled
def forward(root: Array, values: Array) -> None:
    """``values`` (n,) become root^-1 values."""
    for i in range(len(root)):
        total = values[i]
        for k in range(i):
            total -= root[i, k] * values[k]
        values[i] = total / root[i, i]


@compiled
def backward(root: Array, values: Array) -> None:
    """``values`` (n,) become root^-T values."""
    for i in range(len(root) - 1, -1, -1):
        total = values[i]
        for k in range(i + 1, len(root)):
            total -= root[k, i] * values[k]
        values[i] = total / root[i, i]


@compiled
def move(bank: Bank, h: int, lag: float, light: float) -> None:
    """p goes ``lag`` of the way to d, and the light keeps a share: both ways can be undone, so each row keeps exactly
    what it knew.
    """
    mean, covariance, slope = bank.mean[h], bank.covariance[h], bank.slope[h]
    for i in range(6, 12):
        mean[i] += lag * (mean[i - 6] - mean[i])
    mean[LIGHT] *= light
    for j in range(SIZE):
        for i in range(6, 12):
            covariance[i, j] += lag * (covariance[i - 6, j] - covariance[i, j])
        covariance[LIGHT, j] *= light
    for i in range(SIZE):
        for j in range(6, 12):
            covariance[i, j] += lag * (covariance[i, j - 6] - covariance[i, j])
        covariance[i, LIGHT] *= light
    for i in range(6):  # without creep p comes so near d that the covariance would have no root
        covariance[6 + i, 6 + i] += LEAST_APART**2
    for q in range(slope.shape[0]):
        for k in range(slope.shape[1]):
            own = slope[q, k]  # A g = A F^-1 g'
            for i in range(6, 12):
                own[i] /= 1.0 - lag
                own[i - 6] -= lag * own[i]
            own[LIGHT] /= light


@compiled
def gains(covariance: Array, factor: Array, gain: Array, between: Array, root: Array) -> None:
    """What adding noise B'B (``factor`` B (r, 23)) to g does: ``covariance`` becomes P' = P + B'B, ``gain`` (r, 23) is
    B P'^-1, and ``between`` (r, r) is 1 - B P'^-1 B', the covariance of the noise once g' is known.
    """
    r = len(factor)
    for i in range(SIZE):
        for j in range(SIZE):
            for k in range(r):
                covariance[i, j] += factor[k, i] * factor[k, j]
    root_of(covariance, root)
    for k in range(r):
        for i in range(SIZE):
            gain[k, i] = factor[k, i]
        forward(root, gain[k])
        backward(root, gain[k])
    for k in range(r):
        for m in range(r):
            total = 1.0 if k == m else 0.0
            for i in range(SIZE):
                total -= gain[k, i] * factor[m, i]
            between[k, m] = total


@compiled
def shift_row(mean: Array, factor: Array, gain: Array, slope: Array, along: Array) -> float:
    """Change one state's ``slope`` (23,) to what it is given g' = g + w, and return how its offset changes; ``along``
    (r,) receives slope B', by which the noise is in it.
    """
    moved = 0.0
    for k in range(len(factor)):
        total = 0.0
        for i in range(SIZE):
            total += slope[i] * factor[k, i]
        along[k] = total
    for k in range(len(factor)):
        at = 0.0
        for i in range(SIZE):
            at += gain[k, i] * mean[i]
            slope[i] -= along[k] * gain[k, i]
        moved += along[k] * at
    return moved


@compiled
def add_noise(bank: Bank, h: int, mean: Array, covariance: Array, factor: Array) -> None:
    """g gets noise with covariance B'B (``factor`` B (r, 23)): each row keeps its joint law with g', exactly.  What the
    noise ties between rows is dropped (p takes most of it).  Of g that is before it, ``mean`` (23,) and ``covariance``
    (23, 23), the latter becomes that after it.
    """
    r, states = len(factor), bank.offset.shape[2]
    gain, between, root = np.empty((r, SIZE)), np.empty((r, r)), np.empty((SIZE, SIZE))
    along = np.empty((states, r))
    gains(covariance, factor, gain, between, root)
    for q in range(bank.offset.shape[1]):
        for k in range(states):
            bank.offset[h, q, k] += shift_row(mean, factor, gain, bank.slope[h, q, k], along[k])
        for k in range(states):
            for m in range(states):
                total = 0.0
                for i in range(r):
                    for j in range(r):
                        total += along[k, i] * between[i, j] * along[m, j]
                bank.spread[h, q, k, m] += total


@compiled
def strength_of(seen: Seen, edge: int, row: int) -> float:
    """Variance of the background's error of one of an edge's rows: of errors that are independent along it, that of the
    slope times half the length is three times that of the offset.
    """
    return seen.strength[edge] * (3.0 if row == 1 else 1.0)


@compiled
def fade(bank: Bank, h: int, seen: Seen) -> None:
    """The errors before the backgrounds that are behind the edges now: as like them as the pictures are."""
    for q in range(bank.offset.shape[1]):
        edge = q // 2
        if seen.found[edge] == 0:
            continue
        s, rho = 1 + seen.background[edge], seen.likeness[edge]
        bank.offset[h, q, s] *= rho
        for i in range(SIZE):
            bank.slope[h, q, s, i] *= rho
        for k in range(bank.offset.shape[2]):
            bank.spread[h, q, s, k] *= rho
            bank.spread[h, q, k, s] *= rho
        bank.spread[h, q, s, s] += (1.0 - rho * rho) * strength_of(seen, edge, q % 2)


@compiled
def learn(bank: Bank, h: int, seen: Seen, edge: int, of: int) -> None:
    """Both rows of an edge that is taken for the gripper's own, ``of`` the lines there."""
    states, s = bank.offset.shape[2], 1 + seen.background[edge]
    gain, line = np.empty(states), np.empty(SIZE)
    for row in range(2):
        q = 2 * edge + row
        offset, slope, spread = bank.offset[h, q], bank.slope[h, q], bank.spread[h, q]
        variance = spread[0, 0] + 2.0 * spread[0, s] + spread[s, s] + seen.white[edge, of, row]
        missing = seen.lines[edge, of, row] - offset[0] - offset[s]
        for i in range(SIZE):
            line[i] = seen.rows[edge, of, row, i] + slope[0, i] + slope[s, i]
        for k in range(states):
            gain[k] = spread[k, 0] + spread[k, s]
        for k in range(states):
            share = gain[k] / variance
            offset[k] += share * missing
            for i in range(SIZE):
                slope[k, i] -= share * line[i]
            for m in range(states):
                spread[k, m] -= share * gain[m]


@compiled
def log_sum(a: float, b: float) -> float:
    """log(exp(a) + exp(b))."""
    return max(a, b) + math.log1p(math.exp(-abs(a - b)))


@compiled
def normal(missing: float, variance: float) -> float:
    """Log density."""
    return -0.5 * (missing * missing / variance + math.log(2.0 * math.pi * variance))
