"""Means of blocks of frames, smoothed forwards and backwards (Kalman; Rauch, Tung and Striebel 1965), axis by axis.

A state is the pose, its rate and an error that lasts as long as a background; frames add errors of their own.  A pose
stands still, or its rate is a random walk: of a few such walks the likeliest is taken, by the recording itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gripmon.analyse.change_points import MEDIAN_SQUARE
from gripmon.analyse.vectors import Bools, Ints, Run
from gripmon.model.records import Array

BLOCK_S, SLOW_S = 0.5, 15.0
"""Correlation times of a frame's errors: details that pass behind an edge, which are as good as new in every block;
and a background that stays while a robot's arm works in one place.
"""
TURNS_PER_S3 = (0.0, 1e-6, 1e-4, 1e-2, 1.0)
"""What the variance of a pose's rate may grow by in a second, in reported variances per s², by decades of the rate:
none; from a standard deviation in a quarter of an hour's walk to one within a second.
"""
SLOW_FACTORS = (1.0, 3.0, 9.0)
"""What the variance of the lasting error may be, as multiples of the reported variance that frames don't show."""
MIN_SLOW_VARIANCE = 0.3
"""Least share of the reported variance that lasts: the error of a background that never changes can't be seen."""
MIN_BLOCK_VARIANCE = 1e-6
UNKNOWN_VARIANCE, UNKNOWN_RATE_VARIANCE = 1e7, 100.0
"""Variance of an unknown pose, in reported variances, and of an unknown rate (1/s²)."""


class Blocks:
    """Means (m, 6) of the frames within :data:`BLOCK_S` in a segment, at ``time_s`` (m,); NaN, with infinite variance,
    where none is usable.  ``swing`` (n, 6): additional variance of frames.
    """

    def __init__(self, run: Run, segment: Ints, swing: Array):
        key = np.floor(run.time_s / max(BLOCK_S, run.frame_s))
        new = (np.diff(key, prepend=-1.0) != 0) | (np.diff(segment, prepend=-1) > 0)
        at, number = np.flatnonzero(new), np.cumsum(new) - 1
        noise = run.claimed + swing
        weight = np.where(run.usable[:, None], 1.0 / noise, 0.0)
        total = np.add.reduceat(weight, at, axis=0)
        counted = np.add.reduceat(run.usable.astype(float), at)
        some = counted > 0.0
        with np.errstate(divide="ignore", invalid="ignore"):
            self.mean = np.add.reduceat(weight * np.where(run.usable[:, None], run.y, 0.0), at, axis=0) / total
            self.relative = np.where(some[:, None], 1.0 / total, np.inf)
        plain = np.where(np.repeat(some, np.diff(np.append(at, len(number)))), run.usable, True).astype(float)
        self.time_s = np.add.reduceat(plain * run.time_s, at) / np.add.reduceat(plain, at)
        self.segment = segment[at]
        self.restarts: Bools = np.diff(self.segment, prepend=0) > 0
        self._usual = float(np.median(counted[some]))
        off = (run.y - self.mean[number])[run.usable & (counted[number] > 1.0)]
        freedom = self._usual / max(self._usual - 1.0, 1.0)
        self.frame = np.median(off**2, axis=0) / MEDIAN_SQUARE * freedom if len(off) else np.zeros(6)
        self._swing = np.add.reduceat(np.where(run.usable[:, None], swing * weight, 0.0), at, axis=0) * np.where(
            some[:, None], self.relative, 0.0
        )
        self.white = self._new_in_each()

    def _new_in_each(self) -> Array:
        """(6,) variance of an ordinary block's own error, by second differences, in which a creep doesn't show."""
        part = self.mean[np.isfinite(self.mean[:, 0])]
        segment = self.segment[np.isfinite(self.mean[:, 0])]
        second = (part[:-2] - 2.0 * part[1:-1] + part[2:])[segment[:-2] == segment[2:]]
        if len(second) < 8:  # too few to estimate: as if a fourth of the reported variance were new
            return np.full(6, 0.25)
        return np.asarray(np.median(second**2, axis=0) / MEDIAN_SQUARE / 6.0)

    @property
    def slow(self) -> Array:
        """(6,) the reported variance that frames and blocks don't show."""
        return np.maximum(1.0 - self.frame - self.white, MIN_SLOW_VARIANCE)

    @property
    def variance(self) -> Array:
        """(m, 6) of the blocks' own errors."""
        return np.maximum(self.white * self._usual * self.relative, MIN_BLOCK_VARIANCE) + self._swing


@dataclass(frozen=True)
class Smoothed:
    """Pose and rate ``x``, ``rate`` (m, a) at ``time_s`` (m,), their covariance (m, a, 2, 2), ``segment`` (m,); the
    variances (a,) of the lasting error and of the rate's walk, and ``log_likelihood`` (a,).
    """

    time_s: Array
    segment: Ints
    x: Array
    rate: Array
    covariance: Array
    slow: Array
    turn: Array
    log_likelihood: Array

    @property
    def least_variance(self) -> Array:
        """(a,) of a pose's error: a background that never changes can't be seen, nor any if the pose itself walks."""
        return np.where(self.turn > 0.0, self.slow, MIN_SLOW_VARIANCE)

    def at(self, wanted_s: Array, segment: Ints) -> tuple[Array, Array]:
        """x (k, a) and its variance (k, a) at any times, from the neighbouring states of the same segment."""
        first = np.searchsorted(self.segment, segment, side="left")
        last = np.searchsorted(self.segment, segment, side="right") - 1
        after = np.clip(np.searchsorted(self.time_s, wanted_s), first, last)
        before = np.clip(after - 1, first, last)
        span_s = np.maximum(self.time_s[after] - self.time_s[before], 1e-9)
        f = np.clip((wanted_s - self.time_s[before]) / span_s, 0.0, 1.0)

        def mixed(values: Array) -> Array:
            return np.asarray(((1.0 - f) * values[before].T + f * values[after].T).T)

        t = (wanted_s - np.clip(wanted_s, self.time_s[before], self.time_s[after]))[:, None]
        p = mixed(self.covariance)
        variance = p[..., 0, 0] + 2.0 * t * p[..., 0, 1] + t * t * p[..., 1, 1]
        return mixed(self.x) + t * mixed(self.rate), variance


