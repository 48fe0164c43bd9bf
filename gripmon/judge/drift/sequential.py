"""Has the camera moved?  A generalised likelihood ratio test over windows of 1 to 4096 frames.

For every window length two hypotheses are tested against an unmoved camera: its mean lies off the reference (which
finds creeps, and any shift in the end), and it differs from the mean of the window before (which finds steps soon, for
errors that last cancel in the difference).  Unknown shifts are estimated, so that each statistic is Hotelling's T² with
the covariances that the stream itself has shown, of the part of the shift that lies beyond what is tolerated.  Lai 1995
gives the scheme for independent frames; that frames err together enters through the covariances alone.

At first the threshold comes from assumed errors before clutter, and for long windows it stays there.  Once the stream
has shown enough extremes of its own, the thresholds of short windows are learnt from these.
"""

from __future__ import annotations

from dataclasses import dataclass

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
"""Rounds over the axes; each can only come closer, and after none of them the answer is too small."""


REFRESH_FRAMES = 16
"""Frames after which covariances are inverted and thresholds reckoned again."""

FREEDOM, FREEDOM_GROWTH = 9.0, 1.0 / 3.0
"""Student's degrees of freedom of a single frame's error, which simulated images in clutter show, and the power of the
number of frames with which those of a mean grow: the mean of many is more nearly normal.
"""

TAIL, TAIL_WINDOWS = 0.01, 500.0
NORMAL_SQUARE = chi_square_limit(TAIL)
"""How far out the noise's own distribution is compared with the normal one, over how many windows, and where that is
for normal errors.
"""

STUDENT_TAIL, HEAVY = 1.6, (0.25, 1.5)
"""The ratio for Student's distribution with :data:`FREEDOM`, which is assumed at first; a stream with less heavy, or
heavier, tails has this much of the logarithm of its inflation at least and at most.
"""

SURGE_FRAMES, SURGE_WINDOWS = 32, 16
"""Differences over the last frames, or windows, that are larger than learnt count as noise."""

THRESHOLD_MARGIN = 1.55
"""Factor on the threshold: biases have heavier tails than normal ones, too, and change by more than theory has it (on
streams simulated after images the contract needed 1.2 to 1.5).
"""

SHORT_LENGTHS = LENGTHS.index(BLOCK_FRAMES) + 1
"""Lengths, 1 to 256 frames, whose limits are learnt: of longer windows a stream shows too few."""

ALIKE_FRAMES = 2.0 * BLOCK_FRAMES
"""Frames over which a background stays, at least, and bursts come and go: their extremes count as one together."""

OUTLIER_LIMIT_RATIO = 2.0
"""Times its limit beyond which a difference is no noise, and raises no limit.  What is nearer may be either."""

EXTREME_FRAMES = 2
"""Frames after which extremes are looked for: of three frames' medians neighbours are nearly the same."""

BIAS_FREEDOM = 10.0
"""Student's degrees of freedom of the bias that a background makes, on simulated images."""

REPORTED_MEMORY = 1.0 / 64.0

_LENGTHS = np.array(LENGTHS)

SEARCH_THRESHOLD_RATIO = 0.25
"""Part of its threshold from which a statistic is worth the search for the shift that may be tolerated."""


