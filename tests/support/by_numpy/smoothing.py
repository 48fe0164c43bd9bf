"""What ``judge.smoothing`` compiles, by NumPy."""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dposv

from gripmon.model.records import Array


def _gain(mine: Array, other: Array, innovation: Array) -> tuple[Array, float]:
    """Gain (6, 6) of a measurement with the covariance ``other`` and the ``innovation`` (6,), to a state with ``mine``;
    and the innovation's normalised square, negative if that isn't positive definite.
    """
    # (P + R)^-1 (P | innovation) in one solve: gain transposed and normalised innovation.
    sides = np.empty((6, 7), order="F")  # as LAPACK wants it: no copy
    sides[:, :6], sides[:, 6] = mine, innovation
    _, both, failed = dposv(mine + other, sides)
    return both[:, :6].T, -1.0 if failed else float(innovation @ both[:, 6])


def _corrected(covariance: Array, gain: Array, innovation: Array) -> tuple[Array, Array]:
    """The way (6,) of the state, and its covariance (6, 6) after that."""
    left = covariance - gain @ covariance
    return gain @ innovation, 0.5 * (left + left.T)


def _scaled(covariance: Array, share: Array) -> Array:
    """A covariance (6, 6) with the ``share`` (6,) of its variances, as correlated as before."""
    scale = np.sqrt(share)
    out: Array = covariance * (scale[:, None] * scale)
    return out
