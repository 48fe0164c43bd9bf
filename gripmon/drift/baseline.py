"""The part of the shift that an inexact reference explains."""

from __future__ import annotations

import numpy as np

from gripmon.records import Array

ALLOWED = 4.0
"""Standard deviations of the reference, on every axis, up to which a first shift is the reference's error."""


class Baseline:
    """The error of a reference that is only roughly known, such as a configured one.

    A calibration is off by some tenths of a millimetre from the start, which is no drift.  The mean shift of the first
    frames is taken for that error if the reference's own uncertainty allows it, else nothing is.
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
            mean = np.mean(self._first, axis=0)
            self.error = mean if (np.abs(mean) <= self._allowed).all() else np.zeros(6)
            self._first.clear()
        return shift - self.error
