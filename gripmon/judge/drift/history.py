"""What the drift has done over the last minutes: was it a step or a creep, and how fast?"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from gripmon.model.records import Array, Creep

BLOCK_S = 0.5
"""Frames are averaged over so many seconds."""

KEPT_BLOCKS = 256

FEWEST_BLOCKS = 6
"""Blocks below which a creep isn't told from a step."""

LASTING_BLOCKS = 3
"""Blocks that must have come after a step."""

BETTER = 0.6
"""A creep must explain the blocks with at most this part of the squares that a step leaves, and the other way round."""

SIGNIFICANT = 4.0
"""Standard deviations by which a rate must differ from zero."""


class History:
    """Means over :data:`BLOCK_S` of the shift against the reference."""

    def __init__(self) -> None:
        self._times_s: deque[float] = deque(maxlen=KEPT_BLOCKS)
        self._means: deque[Array] = deque(maxlen=KEPT_BLOCKS)
        self._sum: Array = np.zeros(6)
        self._count = 0
        self._begun_s: float | None = None

    def add(self, shift: Array, now_s: float) -> bool:
        """One frame's shift (6,); True when a block is complete."""
        if self._begun_s is None:
            self._begun_s = now_s
        complete = now_s - self._begun_s >= BLOCK_S and self._count > 0
        if complete:
            self._times_s.append(0.5 * (self._begun_s + now_s))
            self._means.append(self._sum / self._count)
            self._sum, self._count, self._begun_s = np.zeros(6), 0, now_s
        self._sum = self._sum + shift
        self._count += 1
        return complete

    def clear(self) -> None:
        """The reference has changed."""
        self._times_s.clear()
        self._means.clear()
        self._sum, self._count, self._begun_s = np.zeros(6), 0, None

    def creep(self, towards: Array) -> Creep | None:
        """The creep that the blocks show, None if a step explains them as well or if it doesn't go on.

        ``towards`` (6,): its product with a shift is a number of standard deviations along the drift.
        """
        count = len(self._means)
        if count < FEWEST_BLOCKS:
            return None
        times_s, means = np.array(self._times_s), np.array(self._means)
        along = means @ towards
        step, _ = _best(along, _steps(count))
        ramp, onset = _best(along, _ramps(times_s))
        if ramp > BETTER * step:
            return None
        moving = slice(max(onset, count - 4 * FEWEST_BLOCKS), None)
        velocity = _slopes(times_s[moving], means[moving], along[moving], towards)
        return None if velocity is None else Creep(velocity, float(times_s[onset]))

    def is_step(self, towards: Array) -> bool:
        """Whether the blocks show a step along ``towards`` (6,), and no creep explains them nearly as well."""
        count = len(self._means)
        if count < FEWEST_BLOCKS:
            return False
        along = np.array(self._means) @ towards
        step, before = _best(along, _steps(count))
        # Of a creep that has just begun the first block is a step, too.
        lasts = count - 1 - before >= LASTING_BLOCKS
        return lasts and step <= BETTER * _best(along, _ramps(np.array(self._times_s)))[0]


def goes_on(values: Array) -> bool:
    """Whether the newest of a series (n,) are still on their way rather than at a new place."""
    count = len(values)
    if count < FEWEST_BLOCKS:
        return False
    step, _ = _best(values, _steps(count))
    ramp, _ = _best(values, _ramps(np.arange(float(count))))
    return ramp < step


def _steps(count: int) -> Array:
    """(count - 1, count) a step before each block but the first."""
    return np.triu(np.ones((count, count)))[1:]


def _ramps(times_s: Array) -> Array:
    """(count - 2, count) nothing until a block, from there on a straight line."""
    return np.maximum(times_s[None, :] - times_s[:-2, None], 0.0)


def _best(values: Array, shapes: Array) -> tuple[float, int]:
    """Smallest sum of squares (n shapes) that a constant and one multiple of a shape leave, and the shape's index."""
    centred = shapes - shapes.mean(axis=1, keepdims=True)
    values = values - values.mean()
    explained = (centred @ values) ** 2 / np.maximum((centred**2).sum(axis=1), 1e-300)
    index = int(explained.argmax())
    return float(max(values @ values - explained[index], 1e-12 * (values @ values))), index


def _slopes(times_s: Array, means: Array, along: Array, towards: Array) -> Array | None:
    """Velocity (6,) by least squares; None if it isn't significant along ``towards``."""
    if len(times_s) < FEWEST_BLOCKS:
        return None
    t = times_s - times_s.mean()
    spread = float(t @ t)
    slope = float(t @ along) / spread
    residual = along - along.mean() - slope * t
    sigma = math.sqrt(float(residual @ residual) / (len(t) - 2) / spread)
    return (t @ means) / spread if abs(slope) > SIGNIFICANT * sigma else None
