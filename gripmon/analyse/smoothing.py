"""The off-line smoother, and the error variances estimated from the recording itself, per axis in units of the reported
variance.

Second differences ``y(t) - 2 y(t + l) + y(t + 2 l)`` are almost insensitive to a pose that stands still or creeps
steadily.  Their mean squares at growing lags show how much of the error is new in each block, how much lasts for half a
second, and how much for as long as a background stays.  Reported variance that does not appear in them is kept as an
error that never averages out.  The pose's own random walk is the most likely of a list of candidates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from gripmon.model.records import Array

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

MAX_LAG_S = 30.0
"""Longest lag of the second differences."""
TRIMMED_FRACTION, TRIMMED_MEAN = 0.98, 0.8735
"""Fraction of the squares that is averaged (the rest may be outliers), and its mean for normal errors."""
CHI2_MEDIAN = 0.4549
MIN_WHITE_VARIANCE = 1e-4
"""Least white variance; also the least mean square by which the fit's rows are weighted."""
MIN_SLOW_VARIANCE = 0.3
"""Prior of the lasting error: the reported variance that is not found elsewhere, and at least this."""
PRIOR_BACKGROUNDS = 3.0
"""Weight, in backgrounds, of the assumption that all reported variance not found elsewhere lasts."""

WANDER_VARIANCES = (1e-6, 1e-3, 1e-1)
TURN_VARIANCES = ((1e-9, 1e-6), (1e-7, 1e-2), (1e-6, 1e2), (1e-4, 1e2), (1e-2, 1e2), (1.0, 1e2))
"""Candidate variances per second: of x; of its rate, together with that of the first rate ((reported sd/s)²)."""
SLOW_FACTORS = (1.0, 2.5, 6.0)
WANDER_STEP_COST, TURN_STEP_COST, SLOW_STEP_COST = 6.0, 1.5, 1.0
"""Required gain in log-likelihood for each step to the next candidate.  Changing backgrounds look like a random walk,
hardly like a rate.
"""
KINK_PLACES, MAX_KINKS, KINK_COST = 48, 6, 20.0
"""Candidate places for a change of the rate, the largest number accepted, and the gain in log-likelihood that one
needs.
"""
LIKELIHOOD_STEP_S, MAX_LIKELIHOOD_STEPS = 2.0, 600
"""Least length of the means from which the likelihood is computed, the time of a change of background, and their
largest number.
"""


@dataclass(frozen=True)
class VarianceShares:
    """(a,) each: variance of a block's own error, of the error that lasts for :data:`MID_S`, for :data:`SLOW_S`; of a
    single frame about its block; and the reported variance beyond these.
    """

    white: Array
    mid: Array
    slow: Array
    frame: Array
    unseen: Array


def second_differences(time_s: Array, y: Array, segment: NDArray[np.int64], lag: int) -> Array:
    """(k, a) of evenly spaced triples within a segment."""
    first, middle, last = slice(0, -2 * lag), slice(lag, -lag), slice(2 * lag, None)
    usual = lag * step_of(time_s)
    even = np.abs(time_s[middle] - time_s[first] - usual) < 0.2 * usual
    even &= np.abs(time_s[last] - time_s[middle] - usual) < 0.2 * usual
    even &= segment[first] == segment[last]
    out: Array = (y[first] - 2.0 * y[middle] + y[last])[even]
    return out[np.isfinite(out).all(axis=1)]


def mean_squares(differences: Array, trimmed: bool) -> Array:
    """(a,) mean squares of the columns, robust against steps and gross errors."""
    squares = differences * differences
    if not trimmed:
        return np.asarray(np.median(squares, axis=0) / CHI2_MEDIAN)
    inside = squares <= np.quantile(squares, TRIMMED_FRACTION, axis=0)
    return np.asarray((squares * inside).sum(axis=0) / inside.sum(axis=0) / TRIMMED_MEAN)


def step_of(time_s: Array) -> float:
    """Median interval, s."""
    steps = np.diff(time_s)
    steps = steps[steps > 0.0]  # stamps may repeat
    return float(np.median(steps)) if len(steps) else 1.0


