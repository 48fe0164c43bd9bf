"""How far a mean shift lies beyond those that are tolerated, in terms of what it is known to."""

from __future__ import annotations

import numpy as np

from gripmon.records import Array

SWEEPS = 8
"""Rounds over the axes; each can only come closer, and after none of them the answer is too small."""


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
        left = (whitening @ (shift - taken)[..., None])[..., 0]
        best = np.minimum(best, (left * left).sum(axis=-1))
    return best
