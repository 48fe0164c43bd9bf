"""Kind of motion: a step or a creep, from the drift's history over minutes; or a vibration, where the differences
between frames grow in one direction while their mean stays.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

import numpy as np

from gripmon.model.records import Array, Creep, Vibration

BLOCK_S = 0.5
"""Time over which frames are averaged; a change of the mean within it is a step."""

KEPT_BLOCKS = 256
"""Blocks in which the onset of a motion is searched for: two minutes."""

FEWEST_BLOCKS = 6
"""Fewest blocks that distinguish a creep from a step: half of them before it, half of them after it."""

EXPLAINED_SQUARES_RATIO = 0.6
"""Largest ratio of the squares that a creep leaves to those that a step leaves for it to be a creep, and vice versa."""

SIGNIFICANT_SIGMAS = 4.0
"""Significance limit in standard deviations; normal errors exceed it once in 16,000 cases.  It applies to a rate that
differs from zero, a first shift that is more than the reference's error on some axis, an edge that contradicts the fit
unusually, and a piece of an edge that isn't at a place.
"""


class History:
    """Means of the shift against the reference over blocks of :data:`BLOCK_S`."""

    def __init__(self) -> None:
        self._times_s: deque[float] = deque(maxlen=KEPT_BLOCKS)
        self._means: deque[Array] = deque(maxlen=KEPT_BLOCKS)
        self._sum: Array = np.zeros(6)
        self._count = 0
        self._begun_s: float | None = None

    def add(self, shift: Array, now_s: float) -> bool:
        """Add one frame's shift (6,); True when a block is complete."""
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
        """Start again: the reference has changed."""
        self._times_s.clear()
        self._means.clear()
        self._sum, self._count, self._begun_s = np.zeros(6), 0, None

    def creep(self, towards: Array) -> Creep | None:
        """The creep that the blocks show; None if a step explains them as well, or if it has stopped.

        ``towards`` (6,): its product with a shift is the shift along the drift, in standard deviations.
        """
        count = len(self._means)
        if count < FEWEST_BLOCKS:
            return None
        times_s, means = np.array(self._times_s), np.array(self._means)
        along = means @ towards
        step, _ = _best_step(along)
        ramp, onset = _best_ramp(along, times_s)
        if ramp > EXPLAINED_SQUARES_RATIO * step:
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
        step, before = _best_step(along)
        # The first block of a creep that has just begun also looks like a step.
        lasts = count - 1 - before >= FEWEST_BLOCKS // 2
        return lasts and step <= EXPLAINED_SQUARES_RATIO * _best_ramp(along, np.array(self._times_s))[0]


def goes_on(values: Array) -> bool:
    """Whether the newest of a series (n,) are still moving rather than settled at a new level."""
    count = len(values)
    if count < FEWEST_BLOCKS:
        return False
    return _best_ramp(values, np.arange(float(count)))[0] < _best_step(values)[0]


def _best_step(values: Array) -> tuple[float, int]:
    """Smallest sum of squared residuals of a step fitted to values (n,), and the index of the block before it."""
    values = values - values.mean()
    after = np.arange(len(values) - 1, 0, -1)  # blocks after each but the last
    return _best(values, _from_each(values)[1:], after * (1.0 - after / len(values)))


def _best_ramp(values: Array, times_s: Array) -> tuple[float, int]:
    """The same for a constant followed by a ramp, and the index of the block in which the ramp begins."""
    values, times_s = values - values.mean(), times_s - times_s[-1]
    begin, after = times_s[:-2], np.arange(len(values), 2, -1.0)
    # For (t - t_k) over all t from t_k on: its product with the values, its sum and its squares.
    product = _from_each(times_s * values)[:-2] - begin * _from_each(values)[:-2]
    total = _from_each(times_s)[:-2] - begin * after
    square = _from_each(times_s**2)[:-2] - 2.0 * begin * _from_each(times_s)[:-2] + begin**2 * after
    return _best(values, product, square - total**2 / len(values))


def _from_each(values: Array) -> Array:
    """Sums (n,) over values (n,) from each one to the last."""
    return np.cumsum(values[::-1])[::-1]


def _best(values: Array, product: Array, square: Array) -> tuple[float, int]:
    """Smallest sum of squared residuals of values (n,) about their mean after fitting a multiple of one of some shapes,
    and the index of that shape; ``product`` of each shape with the values, ``square`` of each about its mean.
    """
    explained = product**2 / np.maximum(square, 1e-300)
    index, whole = int(explained.argmax()), float(values @ values)
    return max(whole - float(explained[index]), 1e-12 * whole), index


def _slopes(times_s: Array, means: Array, along: Array, towards: Array) -> Array | None:
    """Velocity (6,) by least squares; None if it isn't significant along ``towards``."""
    if len(times_s) < FEWEST_BLOCKS:
        return None
    t = times_s - times_s.mean()
    spread = float(t @ t)
    slope = float(t @ along) / spread
    residual = along - along.mean() - slope * t
    sigma = math.sqrt(float(residual @ residual) / (len(t) - 2) / spread)
    return (t @ means) / spread if abs(slope) > SIGNIFICANT_SIGMAS * sigma else None


