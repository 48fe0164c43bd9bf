"""The sequential test with its arithmetic compiled."""

from __future__ import annotations

import numpy as np

from gripmon.judge.drift import kernel
from gripmon.judge.drift.sequential import (
    FAR,
    LEARNING_FRAMES,
    REPORTED_MEMORY,
    SHORT,
    SWEEPS,
    WORTH,
    Finding,
    PlainTest,
)
from gripmon.judge.drift.settings import DriftSettings
from gripmon.judge.drift.statistics import COUNT, LARGEST, LENGTHS, MEMORY_FRAMES, MEMORY_WINDOWS, PRIOR_WINDOWS, RARE
from gripmon.model.records import Array

_LENGTHS = np.array(LENGTHS)
_SHARE = np.minimum(0.5 * LEARNING_FRAMES / COUNT, 1.0)
_MOST_WINDOWS = np.maximum(0.5 * MEMORY_FRAMES / COUNT, MEMORY_WINDOWS)


class CompiledTest(PlainTest):
    """:class:`PlainTest`, its arithmetic by :mod:`~gripmon.judge.drift.kernel`."""

    def __init__(self, settings: DriftSettings, streams: int = 1):
        super().__init__(settings, streams)
        each = (streams, 6, 6)
        self._to_reported, self._from_reported = np.zeros((2, *each))
        self._plain = np.zeros((2, SHORT, *each))
        self._whitening = np.zeros((2, len(LENGTHS), *each))
        self._mean_covariance, self._learnt_whitening = np.zeros((2, len(LENGTHS), *each))

    def _report(self, covariance: Array) -> Array:
        if self._frames == 0:
            return super()._report(covariance)
        return kernel.report(self._reported, covariance, REPORTED_MEMORY)

    def _steady(self, shift: Array, usual: Array) -> Array:
        return kernel.steady(
            shift, usual, self._seen, self._sure, self._last_two, self._to_reported, self._from_reported
        )  # fmt: skip

    def square_beyond(self, shift: Array, covariance: Array) -> float:
        rooted, found = kernel.square_beyond(covariance, shift, self._tolerated, SWEEPS)
        return float(found) if rooted else super().square_beyond(shift, covariance)

    def _means(self) -> tuple[Array, Array]:
        return kernel.means(*self.windows.sums, _LENGTHS)

    def _beyond(self, mean: Array, difference: Array) -> Array:
        return kernel.beyond(
            mean, difference, self.windows.frames, _LENGTHS, self._whitening, self._limit, self._most_tolerated,
            self._tolerated, WORTH, SWEEPS,
        )  # fmt: skip

    def _decide(self, beyond: Array, first: int) -> Finding:
        return Finding(*kernel.decide(beyond, first, _LENGTHS))

    def _learn(self, difference: Array, usable: np.ndarray) -> None:
        normalised = kernel.squares(self._learnt_whitening, difference)
        learnt = self.scatter.of_differences, self.scatter.windows
        kernel.learn(difference, normalised, usable, *learnt, _SHARE, _MOST_WINDOWS, 6.0 * LARGEST)
        self._learn_surge(normalised, usable)
        self._learn_tail(normalised, usable)

    def _extreme_squares(self, mean: Array, difference: Array) -> Array:
        return kernel.extremes(mean, difference, self._middle, self._plain, self._limit, self._known, FAR)

    def _whiten(self, each: Array) -> None:
        scatter = self.scatter
        rooted = kernel.refresh(
            self._reported, scatter.of_differences, 1.0 - PRIOR_WINDOWS / scatter.windows, each, RARE, self._reference,
            self._known, self._plain, self._mean_covariance, self._whitening, self._learnt_whitening,
            self._to_reported, self._from_reported,
        )  # fmt: skip
        if not rooted:
            super()._whiten(each)


def warm_up() -> None:
    """Compile what a frame needs, or load what was compiled."""
    test = CompiledTest(DriftSettings())
    for number in range(4):
        test.add(np.full((1, 6), 1e-6 * number), 1e-12 * np.eye(6)[None])
    test.square_beyond(np.zeros(6), np.eye(6))