def learn_shares(time_s: Array, y: Array, segment: NDArray[np.int64], frame: Array, trimmed: bool) -> VarianceShares:
    """From block means ``y`` (m, a) at the times (m,), which belong to a ``segment`` (m,) each; ``frame`` (a,) is the
    variance of frames about their block.
    """
    series = y.shape[1]
    step_s = step_of(time_s)
    rows, values, weights = [], [], []
    lag = 1
    while 2 * lag < 0.75 * len(time_s) and lag * step_s <= MAX_LAG_S:
        differences = second_differences(time_s, y, segment, lag)
        if len(differences) >= 8:
            lasting = [_seen(lag * step_s, correlation_s) for correlation_s in (MID_S, SLOW_S)]
            rows.append([1.0, *lasting])
            values.append(mean_squares(differences, trimmed) / 6.0)
            weights.append(np.sqrt(max(len(differences) / (3.0 * lag), 1.0)))
        lag *= 2
    out = np.zeros((3, series))
    if len(rows) < 3:
        # Too short to estimate: half of the reported variance is new, half lasts.
        out[0], out[2] = 0.25, 0.5
    else:
        for axis in range(series):
            seen = np.maximum([v[axis] for v in values], MIN_WHITE_VARIANCE)
            relative = np.array(weights) / seen
            out[:, axis], _ = nnls(np.array(rows) * relative[:, None], seen * relative)
    white, mid = np.maximum(out[0], MIN_WHITE_VARIANCE), out[1]
    expected = np.maximum(1.0 - frame - white - mid, MIN_SLOW_VARIANCE)
    backgrounds = step_s * len(time_s) / (2.0 * SLOW_S)
    slow = (backgrounds * np.minimum(out[2], 2.0 * expected) + PRIOR_BACKGROUNDS * expected) / (
        backgrounds + PRIOR_BACKGROUNDS
    )
    return VarianceShares(white, mid, slow, frame, np.maximum(1.0 - frame - white - mid - slow, 0.0))


def _seen(lag_s: float, correlation_s: float) -> float:
    """Variance of second differences, divided by six, of an error with variance 1."""
    return 1.0 - 4.0 / 3.0 * float(np.exp(-lag_s / correlation_s)) + float(np.exp(-2.0 * lag_s / correlation_s)) / 3.0


def likeliest_dynamics(
    time_s: Array, y: Array, variance: Array, restarts: Bools, shares: VarianceShares
) -> tuple[Dynamics, list[float]]:
    """The most likely random walk of the pose, per axis; and the times (s) at which its rate changes."""
    series = _Series(*_for_likelihood(time_s, y, variance, restarts, shares), shares.slow)
    kinks: list[float] = []
    dynamics, best = series.likeliest(kinks)
    while len(kinks) < MAX_KINKS and len(series.time_s) > 8:
        at_s = series.likeliest_kink(kinks)
        other, likelihood = series.likeliest([*kinks, at_s])
        if likelihood < best + KINK_COST:
            break
        kinks, dynamics, best = [*kinks, at_s], other, likelihood
    return Dynamics(dynamics.slow, shares.mid, dynamics.wander, dynamics.turn, dynamics.rate), kinks


