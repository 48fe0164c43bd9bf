"""How large a shift is in terms of what it is known to, and how far it lies beyond those that are tolerated."""

from __future__ import annotations

import numpy as np

from gripmon.model.records import Array

SWEEPS = 8
"""Rounds over the axes; each can only come closer, and after none of them the answer is too small."""


def whitening(covariance: Array) -> Array:
    """(..., 6, 6) W with ``W C W' = 1``."""
    return np.linalg.inv(np.linalg.cholesky(covariance))


def times(matrix: Array, values: Array) -> Array:
    """(..., 6, 6) times (..., 6)."""
    return np.asarray((matrix @ values[..., None])[..., 0])


def square(whitening: Array, values: Array) -> Array:
    """(...) normalised squares of values (..., 6)."""
    white = times(whitening, values)
    return np.asarray((white * white).sum(axis=-1))


def square_beyond(whitening: Array, shift: Array, tolerated: Array) -> Array:
    """(...) smallest normalised square of ``shift`` (..., 6) less a shift within ``tolerated`` (6,) on every axis.

    ``whitening`` (..., 6, 6) is W with ``W C W' = 1``.  Errors of the axes belong together: what is tolerated on each
    axis by itself must not be taken off by itself, or what is left would be a shift that C takes to be impossible.
    Coordinate descent from both ends, nothing taken off and all of it; never more than the square of the shift itself.
    """
    precision = np.swapaxes(whitening, -1, -2) @ whitening
    best = np.full(shift.shape[:-1], np.inf)
    for start in (np.zeros_like(shift), np.clip(shift, -tolerated, tolerated)):
        taken = start
        for _ in range(SWEEPS):
            for axis in range(6):
                pull = (precision[..., axis, :] * (shift - taken)).sum(axis=-1) / precision[..., axis, axis]
                taken[..., axis] = np.clip(taken[..., axis] + pull, -tolerated[axis], tolerated[axis])
        best = np.minimum(best, square(whitening, shift - taken))
    return best
