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
    """The smoothed blocks, by the likeliest walk of each axis."""
    tried = np.array([(factor, turn) for factor in SLOW_FACTORS for turn in TURNS_PER_S3])
    axes = blocks.mean.shape[1]
    slow = (tried[:, :1] * blocks.slow).ravel()
    turn = np.repeat(tried[:, 1], axes)
    y, variance = (np.tile(values, (1, len(tried))) for values in (blocks.mean, blocks.variance))
    found = _filter(blocks.time_s, y, variance, blocks.restarts, slow, turn)[-1].reshape(len(tried), axes)
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
    transition, predicted, predicted_cov, mean, cov, log_likelihood = _filter(
        time_s, y, variance, restarts, slow, turn
    )
    # The regularisation makes a covariance of zero invertible; such a state needs no correction.
    inverse = np.linalg.inv(predicted_cov + 1e-12 * np.eye(3))
    for k in range(len(mean) - 2, -1, -1):
        gain = cov[k] @ transition[k + 1].T @ inverse[k + 1]
        mean[k] += (gain @ (mean[k + 1] - predicted[k + 1])[..., None])[..., 0]
        cov[k] += gain @ (cov[k + 1] - predicted_cov[k + 1]) @ np.swapaxes(gain, -1, -2)
    segment = np.cumsum(restarts) if segment is None else segment
    return Smoothed(time_s, segment, mean[..., 0], mean[..., 1], cov[..., :2, :2], slow, turn, log_likelihood)


def _filter(
    time_s: Array, y: Array, variance: Array, restarts: Bools, slow: Array, turn: Array
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Transitions (m, 3, 3) into each step, predicted and filtered means (m, a, 3) and covariances (m, a, 3, 3),
    log-likelihood (a,).
    """
    steps, series = y.shape
    elapsed = np.diff(time_s, prepend=time_s[0])
    fade = np.exp(-elapsed / SLOW_S)
    transition = np.tile(np.eye(3), (steps, 1, 1))
    transition[:, 0, 1], transition[:, 2, 2] = elapsed, fade
    t = elapsed[:, None]
    added = np.zeros((steps, series, 3, 3))
    added[..., 0, 0] = turn * t**3 / 3.0 + UNKNOWN_VARIANCE * restarts[:, None]
    added[..., 0, 1] = added[..., 1, 0] = turn * t**2 / 2.0
    added[..., 1, 1] = turn * t
    added[..., 2, 2] = slow * (1.0 - fade[:, None] ** 2)
    added[0, :, 0, 0], added[0, :, 1, 1] = UNKNOWN_VARIANCE, UNKNOWN_RATE_VARIANCE * (turn > 0.0)
    added[0, :, 2, 2] = slow
    predicted, predicted_cov = np.empty((steps, series, 3)), np.empty((steps, series, 3, 3))
    filtered, filtered_cov = np.empty_like(predicted), np.empty_like(predicted_cov)
    known: Bools = np.isfinite(variance) & np.isfinite(y)
    noise, values = np.where(known, variance, 1.0), np.where(known, y, 0.0)
    mean, cov, log_density = np.zeros((series, 3)), np.zeros((series, 3, 3)), np.zeros(series)
    for k in range(steps):
        mean = mean @ transition[k].T
        cov = transition[k] @ cov @ transition[k].T + added[k]
        predicted[k], predicted_cov[k] = mean, cov
        towards = (cov[..., 0] + cov[..., 2]) * known[k][:, None]
        expected = cov[:, 0, 0] + 2.0 * cov[:, 0, 2] + cov[:, 2, 2] + noise[k]
        innovation = values[k] - mean[:, 0] - mean[:, 2]
        mean = mean + towards * (innovation / expected)[:, None]
        cov = cov - towards[:, :, None] * (towards / expected[:, None])[:, None, :]
        log_density -= known[k] * (np.log(2.0 * np.pi * expected) + innovation * innovation / expected)
        filtered[k], filtered_cov[k] = mean, cov
    return transition, predicted, predicted_cov, filtered, filtered_cov, 0.5 * log_density