KEPT_FRAMES = 128
"""Frames in which a vibration is searched for: two seconds at 60 frames/s."""

PARTS = 4
"""Number of parts of these frames, each evaluated separately, and whenever one of them is new."""

VIBRATION_VARIANCE_RATIO = 6.0
"""Ratio of the variance in a direction to the usual one, claimed or learnt, from which it is a vibration."""


VIBRATION_RELEASE_RATIO = 0.5
"""Factor on the limits for a vibration that was already found, so that it isn't lost at the limit."""


class VibrationWatch:
    """Searches the last :data:`KEPT_FRAMES` shifts of the TCP for a vibration."""

    def __init__(self, smallest_m: float):
        """``smallest_m``: root mean square from which a vibration is reported."""
        self._smallest_m = smallest_m
        self._shifts: deque[Array] = deque(maxlen=KEPT_FRAMES)
        self._times_s: deque[float] = deque(maxlen=KEPT_FRAMES)
        self._since_look = 0
        self._found: Vibration | None = None
        self._before: Array = np.eye(3)
        self._learnt = True

    @property
    def is_news(self) -> bool:
        """Whether it vibrates by more than the stream's noise, as learnt so far, explains."""
        return self._found is not None and not self._learnt

    def forget(self) -> None:
        """Start again: the camera has moved, and the step is not a vibration."""
        self._shifts.clear()
        self._times_s.clear()
        self._found = None

    def add(self, shift: Array, now_s: float, usual: Callable[[], Array]) -> Vibration | None:
        """Add one frame's shift (6,); ``usual()`` (6, 6): covariance of an unmoved camera's shifts about their mean.

        Returns the vibration, None if there is none.  One that lasts is learnt as noise in time; it is still reported.
        """
        self._shifts.append(shift)
        self._times_s.append(now_s)
        self._since_look += 1
        if len(self._shifts) == KEPT_FRAMES and self._since_look >= KEPT_FRAMES // PARTS:
            self._since_look = 0
            learnt = usual()[:3, :3]
            if self._found is None:
                self._before = learnt.copy()
            self._found = self._look(self._before, learnt, 1.0 if self._found is None else VIBRATION_RELEASE_RATIO)
        return self._found

    def _look(self, usual: Array, learnt: Array, ease: float) -> Vibration | None:
        shifts, times_s = np.array(self._shifts)[:, :3], np.array(self._times_s)
        # Three of four parts must show it, each about its own line: a step or a wild frame is loud in only one of them.
        parts = _about_its_line(shifts.reshape(PARTS, -1, 3))
        direction = _loudest(np.einsum("pni,pnj->ij", parts, parts) / KEPT_FRAMES, usual)
        loud = sorted(np.square(parts @ direction).mean(axis=1).tolist())
        expected = float(direction @ usual @ direction)
        if loud[1] < ease * VIBRATION_VARIANCE_RATIO * expected:
            return None
        self._learnt = loud[1] < VIBRATION_VARIANCE_RATIO * float(direction @ learnt @ direction)
        # A part may be shorter than a period: the size is taken about a line through all of them.
        along = _about_its_line(shifts) @ direction
        excess = float(np.median([np.square(part).mean() for part in np.split(along, PARTS)])) - expected
        if excess < ease * self._smallest_m**2:
            return None
        return Vibration(math.sqrt(excess), _frequency_hz(along, times_s))


def _about_its_line(values: Array) -> Array:
    """Residuals (..., n, 3) of values (..., n, 3) about a straight line in time: a creep is not a vibration."""
    count = values.shape[-2]
    index = np.arange(count) - 0.5 * (count - 1)
    slope = np.einsum("n,...ni->...i", index, values) / (index @ index)
    middle = values.mean(axis=-2)
    return np.asarray(values - middle[..., None, :] - index[:, None] * slope[..., None, :])


def _loudest(covariance: Array, usual: Array) -> Array:
    """Unit vector (3,) along which a covariance exceeds the usual one most."""
    root = np.linalg.cholesky(usual)
    inverse = np.linalg.inv(root)
    _, directions = np.linalg.eigh(inverse @ covariance @ inverse.T)
    direction = inverse.T @ directions[:, -1]
    return np.asarray(direction / np.linalg.norm(direction))


def _frequency_hz(values: Array, times_s: Array) -> float:
    """Frequency of the largest peak in the spectrum, interpolated by a parabola; 0 where no time passes."""
    interval_s = (times_s[-1] - times_s[0]) / (len(times_s) - 1)
    if interval_s <= 0.0:
        return 0.0
    power = np.abs(np.fft.rfft((values - values.mean()) * np.hanning(len(values))))
    top = int(power[1:-1].argmax()) + 1
    below, at, above = power[top - 1 : top + 2]
    bend = below - 2.0 * at + above
    return float((top + (0.5 * (below - above) / bend if bend else 0.0)) / (len(values) * interval_s))
