"""Has the camera moved?  A generalised likelihood ratio test over windows of 1 to 4096 frames.

For every window length two hypotheses are tested against an unmoved camera: the window's mean differs from the
reference (detects creeps, and eventually any shift), and it differs from the mean of the window before (detects steps
soon, because lasting errors cancel in the difference).  The unknown shifts are estimated, so that each statistic is
Hotelling's T² of the part of the shift beyond what is tolerated, with the covariances observed in the stream.  Lai
(1995) gives the scheme for independent frames; the correlation of the frames' errors enters through the covariances.

At first the threshold comes from assumed errors in front of clutter; for long windows it stays.  Once the stream has
shown enough extremes of its own, the thresholds of short windows are learnt from them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import special

from gripmon.judge.drift import kernel
from gripmon.judge.drift.settings import DriftSettings
from gripmon.judge.drift.statistics import (
    BLOCK_FRAMES,
    COUNT,
    LARGEST_SQUARE,
    LENGTHS,
    RARE,
    Extremes,
    Scatter,
    Windows,
)
from gripmon.judge.smoothing import LEARN_EVERY
from gripmon.model.least_squares import chi_square_limit
from gripmon.model.records import Array

SWEEPS = 8
"""Sweeps of coordinate descent over the six axes; the statistic after any number of them is never too small."""


REFRESH_FRAMES = 16
"""Frames after which covariances are inverted and thresholds computed again."""

FREEDOM, FREEDOM_GROWTH = 9.0, 1.0 / 3.0
"""Student's degrees of freedom of a single frame's error, as simulated images in clutter show, and the power of the
number of frames by which those of a mean grow: the mean of many frames is closer to normal.
"""

TAIL, TAIL_WINDOWS = 0.01, 500.0
"""Probability at which the noise's tail is compared with the normal one, and number of windows over which."""

STUDENT_TAIL, TAIL_POWER_BOUNDS = 1.6, (0.25, 1.5)
"""Ratio of this tail to the normal one for Student's distribution with :data:`FREEDOM`, assumed at first; and bounds on
the factor by which a stream with lighter or heavier tails scales the logarithm of its inflation.
"""

SURGE_FRAMES, SURGE_WINDOWS = 32, 16
"""Frames and windows, whichever is longer, over which a burst of noise is measured: it inflates the variance."""

THRESHOLD_MARGIN = 1.55
"""Factor on the threshold: biases, too, have heavier tails than normal errors, and change by more than the theory
assumes (streams simulated after images needed 1.2 to 1.5 to keep the false-alarm rate).
"""

SHORT_LENGTHS = LENGTHS.index(BLOCK_FRAMES) + 1
"""Number of lengths, 1 to 256 frames, whose limits are learnt: a stream shows too few longer windows."""

OUTLIER_LIMIT_RATIO = 2.0
"""Multiple of its limit above which a difference is not noise, and isn't learnt.  Below it may be either."""

EXTREME_FRAMES = 2
"""Frames between two looks for extremes: neighbouring medians of three frames are nearly the same."""

BIAS_FREEDOM = 10.0
"""Student's degrees of freedom of the bias from a background, on simulated images."""

REPORTED_MEMORY = 1.0 / 64.0
"""Weight of the newest frame in the running mean of the reported covariances."""

SEARCH_THRESHOLD_RATIO = 0.25
"""Part of its threshold above which a statistic is worth the search for the tolerated part of the shift."""


class Finding(NamedTuple):
    """Result of the test after a frame, for each stream (s,): whether the camera has ``moved``; if so, ``length``, the
    frames of the window that showed it, and ``stepped``, whether the difference showed it or the mean; ``excess``, the
    largest statistic over its threshold.
    """

    moved: np.ndarray
    length: np.ndarray
    stepped: np.ndarray
    excess: Array


