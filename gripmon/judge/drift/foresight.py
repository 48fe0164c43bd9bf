"""What the drift test will notice with a given camera and gripper, and how soon, before there is any stream.

By the limits that are assumed: what a stream's own extremes teach the test after some minutes mostly makes it sooner.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gripmon.judge.drift.sequential import rarity
from gripmon.judge.drift.settings import DriftSettings
from gripmon.judge.drift.statistics import LENGTHS
from gripmon.model.records import Array

CORRELATION_FRAMES = 20.0
"""Frames over which errors are assumed to last: what a robot that works over clutter shows at 60 frames/s."""

_MEDIAN_FRAMES = 1
"""A step is late by one frame: no single frame decides."""


@dataclass(frozen=True, slots=True)
class Foresight:
    """For steps along each of the six axes (m, rad), with errors of the assumed covariance that last for
    :data:`CORRELATION_FRAMES`: ``smallest`` (6,) that is noticed at all, on average, and what a step must have to be
    noticed within so many ``frames`` (k,): ``sizes`` (k, 6).
    """

    smallest: Array
    frames: tuple[int, ...]
    sizes: Array

    def delay_frames(self, size: float, axis: int) -> int | None:
        """Frames after which a step of this size along an axis (0 to 5) is noticed on average; None for never."""
        enough = np.flatnonzero(self.sizes[:, axis] <= size)
        return self.frames[enough[0]] if len(enough) else None


def foresee(covariance: Array, settings: DriftSettings) -> Foresight:
    """What :mod:`~gripmon.judge.drift.sequential` detects where frames have errors of ``covariance`` (6, 6)."""
    windows = np.full((len(LENGTHS), 1), np.inf)
    threshold, inflation = rarity(settings.false_alarms_per_day, settings.frames_per_s, windows)
    of_mean = _variance_of_means(np.array([*LENGTHS, 2 * LENGTHS[-1]], dtype=float))
    # As in the test: Allan's differences, each taken to be larger by as much as the noise's tails demand.
    of_difference = inflation[:, 0] * 4.0 * (of_mean[:-1] - of_mean[1:])
    parts = 0.25 * of_difference
    parts[-1] *= 2.0
    of_mean = np.cumsum(parts[::-1])[::-1]
    least = np.minimum(of_mean, of_difference)
    # A shift adds its own square to the six that noise gives on average.
    per_axis = np.sqrt((threshold - 6.0) / np.linalg.inv(covariance).diagonal())
    sizes = np.sqrt(np.minimum.accumulate(least))[:, None] * per_axis
    sizes = sizes + settings.tolerated
    return Foresight(sizes[-1], tuple(length + _MEDIAN_FRAMES for length in LENGTHS), sizes)


def _variance_of_means(lengths: Array) -> Array:
    """Of the mean of n values of a first-order autoregression with variance one."""
    phi = float(np.exp(-1.0 / CORRELATION_FRAMES))
    # Sum over k of (n - k) phi^k, in closed form.
    lagged = (lengths - 1.0) * phi / (1.0 - phi) - (phi**2 - phi ** (lengths + 1.0)) / (1.0 - phi) ** 2
    return np.asarray((lengths + 2.0 * lagged) / lengths**2)
