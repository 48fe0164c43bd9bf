"""Statistics of the stream for the drift test: means over windows, their covariance, their extremes.

*Windows*: means over the last n frames for many n at once, at a cost that doesn't depend on n.

*Scatter*: the covariance of window means while nothing moves, learnt from the stream.  The errors of frames are
correlated: the background stands still for a while, lamps flicker, a mount hums.  Therefore no formula gives the error
of the mean of n frames; it is measured for every length n separately.  The difference of two neighbouring windows of n
frames has a covariance A(n) (twice the Allan variance), which a slow drift hardly affects.  By Haar's decomposition the
mean of n frames is that of 2 n frames plus or minus half the difference of its two halves.  The two are uncorrelated
for stationary noise, so that the mean's covariance is the sum of A(n), A(2 n), A(4 n) ... over four.  Error that frames
claim but the stream hasn't shown counts as a bias from this background, which may change with it at any moment.

*Extremes*: the threshold of a stream, learnt by extreme value theory from the largest statistic of every block of
frames.  In the upper quarter of the blocks the excess over the smallest is modelled as exponential in the statistic's
square root, a number of standard deviations: a tail between that of normal errors and that of Student's.  The level
that a block exceeds with a given probability follows by extrapolation.  It is the predictive one, which holds for the
next block although the tail's scale is known from few blocks: the fewer blocks, the higher the level.
"""

from __future__ import annotations

import math

import numpy as np

from gripmon.judge.drift import kernel
from gripmon.model.records import Array

LENGTHS = tuple(2**k for k in range(13))
"""Frames in a window: 1, 2, 4 ... 4096, which is a minute at 60 frames/s."""

COUNT = np.array(LENGTHS, dtype=float)[:, None]
"""The lengths (k, 1), for vectorised computations."""


class Windows:
    """Running means of ``streams`` series of 6-vectors, from a ring of their sums.

    One stream for the daemon; benchmarks run hundreds in parallel.
    """

    def __init__(self, streams: int):
        self._ring = np.zeros((2 * LENGTHS[-1] + 1, streams, 6))
        self.lengths = np.array(LENGTHS)
        self._newest = 0

        self.frames = np.zeros(streams, dtype=np.intp)
        """Frames (s,) in the windows of each stream."""

    def add(self, values: Array) -> tuple[Array, Array]:
        """Add one frame's values (s, 6); returns the means (k, s, 6) of the last n frames, for every n of
        :data:`LENGTHS`, and their differences from the means of the n frames before.

        Values that reach back beyond the first frame are meaningless; see :meth:`full`.
        """
        self._newest = (self._newest + 1) % len(self._ring)
        self.frames += 1
        of: tuple[Array, Array] = kernel.slide(self._ring, self._newest, values, self.lengths)
        return of

    def full(self) -> tuple[np.ndarray, np.ndarray]:
        """Masks (k, s): whether the last n frames, and the last 2 n, lie within the stream."""
        count = self.lengths[:, None]
        return self.frames >= count, self.frames >= 2 * count

    def mean_of_last(self, frames: int) -> Array:
        """Mean (s, 6) over the last ``frames`` frames, 1 to 4096."""
        return (self._ring[self._newest] - self._ring[(self._newest - frames) % len(self._ring)]) / frames

    def keep(self, streams: np.ndarray, frames: np.ndarray | int) -> None:
        """Forget all but the last ``frames`` frames of some streams (s,), a mask."""
        self.frames = np.where(streams, np.minimum(self.frames, frames), self.frames)


PRIOR_WINDOWS, PRIOR_SHARE = 12.0, 0.3
"""Pairs of windows that the assumed covariance is worth at every length, and its share of the reported covariance,
until the stream has shown its own: until then nearly all of the claimed error is a bias that may change.
"""

ALWAYS_LENGTHS, LONG_FRAMES = (4, 1), 64
"""Number of lengths, from a window's own on, whose noise is always present: for windows shorter than ``LONG_FRAMES``,
and for longer ones.  Noise that shows only at longer lengths comes in rare steps, and the next may come at any moment.
Windows of ``LONG_FRAMES`` and more are as rare themselves.
"""

MEMORY_FRAMES, MEMORY_WINDOWS = 36_000, 200
"""Memory of what is learnt, in frames and in windows; the longer one applies."""

LARGEST_SQUARE = 4.0
"""Largest squared normalised difference, over its expectation, that is learnt; larger ones are clipped to it."""

RARE = np.array([min(k + ALWAYS_LENGTHS[length >= LONG_FRAMES], len(LENGTHS)) for k, length in enumerate(LENGTHS)])
"""(k,) for each length, the index of the first length at which noise counts as rare to it."""