def _for_likelihood(
    time_s: Array, y: Array, variance: Array, restarts: Bools, shares: VarianceShares
) -> tuple[Array, Array, Array, Bools, Array]:
    """Coarser means; errors that last for less become white noise in them."""
    group = max(round(LIKELIHOOD_STEP_S / step_of(time_s)), -(-len(time_s) // MAX_LIKELIHOOD_STEPS), 1)
    if group == 1 or len(time_s) < 8 * group:
        return time_s, y, variance, restarts, shares.mid
    variance = variance + shares.mid * 2.0 * MID_S / step_of(time_s)
    return *_coarser(time_s, y, variance, restarts, group), np.full_like(shares.mid, 1e-9)


@dataclass(frozen=True)
class _Series:
    time_s: Array
    y: Array
    variance: Array
    restarts: Bools
    mid: Array
    slow: Array

    def likeliest(self, kinks_s: list[float]) -> tuple[Dynamics, float]:
        """The best dynamics with these kinks, and its log-likelihood minus costs, summed over axes."""
        tried, cost = _candidates()
        axes = self.y.shape[1]
        found = self._likelihoods(tried, self._kinks(kinks_s)[:, None]) - cost[:, None]
        best = found.argmax(axis=0)
        wander, turn, rate, factor = tried[best].T
        return Dynamics(factor * self.slow, self.mid, wander, turn, rate), float(found[best, np.arange(axes)].sum())

    def likeliest_kink(self, kinks_s: list[float]) -> float:
        """The time of the one more kink that helps most, with nearly constant rates in between."""
        places = np.unique(np.linspace(1, len(self.time_s) - 2, KINK_PLACES).astype(int))
        tried = np.array([(WANDER_VARIANCES[0], turn, UNKNOWN_RATE_VARIANCE, 1.0) for turn in (1e-6, 1e-2)])
        kinks = np.repeat(self._kinks(kinks_s)[:, None], len(places), axis=1)
        kinks[places, np.arange(len(places))] = True
        kinks = np.repeat(kinks, len(tried), axis=1)
        found = self._likelihoods(np.tile(tried, (len(places), 1)), kinks)
        total = found.reshape(len(places), len(tried), -1).max(axis=1).sum(axis=1)
        return float(self.time_s[places[total.argmax()]])

    def _kinks(self, kinks_s: list[float]) -> Bools:
        out = np.zeros(len(self.time_s), bool)
        out[np.searchsorted(self.time_s, kinks_s)] = True
        return out

    def _likelihoods(self, tried: Array, kinks: Bools) -> Array:
        """(c, a) of candidates (c, 4), with kinks (m, c) or (m, 1)."""
        axes, many = self.y.shape[1], len(tried)
        wander, turn, rate, factor = (np.repeat(column, axes) for column in tried.T)
        dynamics = Dynamics(factor * np.tile(self.slow, many), np.tile(self.mid, many), wander, turn, rate)
        y, variance = np.tile(self.y, (1, many)), np.tile(self.variance, (1, many))
        if kinks.shape[1] > 1:
            kinks = np.repeat(kinks, axes, axis=1)
        return log_likelihood(self.time_s, y, variance, self.restarts, kinks, dynamics).reshape(many, axes)


def _candidates() -> tuple[Array, Array]:
    """Rows of wander, turn, first rate's variance, factor on the slow error (c, 4), and their costs (c,)."""
    rows, costs = [], []
    for i, wander in enumerate(WANDER_VARIANCES):
        for j, turn in enumerate(TURN_VARIANCES):
            for k, factor in enumerate(SLOW_FACTORS):
                rows.append((wander, *turn, factor))
                costs.append(WANDER_STEP_COST * i + TURN_STEP_COST * j + SLOW_STEP_COST * k)
    return np.array(rows), np.array(costs)


def _coarser(
    time_s: Array, y: Array, variance: Array, restarts: Bools, group: int
) -> tuple[Array, Array, Array, Bools]:
    """Weighted means of up to ``group`` neighbouring blocks of a segment."""
    segment = np.cumsum(restarts)
    first = np.flatnonzero(restarts)
    start = np.concatenate([[0], first])[segment]
    begins = (np.arange(len(time_s)) - start) % group == 0
    at = np.flatnonzero(begins)
    weight = np.where(np.isfinite(variance) & np.isfinite(y), 1.0 / variance, 0.0)
    total = np.add.reduceat(weight, at, axis=0)
    mean = np.add.reduceat(weight * np.where(weight > 0.0, y, 0.0), at, axis=0) / np.where(total > 0.0, total, 1.0)
    counts = np.diff(np.append(at, len(time_s)))
    time_s = np.add.reduceat(time_s, at) / counts
    with np.errstate(divide="ignore"):
        return time_s, mean, np.where(total > 0.0, 1.0 / total, np.inf), restarts[at]


SLOW_S, MID_S = 15.0, 0.5
"""Correlation times of the two errors: a background that stays for a while, and details passing behind the edges."""

UNKNOWN_VARIANCE = 1e7
"""Variance of an unknown state, in units of the reported variance."""

UNKNOWN_RATE_VARIANCE = 100.0
"""The same for a rate (1/s²)."""


@dataclass(frozen=True)
class Dynamics:
    """All (a,), one value per series, in units of the reported variance: ``slow`` and ``mid`` of the errors, ``wander``
    of x per second, ``turn`` of its rate per second (1/s²).  ``rate``: prior variance of the rate (1/s²).
    """

    slow: Array
    mid: Array
    wander: Array
    turn: Array
    rate: Array


@dataclass(frozen=True)
class Smoothed:
    """``x`` (m, a), ``rate`` (m, a) and the covariance of both (m, a, 2, 2); ``log_likelihood`` (a,)."""

    x: Array
    rate: Array
    covariance: Array
    log_likelihood: Array


def smooth(time_s: Array, y: Array, variance: Array, restarts: Bools, kinks: Bools, dynamics: Dynamics) -> Smoothed:
    """Smooth series ``y`` (m, a) with noise variances (m, a), infinite where nothing was measured, at the times (m,).

    ``restarts`` (m,): x is unknown again from there on; ``kinks`` (m,) or (m, a): its rate is.
    """
    forward = _filter(time_s, y, variance, restarts, kinks, dynamics)
    means, covariances = _backward(forward)
    return Smoothed(means[..., 0], means[..., 1], covariances[..., :2, :2], forward.log_likelihood)


def log_likelihood(
    time_s: Array, y: Array, variance: Array, restarts: Bools, kinks: Bools, dynamics: Dynamics
) -> Array:
    """(a,) log-likelihood of the series."""
    return _filter(time_s, y, variance, restarts, kinks, dynamics).log_likelihood


@dataclass
class _Forward:
    transition: Array  # (m, 4, 4) into each step
    predicted: Array  # (m, a, 4)
    predicted_covariance: Array  # (m, a, 4, 4)
    mean: Array
    covariance: Array
    log_likelihood: Array


def _filter(time_s: Array, y: Array, variance: Array, restarts: Bools, kinks: Bools, dynamics: Dynamics) -> _Forward:
    steps, series = y.shape
    transition, added = _steps(time_s, restarts, kinks, dynamics, series)
    vectors, matrices = (steps, series, 4), (steps, series, 4, 4)
    out = _Forward(
        transition, np.empty(vectors), np.empty(matrices), np.empty(vectors), np.empty(matrices), np.zeros(series)
    )
    mean = np.zeros((series, 4))
    covariance = np.zeros((series, 4, 4))
    known: Bools = np.asarray(np.isfinite(variance) & np.isfinite(y))
    noise, values = np.where(known, variance, 1.0), np.where(known, y, 0.0)
    any_known: Bools = np.asarray(known.any(axis=1))
    all_known: Bools = np.asarray(known.all(axis=1))
    log_density = np.zeros(series)
    for k in range(steps):
        move = transition[k]
        mean = mean @ move.T
        covariance = move @ covariance @ move.T + added[k]
        out.predicted[k], out.predicted_covariance[k] = mean, covariance
        if any_known[k]:
            # The measurement is the sum of the state without the rate.
            towards = covariance[..., 0] + covariance[..., 2] + covariance[..., 3]
            expected = towards[:, 0] + towards[:, 2] + towards[:, 3] + noise[k]
            innovation = values[k] - (mean[:, 0] + mean[:, 2] + mean[:, 3])
            gain = towards / expected[:, None]
            if not all_known[k]:
                gain = gain * known[k][:, None]
            mean = mean + gain * innovation[:, None]
            covariance = covariance - gain[:, :, None] * towards[:, None, :]
            log_density -= known[k] * (np.log(expected) + innovation * innovation / expected)
        out.mean[k], out.covariance[k] = mean, covariance
    out.log_likelihood = 0.5 * (log_density - np.log(2.0 * np.pi) * known.sum(axis=0))
    return out


def _steps(time_s: Array, restarts: Bools, kinks: Bools, dynamics: Dynamics, series: int) -> tuple[Array, Array]:
    """Transitions (m, 4, 4) and their process noise (m, a, 4, 4)."""
    steps = len(time_s)
    elapsed = np.diff(time_s, prepend=time_s[0])
    fade = np.exp(-elapsed[:, None] / np.array([SLOW_S, MID_S]))
    transition = np.tile(np.eye(4), (steps, 1, 1))
    transition[:, 0, 1] = elapsed
    transition[:, 2, 2], transition[:, 3, 3] = fade[:, 0], fade[:, 1]
    added = np.zeros((steps, series, 4, 4))
    t = elapsed[:, None]
    added[..., 0, 0] = dynamics.wander * t + dynamics.turn * t**3 / 3.0
    added[..., 0, 1] = dynamics.turn * t**2 / 2.0
    added[..., 1, 0] = added[..., 0, 1]
    added[..., 1, 1] = dynamics.turn * t
    added[..., 2, 2] = dynamics.slow * (1.0 - fade[:, :1] ** 2)
    added[..., 3, 3] = dynamics.mid * (1.0 - fade[:, 1:] ** 2)
    added[restarts, :, 0, 0] += UNKNOWN_VARIANCE
    added[..., 1, 1] += UNKNOWN_RATE_VARIANCE * (kinks if kinks.ndim == 2 else kinks[:, None])
    added[0] = 0.0
    added[0, :, 0, 0], added[0, :, 1, 1] = UNKNOWN_VARIANCE, dynamics.rate
    added[0, :, 2, 2], added[0, :, 3, 3] = dynamics.slow, dynamics.mid
    return transition, added


def _backward(forward: _Forward) -> tuple[Array, Array]:
    means, covariances = forward.mean.copy(), forward.covariance.copy()
    # The regularisation makes a covariance of zero invertible; such a state needs no correction.
    least = 1e-12 * np.eye(4)
    inverse = np.linalg.inv(forward.predicted_covariance + least)
    for k in range(len(means) - 2, -1, -1):
        gain = forward.covariance[k] @ forward.transition[k + 1].T @ inverse[k + 1]
        means[k] += (gain @ (means[k + 1] - forward.predicted[k + 1])[..., None])[..., 0]
        covariances[k] += gain @ (covariances[k + 1] - forward.predicted_covariance[k + 1]) @ np.swapaxes(gain, -1, -2)
    return means, covariances
