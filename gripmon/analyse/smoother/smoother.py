"""Forward-backward smoothing (Rauch, Tung and Striebel 1965) of several series at once, each of one dimension.

The state of a series is where it is, how fast it goes, and two errors that last: ``x, u, slow, mid``.  It is measured
as ``y = x + slow + mid + v``.  x goes on with the rate u and wanders, u wanders, the errors fade out and are renewed.
The likelihood comes from the filter (prediction errors).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array

Bools = NDArray[np.bool_]

SLOW_S, MID_S = 15.0, 0.5
"""Correlation times of the two errors: a background that stays for a while, and what passes behind the edges."""

UNKNOWN = 1e7
"""Variance of a state that nothing is known of, in units of the reported variance."""

UNKNOWN_RATE = 100.0
"""Likewise of a rate (1/s²)."""


@dataclass(frozen=True)
class Dynamics:
    """All (a,), one value a series, in units of the reported variance: ``slow`` and ``mid`` of the errors, ``wander``
    of x in a second, ``turn`` of its rate in a second (1/s²).  ``rate``: a priori variance of the rate (1/s²).
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
    """Series ``y`` (m, a) with the variances (m, a) of v, infinite where nothing was measured, at the times (m,).

    ``restarts`` (m,): x is another one from there on, all else stays; ``kinks`` (m,) or (m, a): its rate is.
    """
    forward = _filter(time_s, y, variance, restarts, kinks, dynamics)
    means, covariances = _backward(forward)
    return Smoothed(means[..., 0], means[..., 1], covariances[..., :2, :2], forward.log_likelihood)


def log_likelihood(
    time_s: Array, y: Array, variance: Array, restarts: Bools, kinks: Bools, dynamics: Dynamics
) -> Array:
    """(a,) natural logarithm of the series' probability density."""
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
            # Of the state all but the rate is measured.
            towards = covariance[..., 0] + covariance[..., 2] + covariance[..., 3]
            expected = towards[:, 0] + towards[:, 2] + towards[:, 3] + noise[k]
            surprise = values[k] - (mean[:, 0] + mean[:, 2] + mean[:, 3])
            gain = towards / expected[:, None]
            if not all_known[k]:
                gain = gain * known[k][:, None]
            mean = mean + gain * surprise[:, None]
            covariance = covariance - gain[:, :, None] * towards[:, None, :]
            log_density -= known[k] * (np.log(expected) + surprise * surprise / expected)
        out.mean[k], out.covariance[k] = mean, covariance
    out.log_likelihood = 0.5 * (log_density - np.log(2.0 * np.pi) * known.sum(axis=0))
    return out


def _steps(time_s: Array, restarts: Bools, kinks: Bools, dynamics: Dynamics, series: int) -> tuple[Array, Array]:
    """Transitions (m, 4, 4) and what they add (m, a, 4, 4)."""
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
    added[restarts, :, 0, 0] += UNKNOWN
    added[..., 1, 1] += UNKNOWN_RATE * (kinks if kinks.ndim == 2 else kinks[:, None])
    added[0] = 0.0
    added[0, :, 0, 0], added[0, :, 1, 1] = UNKNOWN, dynamics.rate
    added[0, :, 2, 2], added[0, :, 3, 3] = dynamics.slow, dynamics.mid
    return transition, added


def _backward(forward: _Forward) -> tuple[Array, Array]:
    means, covariances = forward.mean.copy(), forward.covariance.copy()
    # A state without any spread at all can't be inverted, nor need it be corrected.
    least = 1e-12 * np.eye(4)
    inverse = np.linalg.inv(forward.predicted_covariance + least)
    for k in range(len(means) - 2, -1, -1):
        gain = forward.covariance[k] @ forward.transition[k + 1].T @ inverse[k + 1]
        means[k] += (gain @ (means[k + 1] - forward.predicted[k + 1])[..., None])[..., 0]
        covariances[k] += gain @ (covariances[k + 1] - forward.predicted_covariance[k + 1]) @ np.swapaxes(gain, -1, -2)
    return means, covariances
