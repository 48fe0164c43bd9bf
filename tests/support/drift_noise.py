"""Shifts of a camera that doesn't move, (frames, streams, 6), with errors of several kinds of known covariance."""

from __future__ import annotations

import numpy as np

from gripmon.judge.drift import Finding, SequentialTest
from gripmon.model.records import Array

SIGMA = np.array([5e-6, 4e-6, 2e-5, 3e-4, 3e-4, 1e-4])


def covariance(seed: int = 5) -> Array:
    """(6, 6) with standard deviations :data:`SIGMA` and errors of the axes that belong closely together."""
    factor = np.random.default_rng(seed).normal(size=(6, 6))
    wishart = factor @ factor.T
    scale = SIGMA / np.sqrt(wishart.diagonal())
    return np.asarray(wishart * np.outer(scale, scale))


COVARIANCE = covariance()
_FACTOR = np.linalg.cholesky(COVARIANCE)


def white(rng: np.random.Generator, frames: int, streams: int) -> Array:
    return np.asarray(rng.normal(size=(frames, streams, 6)) @ _FACTOR.T)


def autocorrelated(rng: np.random.Generator, frames: int, streams: int, memory: float = 0.9) -> Array:
    """AR(1) in its stationary state."""
    out, fresh = np.empty((frames, streams, 6)), white(rng, frames, streams)
    now = white(rng, 1, streams)[0]
    for index in range(frames):
        now = memory * now + np.sqrt(1.0 - memory**2) * fresh[index]
        out[index] = now
    return out


def vibrating(rng: np.random.Generator, frames: int, streams: int) -> Array:
    """Half of the variance is white, half a sinusoid of its own frequency and direction in each stream."""
    per_frame = rng.uniform(0.02, 0.4, streams)
    phase = rng.uniform(0.0, 2.0 * np.pi, streams)
    wave = np.sin(2.0 * np.pi * per_frame * np.arange(frames)[:, None] + phase)
    return np.sqrt(0.5) * white(rng, frames, streams) + wave[..., None] * white(rng, 1, streams)


def claimed(streams: int) -> Array:
    """(s, 6, 6) the covariance that frames claim."""
    return np.broadcast_to(COVARIANCE, (streams, 6, 6)).copy()


def feed(test: SequentialTest, shifts: Array, learn: np.ndarray | None = None) -> list[Finding]:
    """What the test says of shifts (n, s, 6)."""
    reported = claimed(shifts.shape[1])
    return [test.add(shift, reported, learn) for shift in shifts]
