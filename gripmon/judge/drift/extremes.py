"""What an unmoved stream's own statistics exceed so rarely that a contract is kept, learnt from their extremes.

The largest value of every block of frames is kept.  Of the upper quarter of blocks the excess over the least of them is
taken to be distributed exponentially, in the statistic's square root, a number of standard deviations: between normal
errors, whose tails are lighter, and Student's, whose are heavier.  The level that a block exceeds with a given chance
follows by extrapolation.  It is the predictive one, which holds for the next block given that the tail's scale is
itself known from a few blocks only: the fewer there are, the farther out it lies.
"""

from __future__ import annotations

import math

import numpy as np

from gripmon.model.records import Array

BLOCK_FRAMES, KEPT_BLOCKS = 256, 512
"""Frames of a block, longer than bursts last (they do for half a second), and blocks that are remembered: half an hour
at 60 frames/s, since rare changes of the background must be among them.
"""

FEWEST_BLOCKS = 32
"""Blocks below which nothing is said: eight of them are in the tail then, and its scale is known to a third."""

UPPER = 0.25
"""Part of the blocks that is the tail."""


class Extremes:
    """Limits of statistics (kinds, streams), each by its own extremes.

    ``frames`` (kinds, 1): over how many frames a statistic stays alike; blocks within them count as one together.
    """

    def __init__(self, frames: Array, streams: int):
        shape = (len(frames), streams)
        self._ring = np.full((KEPT_BLOCKS, *shape), np.nan)
        self._largest = np.zeros(shape)
        self._usable = np.zeros(shape, dtype=np.intp)
        self._frames = 0
        self._alike = np.broadcast_to(np.maximum(frames / BLOCK_FRAMES, 1.0), shape)
        self.blocks = np.zeros(shape, dtype=np.intp)
        """(kinds, streams) that were remembered, each of :data:`BLOCK_FRAMES` frames."""

    def add(self, squares: Array, usable: np.ndarray, frames: int) -> bool:
        """Squared statistics (kinds, streams) after ``frames`` more frames, and which of them count; True if a block is
        complete.  A block of which less than half counts is left out.
        """
        np.maximum(self._largest, squares, out=self._largest, where=usable)
        self._usable += np.where(usable, frames, 0)
        self._frames += frames
        if self._frames % BLOCK_FRAMES:
            return False
        enough = 2 * self._usable >= BLOCK_FRAMES
        place = (self._frames // BLOCK_FRAMES - 1) % KEPT_BLOCKS
        self._ring[place] = np.where(enough, np.sqrt(self._largest), np.nan)
        self._largest[:] = 0.0
        self._usable[:] = 0
        self.blocks = np.isfinite(self._ring).sum(axis=0)
        return True

    def limits(self, chance: float) -> Array:
        """(kinds, streams) squares that a block exceeds with this chance; infinite where too little is known."""
        shown = self._ring[: min(self._frames // BLOCK_FRAMES, KEPT_BLOCKS)]
        enough = self.blocks >= FEWEST_BLOCKS * self._alike
        if not enough.any():
            return np.full(enough.shape, np.inf)
        tail = (UPPER * self.blocks).astype(np.intp)
        # Those that are missing come first.
        ordered = np.sort(np.where(np.isnan(shown), -1.0, shown), axis=0)
        rank = len(shown) - np.arange(len(shown))[:, None, None]
        start = np.take_along_axis(ordered, (len(shown) - tail - 1).clip(0)[None], axis=0)[0]
        scale = np.where(rank <= tail, ordered, 0.0).sum(axis=0) / np.maximum(tail, 1) - start
        # An exponential law whose scale is the mean of n values: (1 + x / (n scale))^-n is the chance of the next.
        known = np.maximum(tail / self._alike, 1.0)
        reach = known * np.expm1(math.log(UPPER / chance) / known)
        return np.where(enough, np.square(start + scale * reach), np.inf)