class Scatter:
    """Covariances of window means (k lengths, s streams, 6, 6)."""

    def __init__(self, streams: int):
        lengths = len(LENGTHS)
        self._of_difference = np.zeros((lengths, streams, 6, 6))
        self._windows = np.full((lengths, streams), PRIOR_WINDOWS)
        self._most_windows = np.maximum(0.5 * MEMORY_FRAMES / COUNT, MEMORY_WINDOWS)

    @property
    def windows(self) -> Array:
        """Pairs of independent windows (k, s) from which the covariances are known."""
        return self._windows

    def begin(self, covariance: Array) -> None:
        """Start with what the reported covariances (s, 6, 6) suggest, before the first frame."""
        self._of_difference[:] = PRIOR_SHARE * covariance

    def learn(self, difference: Array, normalised: Array, usable: np.ndarray, frames: int) -> None:
        """Learn from differences (k, s, 6) of neighbouring windows after ``frames`` more frames; ``normalised`` (k, s):
        their squares, normalised to a mean of 6; ``usable`` (k, s): those to learn from.
        """
        share = np.minimum(0.5 * frames / COUNT, 1.0)  # of an independent pair of windows
        kernel.learn(
            difference, normalised, usable, self._of_difference, self._windows, share, self._most_windows,
            6.0 * LARGEST_SQUARE,
        )  # fmt: skip

    @property
    def of_differences(self) -> Array:
        """Covariances (k, s, 6, 6) of the differences between neighbouring windows, as learnt."""
        return self._of_difference

    @property
    def learnt(self) -> Array:
        """Part (k, s) of the covariances that the stream has shown; the rest is assumed."""
        return 1.0 - PRIOR_WINDOWS / self._windows

    def of_single_frames(self) -> Array:
        """Covariance (s, 6, 6) of frames about their mean, as the stream has shown it."""
        return np.asarray(0.25 * self._of_difference.sum(axis=0))


BLOCK_FRAMES, KEPT_BLOCKS = 256, 512
"""Frames in a block, longer than bursts last (half a second), and number of blocks that are kept: half an hour at 60
frames/s, to include rare changes of the background.
"""

FEWEST_BLOCKS = 32
"""Fewest blocks for a limit: eight of them are then in the tail, and its scale is known to a third."""

TAIL_SHARE = 0.25
"""Part of the blocks that forms the tail."""

_LEFT_OUT = -1.0  # below the root of any square


class Extremes:
    """Limits of statistics (kinds, streams), each from its own extremes.

    ``frames`` (kinds, 1): over how many frames a statistic is correlated; blocks within them count as one.
    """

    def __init__(self, frames: Array, streams: int):
        shape = (len(frames), streams)
        self._ring = np.full((*shape, KEPT_BLOCKS), _LEFT_OUT)
        self._largest = np.zeros(shape)
        self._usable = np.zeros(shape, dtype=np.intp)
        self._frames = 0
        self._alike = np.broadcast_to(np.maximum(frames / BLOCK_FRAMES, 1.0), shape)
        self.blocks = np.zeros(shape, dtype=np.intp)
        """Number (kinds, streams) of blocks kept, each of :data:`BLOCK_FRAMES` frames."""

    def add(self, squares: Array, usable: np.ndarray, frames: int) -> bool:
        """Add squared statistics (kinds, streams) after ``frames`` more frames, and which of them count; True if a
        block is complete.  A block of which less than half counts is left out.
        """
        np.maximum(self._largest, squares, out=self._largest, where=usable)
        self._usable += np.where(usable, frames, 0)
        self._frames += frames
        if self._frames % BLOCK_FRAMES:
            return False
        enough = 2 * self._usable >= BLOCK_FRAMES
        place = (self._frames // BLOCK_FRAMES - 1) % KEPT_BLOCKS
        self._ring[..., place] = np.where(enough, np.sqrt(self._largest), _LEFT_OUT)
        self._largest[:] = 0.0
        self._usable[:] = 0
        self.blocks = (self._ring != _LEFT_OUT).sum(axis=-1)
        return True

    def limits(self, chance: float) -> Array:
        """Squares (kinds, streams) that a block exceeds with this probability; infinite where too little is known."""
        count = min(self._frames // BLOCK_FRAMES, KEPT_BLOCKS)
        enough = self.blocks >= FEWEST_BLOCKS * self._alike
        if not enough.any():
            return np.full(enough.shape, np.inf)
        tail = (TAIL_SHARE * self.blocks).astype(np.intp)
        # Those left out come first; only the upper ones need to be sorted.
        ordered = np.sort(self._ring[..., :count], axis=-1)
        start = np.take_along_axis(ordered, (count - tail - 1).clip(0)[..., None], axis=-1)[..., 0]
        rank = count - np.arange(count)
        scale = np.where(rank <= tail[..., None], ordered, 0.0).sum(axis=-1) / np.maximum(tail, 1) - start
        # An exponential with the mean of n values as scale: the next value exceeds x with probability (1 + x / (n
        # scale))^-n.
        known = np.maximum(tail / self._alike, 1.0)
        reach = known * np.expm1(math.log(TAIL_SHARE / chance) / known)
        return np.where(enough, np.square(start + scale * reach), np.inf)