class SequentialTest:
    """Tests ``streams`` series of shifts against a reference."""

    def __init__(self, settings: DriftSettings, streams: int = 1):
        self._settings, self._streams = settings, streams
        self.windows, self.scatter = Windows(streams), Scatter(streams)
        self._tolerated = settings.tolerated
        self._frames_per_s = settings.frames_per_s
        self._last_two = np.zeros((2, streams, 6))
        self._sure = np.zeros((streams, 6))
        self._seen = np.zeros(streams, dtype=np.intp)
        self._reported: Array = np.zeros((streams, 6, 6))
        self._reference: Array = np.zeros((streams, 6, 6))
        self._frames = self._since_restart = 0
        self.refreshes = 0
        """How often covariances and thresholds were computed."""
        self._surge = np.ones((len(LENGTHS), streams))
        self._tail = np.full((len(LENGTHS), streams), STUDENT_TAIL)
        self._stale = True
        self._seen_last: tuple[Array, Array, Array, np.ndarray | None] | None = None
        self._threshold = 1.0
        self._inflation: Array | None = None
        # Extremes within two blocks count as one: a background stays at least this long, and bursts come and go.
        alike_frames = np.maximum(2.0 * COUNT[:SHORT_LENGTHS], 2.0 * BLOCK_FRAMES)
        self._extremes = Extremes(np.tile(alike_frames, (2, 1)), streams)
        self._of_extremes: tuple[float, np.ndarray, Array] | None = None
        self._limit = np.full((2, len(LENGTHS), streams), np.inf)
        self._known = np.zeros(self._limit.shape, dtype=bool)
        self._middle: Array = np.zeros((streams, 6))
        lengths, each = len(LENGTHS), (streams, 6, 6)
        self._to_reported, self._from_reported = np.zeros((2, *each))
        self._plain, self._whitening = np.zeros((2, SHORT_LENGTHS, *each)), np.zeros((2, lengths, *each))
        self._mean_covariance, self._learnt_whitening = np.zeros((2, lengths, *each))

    def set_frames_per_s(self, frames_per_s: float) -> None:
        """Set the stream's own frame rate: the contract is per day, the thresholds are per frame."""
        if abs(frames_per_s - self._frames_per_s) > 0.05 * self._frames_per_s:
            self._frames_per_s, self._inflation, self._stale = frames_per_s, None, True

    def set_reference_covariance(self, covariance: Array) -> None:
        """Covariance (6, 6) or (s, 6, 6) of the reference's own error: that much of a mean shift is not a drift."""
        self._reference = np.broadcast_to(covariance, (self._streams, 6, 6)).copy()
        self._stale = True

    def add(
        self, shift: Array, covariance: Array, learn: np.ndarray | None = None, at_least: int = LENGTHS[0]
    ) -> Finding:
        """Add one frame's shift (s, 6) against the reference, m and rad, with its reported covariance (s, 6, 6).

        ``learn`` (s,): whether the frame may be learnt from as one without motion; all if left out.  Windows of fewer
        than ``at_least`` frames decide nothing now.
        """
        self.learn()
        if self._frames == 0:
            self._reported = np.array(covariance)
            self.scatter.begin(covariance)
        if self._stale:
            self._refresh()
        # The median of three frames: no single frame can decide, and a step is late by one.  It is taken along axes in
        # which errors are independent: along others the median may be a shift that none of the frames supports.
        mean, difference = self.windows.add(
            kernel.steady(
                shift, covariance, REPORTED_MEMORY, self._reported, self._seen, self._sure, self._last_two,
                self._to_reported, self._from_reported,
            )
        )  # fmt: skip
        self._frames, self._since_restart = self._frames + 1, self._since_restart + 1
        if self._since_restart < 3:
            # Fewer than three frames have no median.
            self.windows.keep(self._seen < 3, 0)
        beyond, found = kernel.decide(
            mean, difference, self.windows.frames, self.windows.lengths, self._whitening, self._limit,
            self._most_tolerated, self._tolerated, SEARCH_THRESHOLD_RATIO, SWEEPS, LENGTHS.index(at_least),
        )  # fmt: skip
        self._seen_last = mean, difference, beyond, learn
        return Finding(*found)

    def learn(self) -> None:
        """Learn from the newest frame for later ones; otherwise the next :meth:`add` does it first."""
        if self._seen_last is None:
            return
        (mean, difference, beyond, learn), self._seen_last = self._seen_last, None
        if self._frames % EXTREME_FRAMES == 0:
            usable = np.stack(self.windows.full()) & (beyond[1] <= OUTLIER_LIMIT_RATIO).all(axis=0)
            self._learn_extremes(mean, difference, usable if learn is None else usable & learn)
        if self._frames % LEARN_EVERY == 0:
            # A constant offset doesn't contradict what differences show.
            usable = self.windows.full()[1] & ~(beyond[1] > 1.0).any(axis=0)
            self._learn(difference, usable if learn is None else usable & learn)
        if self._frames % REFRESH_FRAMES == 0 and not self._stale:
            self._refresh()

    def level(self, frames: int) -> tuple[Array, Array]:
        """Mean shift (s, 6) over the last ``frames`` frames, and its covariance (s, 6, 6), which is that of the longest
        window in :data:`LENGTHS` (powers of two) that isn't longer.
        """
        return self.windows.mean_of_last(frames), self._mean_covariance[frames.bit_length() - 1]

    def square_beyond(self, shift: Array, covariance: Array) -> float:
        """Normalised square of what of a shift (6,) with a covariance (6, 6) isn't tolerated."""
        return float(kernel.square_beyond(covariance, shift, self._tolerated, SWEEPS))

    def noticed(self) -> Array | None:
        """Smallest constant shifts (6,), each alone on its axis, that the means of the first stream's full windows
        detect; None while no window is full.
        """
        full = self.windows.full()[0][:, 0]
        if not self.refreshes or not full.any():
            return None
        precision = np.square(self._whitening[0, full, 0]).sum(axis=-2)
        sizes = np.sqrt(self._limit[0, full, 0, None] / precision)
        return np.asarray(sizes.min(axis=0) + self._tolerated)

    def usual_covariance(self) -> Array:
        """Covariance (6, 6) of the first stream's shifts about their mean, from learnt scatter and reported error."""
        return np.asarray(self.scatter.of_single_frames()[0] + self._reported[0])

    def restart(self, streams: np.ndarray, keep: np.ndarray | int = 0) -> None:
        """Forget all but the last ``keep`` frames of some streams (s,); what was learnt about the noise stays."""
        self.learn()
        self.windows.keep(streams, keep)
        self._seen = np.where(streams & (np.asarray(keep) == 0), 0, self._seen)
        self._since_restart = 0

    def _learn(self, difference: Array, usable: np.ndarray) -> None:
        """What differences (k, s, 6) show of the noise, where they are usable (k, s)."""
        normalised = kernel.squares(self._learnt_whitening, difference)
        self.scatter.learn(difference, normalised, usable, LEARN_EVERY)
        self._learn_surge(normalised, usable)
        self._learn_tail(normalised, usable)

    def _learn_surge(self, normalised: Array, usable: np.ndarray) -> None:
        """Follow whether differences (k, s) are larger now than in the long run: noise comes in bursts."""
        rate = np.where(usable, LEARN_EVERY / np.maximum(SURGE_FRAMES, SURGE_WINDOWS * COUNT), 0.0)
        self._surge += rate * (np.minimum(normalised / 6.0, LARGEST_SQUARE) - self._surge)

    def _learn_tail(self, normalised: Array, usable: np.ndarray) -> None:
        """Follow, relative to the normal value, the size that one in a hundred differences (k, s) exceeds (Robbins and
        Monro).
        """
        share = np.minimum(LEARN_EVERY / (2.0 * COUNT), 1.0) / TAIL_WINDOWS
        beyond = (normalised > self._tail * chi_square_limit(TAIL)) / TAIL - 1.0
        self._tail = np.maximum(self._tail * np.exp(np.where(usable, share * beyond, 0.0)), 1.0)

    def _learn_extremes(self, mean: Array, difference: Array, usable: np.ndarray) -> None:
        """Means about that of the longest window: an offset that stays is no noise, and a creep is hardly any."""
        squares = kernel.extremes(
            mean, difference, self._middle, self._plain, self._limit, self._known, OUTLIER_LIMIT_RATIO
        )  # fmt: skip
        usable = usable[:, :SHORT_LENGTHS].copy()
        # The longest window was full already when its mean was taken last.
        usable[0] &= self.windows.frames >= LENGTHS[-1] + REFRESH_FRAMES
        kinds = (2 * SHORT_LENGTHS, self._streams)
        if self._extremes.add(squares.reshape(kinds), usable.reshape(kinds), EXTREME_FRAMES):
            self._stale = True
            self._learnt_limits()  # needed by the next frame's refresh; done now so that no frame pays for both

    def _refresh(self) -> None:
        fitted, self._stale = self._stale, False
        self.refreshes += 1
        # Slow to compute, slow to change.
        if self._inflation is None or self._frames % (16 * REFRESH_FRAMES) == 0:
            self._threshold, self._inflation = rarity(
                self._settings.false_alarms_per_day, self._frames_per_s, self.scatter.windows
            )
        self._middle = self.windows.mean_of_last(LENGTHS[-1])
        if fitted:
            self._limit, self._known = self._limits()
        heavy = np.clip((self._tail - 1.0) / (STUDENT_TAIL - 1.0), *TAIL_POWER_BOUNDS)
        surge = np.maximum(self._surge, 1.0)
        # The reported covariance of a mean gives its standard deviation; it isn't inflated for rare events.
        self._whiten(np.stack([self._inflation**heavy * surge, np.ones_like(surge), surge]))
        self._most_tolerated = np.linalg.norm(np.abs(self._whitening[0]) @ self._tolerated, axis=-1)

    def _whiten(self, each: Array) -> None:
        """Compute the covariances of means and differences, and their whitening, with the observed variance multiplied
        by ``each`` (3, k, s): for assumed limits, for standard deviations, and for learnt limits.
        """
        kernel.refresh(
            self._reported, self.scatter.of_differences, self.scatter.learnt, each, RARE, self._reference,
            self._known, self._plain, self._mean_covariance, self._whitening, self._learnt_whitening,
            self._to_reported, self._from_reported,
        )  # fmt: skip

    def _limits(self) -> tuple[Array, np.ndarray]:
        """Squares (2, k, s) above which the camera has moved, and which of them are learnt.

        No learnt limit is below that of normal errors.  A bias that hasn't changed in N observed frames may still
        change for the first time, but at most once in N frames.
        """
        learnt = self._learnt_limits()
        limit = np.full((2, len(LENGTHS), self._streams), self._threshold)
        known = np.zeros(limit.shape, dtype=bool)
        known[:, :SHORT_LENGTHS] = np.isfinite(learnt)
        limit[:, :SHORT_LENGTHS] = np.where(known[:, :SHORT_LENGTHS], learnt, self._threshold)
        return limit, known

    def _learnt_limits(self) -> Array:
        """Limits (2, SHORT_LENGTHS, s) from the extremes of the blocks so far; infinite where too few are known."""
        chance, blocks = self._settings.false_alarms_per_day / (86_400.0 * self._frames_per_s), self._extremes.blocks
        if self._of_extremes is None or self._of_extremes[0] != chance or self._of_extremes[1] is not blocks:
            learnt = self._extremes.limits(min(chance * BLOCK_FRAMES / (2 * SHORT_LENGTHS), 0.1)).reshape(
                2, SHORT_LENGTHS, -1
            )
            seen = np.clip(chance * BLOCK_FRAMES * blocks.reshape(2, SHORT_LENGTHS, -1)[1], 1e-12, 0.5)
            changes = 6.0 * special.fdtri(6.0, BIAS_FREEDOM, 1.0 - seen)
            normal = np.full(changes.shape, special.chdtri(6, min(chance / (2 * SHORT_LENGTHS), 0.1)))
            self._of_extremes = chance, blocks, np.maximum(learnt, np.stack([normal, changes]))
        return self._of_extremes[2]