def smooth_blocks(blocks: Blocks) -> Smoothed:
    """The smoothed blocks, by the likeliest walk and lasting error of each axis."""
    tried = np.array([(factor, turn) for factor in SLOW_FACTORS for turn in TURNS_PER_S3])
    axes = blocks.mean.shape[1]
    slow, turn = (tried[:, :1] * blocks.slow).ravel(), np.repeat(tried[:, 1], axes)
    y, variance = (np.tile(values, (1, len(tried))) for values in (blocks.mean, blocks.variance))
    model = _Model(blocks.time_s, blocks.restarts, slow, turn)
    found = model.filtered(y, variance).reshape(len(tried), axes)
    best = found.argmax(axis=0) * axes + np.arange(axes)
    return smooth(
        blocks.time_s, blocks.mean, blocks.variance, blocks.restarts, slow[best], turn[best], blocks.segment
    )


def smooth(
    time_s: Array, y: Array, variance: Array, restarts: Bools, slow: Array, turn: Array, segment: Ints | None = None
) -> Smoothed:
    """Smooth series ``y`` (m, a) with noise variances (m, a), infinite where nothing was measured, at the times (m,).

    ``restarts`` (m,): x is unknown again from there on.  ``slow``, ``turn`` (a,): as in :class:`Smoothed`.
    """
    model = _Model(time_s, restarts, slow, turn)
    steps: list[tuple[Array, ...]] = []
    log_likelihood = model.filtered(y, variance, steps)
    predicted, predicted_cov, mean, cov = (np.array(each) for each in zip(*steps, strict=True))
    # The regularisation makes a covariance of zero invertible; such a state needs no correction.
    inverse = np.linalg.inv(predicted_cov + 1e-12 * np.eye(3))
    for k in range(len(mean) - 2, -1, -1):
        gain = cov[k] @ model.transition[k + 1].T @ inverse[k + 1]
        mean[k] += (gain @ (mean[k + 1] - predicted[k + 1])[..., None])[..., 0]
        cov[k] += gain @ (cov[k + 1] - predicted_cov[k + 1]) @ np.swapaxes(gain, -1, -2)
    segment = np.cumsum(restarts) if segment is None else segment
    return Smoothed(time_s, segment, mean[..., 0], mean[..., 1], cov[..., :2, :2], slow, turn, log_likelihood)


class _Model:
    """Pose, rate and lasting error: ``transition`` (m, 3, 3) into each step, and what is added there."""

    def __init__(self, time_s: Array, restarts: Bools, slow: Array, turn: Array):
        elapsed = np.diff(time_s, prepend=time_s[0])
        fade = np.exp(-elapsed / SLOW_S)
        self.transition = np.tile(np.eye(3), (len(time_s), 1, 1))
        self._walk, self._lasting = np.zeros((2, len(time_s), 3, 3))
        self.transition[:, 0, 1], self.transition[:, 2, 2] = elapsed, fade
        self._walk[:, 0, 0], self._walk[:, 1, 1] = elapsed**3 / 3.0, elapsed
        self._walk[:, 0, 1] = self._walk[:, 1, 0] = elapsed**2 / 2.0
        self._lasting[:, 2, 2] = 1.0 - fade**2
        self._restarts = restarts
        self._slow, self._turn = slow[:, None, None], turn[:, None, None]

    def filtered(
        self, y: Array, variance: Array, steps: list[tuple[Array, ...]] | None = None
    ) -> Array:
        """Log-likelihood (a,) of series (m, a); to ``steps`` are added the predicted means (a, 3) and covariances
        (a, 3, 3) and the filtered ones.
        """
        known: Bools = np.isfinite(variance) & np.isfinite(y)
        noise, values = np.where(known, variance, 1.0), np.where(known, y, 0.0)
        mean, log_density = np.zeros((y.shape[1], 3)), np.zeros(y.shape[1])
        cov = self._slow * np.diag([0.0, 0.0, 1.0]) + np.diag([UNKNOWN_VARIANCE, 0.0, 0.0])
        cov = cov + (self._turn > 0.0) * np.diag([0.0, UNKNOWN_RATE_VARIANCE, 0.0])
        for k, move in enumerate(self.transition):
            mean = mean @ move.T
            cov = move @ cov @ move.T + self._turn * self._walk[k] + self._slow * self._lasting[k]
            if self._restarts[k]:
                cov[:, 0, 0] += UNKNOWN_VARIANCE
            predicted, predicted_cov = mean, cov
            towards = (cov[..., 0] + cov[..., 2]) * known[k][:, None]
            expected = cov[:, 0, 0] + 2.0 * cov[:, 0, 2] + cov[:, 2, 2] + noise[k]
            innovation = values[k] - mean[:, 0] - mean[:, 2]
            mean = mean + towards * (innovation / expected)[:, None]
            cov = cov - towards[:, :, None] * (towards / expected[:, None])[:, None, :]
            log_density -= known[k] * (np.log(2.0 * np.pi * expected) + innovation * innovation / expected)
            if steps is not None:
                steps.append((predicted, predicted_cov, mean, cov))
        return np.asarray(0.5 * log_density)
