"""Detectability: which motions the drift test will detect with a given camera and gripper, and how soon.

The forecast uses the assumed limits.  After some minutes the test learns from the stream's own extremes, which mostly
makes it faster.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gripmon.judge.drift.sequential import rarity
from gripmon.judge.drift.settings import DriftSettings
from gripmon.judge.drift.statistics import LENGTHS
from gripmon.model.records import Array

CORRELATION_FRAMES = 20.0
"""Frames over which errors are assumed to be correlated: as for a robot that works over clutter at 60 frames/s."""


@dataclass(frozen=True, slots=True)
class Foresight:
    """For steps along each of the six axes (m, rad), with errors of the assumed covariance that are correlated over
    :data:`CORRELATION_FRAMES`: ``smallest`` (6,), the smallest step detected at all, on average, and ``sizes`` (k, 6),
    the smallest detected within each of the numbers of ``frames`` (k,).
    """

    smallest: Array
    frames: tuple[int, ...]
    sizes: Array

    def delay_frames(self, size: float, axis: int) -> int | None:
        """Average number of frames until a step of this size along an axis (0 to 5) is detected; None for never."""
        enough = np.flatnonzero(self.sizes[:, axis] <= size)
        return self.frames[enough[0]] if len(enough) else None


def foresee(covariance: Array, settings: DriftSettings) -> Foresight:
    """What :mod:`~gripmon.judge.drift.sequential` detects if the frames' errors have this ``covariance`` (6, 6)."""
    windows = np.full((len(LENGTHS), 1), np.inf)
    threshold, inflation = rarity(settings.false_alarms_per_day, settings.frames_per_s, windows)
    of_mean = _variance_of_means(np.array([*LENGTHS, 2 * LENGTHS[-1]], dtype=float))
    # As in the test: Allan differences, each inflated for the noise's tails.
    of_difference = inflation[:, 0] * 4.0 * (of_mean[:-1] - of_mean[1:])
    parts = 0.25 * of_difference
    parts[-1] *= 2.0
    of_mean = np.cumsum(parts[::-1])[::-1]
    least = np.minimum(of_mean, of_difference)
    # Noise gives 6 on average, a shift adds its own square.
    per_axis = np.sqrt((threshold - 6.0) / np.linalg.inv(covariance).diagonal())
    sizes = np.sqrt(np.minimum.accumulate(least))[:, None] * per_axis
    sizes = sizes + settings.tolerated
    # A step is a frame late: the median over three frames, so that no single one decides.
    return Foresight(sizes[-1], tuple(length + 1 for length in LENGTHS), sizes)


def _variance_of_means(lengths: Array) -> Array:
    """Variance of the mean of n values of a first-order autoregression with variance one, for each of ``lengths``."""
    phi = float(np.exp(-1.0 / CORRELATION_FRAMES))
    # Sum over k of (n - k) phi^k, in closed form.
    lagged = (lengths - 1.0) * phi / (1.0 - phi) - (phi**2 - phi ** (lengths + 1.0)) / (1.0 - phi) ** 2
    return np.asarray((lengths + 2.0 * lagged) / lengths**2)