def rarity(false_alarms_per_day: float, frames_per_s: float, windows: Array) -> tuple[float, Array]:
    """Threshold on the squares of six normal errors that all lengths together exceed no more often than the contract
    allows; and factors (k, s) by which to inflate the variance of the stream's own scatter, known from ``windows``
    (k, s) windows, for the same probability.

    T² / 6 with a covariance from m samples is nearly distributed as F(6, m) (Hotelling), and for errors with Student's
    distribution as F with its degrees of freedom: both are taken into account.
    """
    chance = false_alarms_per_day / (86_400.0 * frames_per_s * 2 * len(LENGTHS))
    freedom = 1.0 / (1.0 / windows + 1.0 / (FREEDOM * COUNT**FREEDOM_GROWTH))
    threshold = float(special.chdtri(6, chance))
    return THRESHOLD_MARGIN * threshold, np.asarray(special.fdtri(6.0, freedom, 1.0 - chance) * 6.0 / threshold)


def warm_up() -> None:
    """Compile what a frame needs, or load what was compiled."""
    test = SequentialTest(DriftSettings())
    for number in range(LEARN_EVERY + 1):
        test.add(np.full((1, 6), 1e-6 * number), 1e-12 * np.eye(6)[None])
    test.square_beyond(np.zeros(6), np.eye(6))
