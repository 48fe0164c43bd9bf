"""By how much the means of windows scatter while nothing moves, learnt from the stream.

Frames err together: the background stands still for a while, lamps flicker, a mount hums.  What the mean of n frames
is worth therefore follows from no formula.  It is measured, at every length n by itself: the difference of two
neighbouring windows of n frames has a covariance A(n) (twice Allan's variance), which a slow drift hardly touches.  By
Haar's decomposition the mean of n frames is that of 2 n frames plus or minus half the difference of its two halves; the
two are uncorrelated for a stationary noise, so that the mean's covariance is the sum of A(n), A(2 n), A(4 n) ... over
four.

Error that frames claim to have, but that the stream has not been seen to make, is taken for a bias of this background:
it changes with the background, at any moment.
"""

from __future__ import annotations

import numpy as np

from gripmon.judge.drift.windows import LENGTHS
from gripmon.model.records import Array

PRIOR_WINDOWS, PRIOR_SHARE = 12.0, 0.3
"""Pairs of windows that a small part of the reported covariance counts for at every length, before the stream has shown
its own: until then nearly all of what is claimed is a bias that may change.
"""

LONGER, LONG = (4, 1), 64
"""Lengths, each twice the one before, from a window's own on: noise that is seen in these is always there.  What shows
only in yet longer ones comes in rare steps, of which the next may come at any moment.  Windows of so many frames and
more are themselves as rare as that.
"""

MEMORY_FRAMES, MEMORY_WINDOWS = 36_000, 200
"""What is learnt is forgotten over so many frames, or windows, whichever is longer."""

LARGEST = 4.0
"""Normalised square of a difference, over its expectation, beyond which it counts as that much only."""

_COUNT = np.array(LENGTHS, dtype=float)[:, None]
_RARE = [min(k + LONGER[length >= LONG], len(LENGTHS)) for k, length in enumerate(LENGTHS)]


class Scatter:
    """Covariances of window means (k lengths, s streams, 6, 6)."""

    def __init__(self, streams: int):
        lengths = len(LENGTHS)
        self._of_difference = np.zeros((lengths, streams, 6, 6))
        self._windows = np.full((lengths, streams), PRIOR_WINDOWS)

    @property
    def windows(self) -> Array:
        """(k, s) pairs of independent windows that the covariances rest on."""
        return self._windows

    def begin(self, covariance: Array) -> None:
        """What to expect by the reported covariances (s, 6, 6), before the first frame has shown anything."""
        self._of_difference[:] = PRIOR_SHARE * covariance

    def learn(self, difference: Array, normalised: Array, usable: np.ndarray, frames: int) -> None:
        """Differences (k, s, 6) of neighbouring windows after ``frames`` more of them, their squares ``normalised``
        (k, s) to a mean of 6, and which of them to learn from.
        """
        share = np.minimum(0.5 * frames / _COUNT, 1.0)  # of an independent pair of windows
        most = np.maximum(0.5 * MEMORY_FRAMES / _COUNT, MEMORY_WINDOWS)
        self._windows = np.where(usable, np.minimum(self._windows + share, most), self._windows)
        tame = np.minimum(1.0, 6.0 * LARGEST / np.maximum(normalised, 1e-12))
        gain = np.where(usable, share / self._windows, 0.0)
        outer = (tame[..., None] * difference)[..., :, None] * difference[..., None, :]
        self._of_difference += gain[..., None, None] * (outer - self._of_difference)

    @property
    def of_differences(self) -> Array:
        """(k, s, 6, 6) of the differences between neighbouring windows, as learnt."""
        return self._of_difference

    def covariances(self, reported: Array, inflation: Array) -> tuple[Array, Array]:
        """(..., k, s, 6, 6) each: of the means of windows, and of the differences between neighbouring ones.

        ``reported`` (s, 6, 6) is what a frame claims for itself; ``inflation`` (..., k, s) by how much more the
        variance of what the stream has shown counts.
        """
        parts = 0.25 * self._of_difference
        parts[-1] *= 2.0  # beyond the longest, windows count as independent
        inflated = inflation[..., None, None]
        total = np.flip(np.cumsum(np.flip(inflated * parts, axis=-4), axis=-4), axis=-4)
        # What was only assumed has not been seen.
        learnt = (1.0 - PRIOR_WINDOWS / self._windows)[..., None, None]
        seen = np.cumsum((learnt * parts)[::-1], axis=0)[::-1]
        rare = np.concatenate([seen, np.zeros_like(seen[:1])])[_RARE]
        # All lengths at once: what is missing of the claim altogether, and of what is seen often enough.
        missing = _what_is_missing(np.concatenate([seen[:1], seen[:1] - rare]), reported)
        return total + missing[0], inflated * self._of_difference + 2.0 * missing[1:]

    def of_single_frames(self) -> Array:
        """(s, 6, 6) of frames about their mean, as the stream has shown it."""
        return np.asarray(0.25 * self._of_difference.sum(axis=0))


def _what_is_missing(seen: Array, claimed: Array) -> Array:
    """The part of a claimed covariance (s, 6, 6), direction by direction, that exceeds what was seen (..., s, 6, 6)."""
    root = np.linalg.cholesky(claimed)
    inverse = np.linalg.inv(root)
    share, directions = np.linalg.eigh(inverse @ seen @ np.swapaxes(inverse, -1, -2))
    towards = root @ directions
    return np.asarray((towards * np.maximum(1.0 - share, 0.0)[..., None, :]) @ np.swapaxes(towards, -1, -2))
