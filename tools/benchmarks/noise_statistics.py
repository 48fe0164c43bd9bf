"""What describes a stream's noise: differences at many lags, variances of window means and of their steps, tails."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from benchmarks.noise_measured import Series
from gripmon.model.records import Array

LAGS = np.array([1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512, 768, 1024])
WINDOWS = tuple(2**k for k in range(11))
QUANTILES = (0.9, 0.99, 0.999)
_FEWEST = 3
"""Differences of a scene's neighbouring windows that are enough to speak of their spread."""


@dataclass(frozen=True)
class Statistics:
    """In units of the reported covariance, axis by axis.

    ``structure`` (lags, 6): half the mean squared difference of frames at :data:`LAGS`; for windows of ``windows``
    frames: ``mean_variance`` (windows, 6) the mean square of their means, ``step_variance`` (fewer windows, 6) half the
    mean squared difference of neighbours, of which ``kurtosis`` and ``tails`` (…, quantiles) of the size (in units of
    its root mean square by axis, all axes together) describe the distribution.
    """

    structure: Array
    windows: tuple[int, ...]
    mean_variance: Array
    step_variance: Array
    kurtosis: Array
    tails: Array

    def as_dict(self) -> dict[str, Any]:
        return {f.name: _plain(getattr(self, f.name)) for f in fields(self)}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Statistics:
        arrays = {name: np.array(value) for name, value in values.items() if name != "windows"}
        return cls(windows=tuple(values["windows"]), **arrays)


def whitened(series: Series) -> tuple[Array, Array]:
    """Errors in units of their reported covariance (scenes, frames, 6), and its Cholesky factors (…, 6, 6)."""
    known = np.isfinite(series.error[..., 0])
    factors = np.full(series.covariance.shape, np.nan)
    factors[known] = np.linalg.cholesky(series.covariance[known])
    z = np.full(series.error.shape, np.nan)
    z[known] = np.linalg.solve(factors[known], series.error[known][..., None])[..., 0]
    return z, factors


def statistics(z: Array) -> Statistics:
    """Of series (scenes, frames, 6); frames without an error are NaN."""
    frames = z.shape[1]
    lags = [k for k in LAGS if k <= 0.7 * frames]
    structure = [0.5 * mean((z[:, k:] - z[:, :-k]) ** 2, (0, 1)) for k in lags]
    windows = tuple(n for n in WINDOWS if 2 * n <= frames)
    means, steps, kurtosis, tails = [], [], [], []
    for n in windows:
        count = frames // n
        window = mean(z[:, : count * n].reshape(len(z), count, n, 6), (2,))
        means.append(mean(window**2, (0, 1)))
        if count <= _FEWEST:
            continue
        step = np.diff(window, axis=1).reshape(-1, 6)
        square = mean(step**2, (0,))
        steps.append(0.5 * square)
        size = np.abs(step / np.sqrt(square))
        size = size[np.isfinite(size)]
        kurtosis.append(float(np.mean(size**4)))
        tails.append(np.quantile(size, QUANTILES))
    return Statistics(
        np.array(structure), windows, np.array(means), np.array(steps), np.array(kurtosis), np.array(tails)
    )


def mean(values: Array, axes: tuple[int, ...]) -> Array:
    """Mean of what is known; NaN where nothing is."""
    known = np.isfinite(values)
    count = np.count_nonzero(known, axis=axes)
    with np.errstate(invalid="ignore"):
        out: Array = np.where(known, values, 0.0).sum(axis=axes) / count
    return out


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return list(value)
    return np.vectorize(lambda v: float(f"{v:.5g}"))(value).tolist()
