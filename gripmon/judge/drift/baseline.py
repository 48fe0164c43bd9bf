"""The part of the shift that an inexact reference explains."""

from __future__ import annotations

import numpy as np

from gripmon.model.records import Array

ALLOWED = 4.0
"""Standard deviations of the reference, on every axis, up to which a first shift is the reference's error."""


class Baseline:
    """The error of a reference that is only roughly known, such as a configured one.

    A calibration is off by some tenths of a millimetre from the start, which is no drift.  The mean shift of the first
    frames, without those that lie farthest out, is taken for that error if the reference's own uncertainty allows it,
    else nothing is.
    """

    def __init__(self, reference_sigma: Array, frames: int, error: Array | None = None):
        """``reference_sigma`` (6,): standard deviations of the reference's error, m and rad.  ``error`` (6,) if it is
        known from before.
        """
        self._allowed = ALLOWED * reference_sigma
        self._frames = frames
        self._first: list[Array] = []
        self.error = error
        """(6,) what is subtracted; None until it is known."""

    def subtract(self, shift: Array) -> Array | None:
        """The shift (6,) less the reference's error; None while that isn't known yet."""
        if self.error is None:
            self._first.append(shift)
            if len(self._first) < self._frames:
                return None
            mean = _mean_of_the_inner_half(np.array(self._first))
            self.error = mean if (np.abs(mean) <= self._allowed).all() else np.zeros(6)
            self._first.clear()
        return shift - self.error


def _mean_of_the_inner_half(shifts: Array) -> Array:
    """(6,) of shifts (n, 6), those closest to their median: a wild frame among them counts for nothing."""
    distance = np.abs(shifts - np.median(shifts, axis=0))
    scale = np.maximum(np.median(distance, axis=0), 1e-12)
    inner = np.argsort((distance / scale).max(axis=1), kind="stable")[: (len(shifts) + 1) // 2]
    return np.asarray(shifts[inner].mean(axis=0))