@dataclass(frozen=True, slots=True)
class Finding:
    """What the test says after a frame, for each stream (s,): whether the camera has ``moved``; if so ``length``, the
    frames of the window that showed it, and whether it was a difference (``stepped``) or its mean; ``excess`` of the
    largest statistic over its threshold (1 at the threshold).
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
        self._bias: Array = np.zeros((6, 6))
        self._lasting = np.zeros((len(LENGTHS), 6, 6))
        self._frames = self._since_restart = 0
        self.refreshes = 0
        """How often covariances and thresholds were reckoned again."""
        self._surge = np.ones((len(LENGTHS), streams))
        self._tail = np.full((len(LENGTHS), streams), STUDENT_TAIL)
        self._stale = True
        self._seen_last: tuple[Array, Array, Array, np.ndarray | None] | None = None
        self._threshold = 1.0
        self._inflation: Array | None = None
        self._extremes = Extremes(np.tile(np.maximum(2.0 * COUNT[:SHORT_LENGTHS], ALIKE_FRAMES), (2, 1)), streams)
        self._of_extremes: tuple[float, np.ndarray, Array] | None = None
        self._limit = np.full((2, len(LENGTHS), streams), np.inf)
        self._known = np.zeros(self._limit.shape, dtype=bool)
        self._middle: Array = np.zeros((streams, 6))
        lengths, each = len(LENGTHS), (streams, 6, 6)
        self._to_reported, self._from_reported = np.zeros((2, *each))
        self._plain, self._whitening = np.zeros((2, SHORT_LENGTHS, *each)), np.zeros((2, lengths, *each))
        self._mean_covariance, self._learnt_whitening = np.zeros((2, lengths, *each))

    def set_frames_per_s(self, frames_per_s: float) -> None:
        """The stream's own rate: the contract is in days, the thresholds are in frames."""
        if abs(frames_per_s - self._frames_per_s) > 0.05 * self._frames_per_s:
            self._frames_per_s, self._inflation, self._stale = frames_per_s, None, True

    def set_reference_covariance(self, covariance: Array) -> None:
        """Covariance (6, 6) or (s, 6, 6) of the reference's own error: so much of a mean shift is not a drift."""
        self._reference = np.broadcast_to(covariance, (self._streams, 6, 6)).copy()
        self._stale = True

    def set_bias(self, covariance: Array, share: float) -> None:
        """Covariance (6, 6) of an error that all frames have alike, and the share of it that is another one from frame
        to frame: so much isn't a drift of a mean, nor, by as much as has changed, a difference.
        """
        self._bias, self._stale = covariance, True
        self._lasting = 2.0 * np.minimum(COUNT * share, 1.0)[:, :, None] * covariance

    def add(
        self, shift: Array, covariance: Array, learn: np.ndarray | None = None, at_least: int = LENGTHS[0]
    ) -> Finding:
        """One frame's shift (s, 6) against the reference, m and rad, with its reported covariance (s, 6, 6).

        ``learn`` (s,): whether the frame may count as one in which nothing moves; all of them if left out.  Windows of
        fewer than ``at_least`` frames decide nothing now.
        """
        self.learn()
        if self._frames == 0:
            self._reported = np.array(covariance)
            self.scatter.begin(covariance)
        if self._stale:
            self._refresh()
        # The median of three frames: no single frame can decide, and a step is late by one.  In axes in which errors
        # are independent: medians of others need not be a shift that any of the frames makes likely.
        mean, difference = self.windows.add(
            kernel.steady(
                shift, covariance, REPORTED_MEMORY, self._reported, self._seen, self._sure, self._last_two,
                self._to_reported, self._from_reported,
            )
        )  # fmt: skip
        self._frames, self._since_restart = self._frames + 1, self._since_restart + 1
        if self._since_restart < 3:
            # Of fewer than three frames there is no middle one.
            self.windows.keep(self._seen < 3, 0)
        beyond, found = kernel.decide(
            mean, difference, self.windows.frames, _LENGTHS, self._whitening, self._limit, self._most_tolerated,
            self._tolerated, SEARCH_THRESHOLD_RATIO, SWEEPS, LENGTHS.index(at_least),
        )  # fmt: skip
        self._seen_last = mean, difference, beyond, learn
        return Finding(*found)

    def learn(self) -> None:
        """What the newest frame teaches for those to come; :meth:`add` does it first if it hasn't been done."""
        if self._seen_last is None:
            return
        (mean, difference, beyond, learn), self._seen_last = self._seen_last, None
        if self._frames % EXTREME_FRAMES == 0:
            usable = np.stack(self.windows.full()) & (beyond[1] <= OUTLIER_LIMIT_RATIO).all(axis=0)
            self._learn_extremes(mean, difference, usable if learn is None else usable & learn)
        if self._frames % LEARN_EVERY == 0:
            # An offset that stays says nothing against what differences show.
            usable = self.windows.full()[1] & ~(beyond[1] > 1.0).any(axis=0)
            self._learn(difference, usable if learn is None else usable & learn)
        if self._frames % REFRESH_FRAMES == 0 and not self._stale:
            self._refresh()

    def level(self, frames: int) -> tuple[Array, Array]:
        """Mean shift (s, 6) over the last ``frames`` frames, and its covariance (s, 6, 6) (that of the next shorter
        window of :data:`LENGTHS`, which are the powers of two).
        """
        return self.windows.mean_of_last(frames), self._mean_covariance[frames.bit_length() - 1]

    def square_beyond(self, shift: Array, covariance: Array) -> float:
        """Normalised square of what of a shift (6,) with a covariance (6, 6) isn't tolerated."""
        return float(kernel.square_beyond(covariance, shift, self._tolerated, SWEEPS))

    def noticed(self) -> Array | None:
        """(6,) constant shifts, each alone on its axis, that the first stream's windows that are full show by their
        means; None while there is none.
        """
        full = self.windows.full()[0][:, 0]
        if not self.refreshes or not full.any():
            return None
        precision = np.square(self._whitening[0, full, 0]).sum(axis=-2)
        sizes = np.sqrt(self._limit[0, full, 0, None] / precision)
        return np.asarray(sizes.min(axis=0) + self._tolerated)

    def usual_covariance(self) -> Array:
        """(6, 6) of the first stream's shifts about their mean, by what was learnt and what frames claim."""
        return np.asarray(self.scatter.of_single_frames()[0] + self._reported[0])

    def restart(self, streams: np.ndarray, keep: np.ndarray | int = 0) -> None:
        """Forget the frames of some streams (s,) but the last ``keep``; what was learnt about the noise stays."""
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
        """Whether differences (k, s) are larger just now than in the long run: noise comes in bursts."""
        rate = np.where(usable, LEARN_EVERY / np.maximum(SURGE_FRAMES, SURGE_WINDOWS * COUNT), 0.0)
        self._surge += rate * (np.minimum(normalised / 6.0, LARGEST_SQUARE) - self._surge)

    def _learn_tail(self, normalised: Array, usable: np.ndarray) -> None:
        """Follow the size of differences (k, s) that one in a hundred exceeds (Robbins and Monro), over that of normal
        ones.
        """
        share = np.minimum(LEARN_EVERY / (2.0 * COUNT), 1.0) / TAIL_WINDOWS
        beyond = (normalised > self._tail * NORMAL_SQUARE) / TAIL - 1.0
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
            self._learnt_limits()  # what the next frame's refresh wants, so that no frame pays for both

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
        heavy = np.clip((self._tail - 1.0) / (STUDENT_TAIL - 1.0), *HEAVY)
        surge = np.maximum(self._surge, 1.0)
        # What is told of a mean is its standard deviation, not what would be too rare.
        self._whiten(np.stack([self._inflation**heavy * surge, np.ones_like(surge), surge]))
        self._most_tolerated = np.linalg.norm(np.abs(self._whitening[0]) @ self._tolerated, axis=-1)

    def _whiten(self, each: Array) -> None:
        """Covariances of means and differences, and their whitening, where the variance of what was seen counts so
        many times, ``each`` (3, k, s): for limits that are assumed, standard deviations, and limits that are learnt.
        """
        kernel.refresh(
            self._reported, self.scatter.of_differences, self.scatter.learnt, each, RARE, self._reference + self._bias,
            self._lasting, self._known, self._plain, self._mean_covariance, self._whitening, self._learnt_whitening,
            self._to_reported, self._from_reported,
        )  # fmt: skip

    def _limits(self) -> tuple[Array, np.ndarray]:
        """Squares (2, k, s) beyond which the camera has moved, and which of them are learnt.

        None is below what normal errors ask for.  A bias that a stream has never been seen to change within so many
        frames may do so for the first time, but once in as many frames at most.
        """
        learnt = self._learnt_limits()
        limit = np.full((2, len(LENGTHS), self._streams), self._threshold)
        known = np.zeros(limit.shape, dtype=bool)
        known[:, :SHORT_LENGTHS] = np.isfinite(learnt)
        limit[:, :SHORT_LENGTHS] = np.where(known[:, :SHORT_LENGTHS], learnt, self._threshold)
        return limit, known

    def _learnt_limits(self) -> Array:
        """(2, SHORT_LENGTHS, s) by the extremes of the blocks so far; infinite where too few are known."""
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
    """What the squares of six normal errors exceed by chance so rarely that all lengths together keep the contract; and
    (k, s) by how much larger the variance of the stream's own scatter, known from so many ``windows`` (k, s), must be
    taken for the same.

    T² / 6 of a covariance from m samples is distributed as F(6, m), nearly (Hotelling), and so is that of errors with
    Student's distribution, with its degrees of freedom: both count.
    """
    chance = false_alarms_per_day / (86_400.0 * frames_per_s * 2 * len(LENGTHS))
    freedom = 1.0 / (1.0 / windows + 1.0 / (FREEDOM * COUNT**FREEDOM_GROWTH))
    threshold = float(special.chdtri(6, chance))
    return THRESHOLD_MARGIN * threshold, np.asarray(special.fdtri(6.0, freedom, 1.0 - chance) * 6.0 / threshold)


def warm_up() -> None:
    """Compile what a frame needs, or load what was compiled."""
    test = SequentialTest(DriftSettings())
    for number in range(4):
        test.add(np.full((1, 6), 1e-6 * number), 1e-12 * np.eye(6)[None])
    test.square_beyond(np.zeros(6), np.eye(6))
