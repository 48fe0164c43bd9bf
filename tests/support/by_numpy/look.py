"""What ``track.look.kernel`` compiles, function by function, by NumPy."""

from __future__ import annotations

import math

import numpy as np

from gripmon.model.least_squares import TUKEY
from gripmon.model.records import Array, Image
from gripmon.track.look.kernel import CLIP_SIGMAS, GAIN_BOUNDS, ROUNDS


def read(image: Image, weights: Array, base_px: Array, flow: Array, motion: Array) -> Array:
    """See :func:`gripmon.track.look.kernel.read`."""
    height, width = image.shape[:2]
    u, v = np.moveaxis(base_px + flow @ motion, -1, 0)
    inside = (u >= 1.0) & (u < width - 2.0) & (v >= 1.0) & (v < height - 2.0)
    left, top = (np.where(inside, np.floor(x), 1.0).astype(int) for x in (u, v))
    across, down = _taps(np.where(inside, u - left, 0.0)), _taps(np.where(inside, v - top, 0.0))
    reach = np.arange(-1, 3)
    rows, columns = (top[..., None] + reach)[..., :, None], (left[..., None] + reach)[..., None, :]
    grey = image[rows, columns].astype(float) @ weights
    return np.where(inside, np.einsum("pni,pnij,pnj->pn", down, grey, across), np.nan)


def _taps(x: Array) -> Array:
    """Weights (..., 4) of four neighbours for a place ``x`` (...) between the middle ones."""
    away = np.abs(x[..., None] - np.arange(-1.0, 3.0))
    near = (1.5 * away - 2.5) * away**2 + 1.0
    far = ((-0.5 * away + 2.5) * away - 4.0) * away + 2.0
    return np.where(away <= 1.0, near, far)


def align(
    values: Array, mean: Array, weight: Array, jacobian: Array, prior: Array, known: Array
) -> tuple[Array, Array, Array, Array, float]:
    """See :func:`gripmon.track.look.kernel.align`: iteratively re-weighted least squares.

    Each patch has its own gain and offset of light, which are taken out of the residuals with the present weights.
    """
    motion, robust, jacobian = np.zeros(7), weight, jacobian.swapaxes(1, 2)
    for turn in range(ROUNDS + 1):
        residual = _residual(values, mean, robust) - jacobian @ motion
        counted = (weight > 0.0) & np.isfinite(residual)
        squares = np.where(counted, residual**2 * weight, 0.0)
        scatter = max(1.0, math.sqrt(np.minimum(squares, CLIP_SIGMAS**2).sum() / max(np.count_nonzero(counted), 1)))
        robust = np.where(counted, weight * np.clip(1.0 - squares / (TUKEY * scatter) ** 2, 0.0, None) ** 2, 0.0)
        pull_of_patch = np.einsum("pn,pni->pi", robust * np.where(counted, residual, 0.0), jacobian)
        information = np.einsum("pn,pni,pnj->ij", robust, jacobian, jacobian) + np.diag(prior)
        if turn < ROUNDS:
            motion = motion + np.linalg.solve(information, pull_of_patch.sum(axis=0) + prior * (known - motion))
    whole = weight.sum(axis=1)
    share = np.divide(robust.sum(axis=1), whole, out=np.zeros(len(whole)), where=whole > 0.0)
    return motion, information, pull_of_patch.T @ pull_of_patch, share, scatter


def _residual(values: Array, mean: Array, weight: Array) -> Array:
    """What is seen, in the light of what was learnt, less that; NaN in patches whose light can't be told."""
    with np.errstate(invalid="ignore", divide="ignore"):
        total = weight.sum(axis=1, keepdims=True)
        value, learnt = values - (weight * values).sum(axis=1, keepdims=True) / total, mean
        learnt = learnt - (weight * learnt).sum(axis=1, keepdims=True) / total
        gain = (weight * learnt * value).sum(axis=1, keepdims=True) / (weight * learnt**2).sum(axis=1, keepdims=True)
        gain = np.where((gain >= GAIN_BOUNDS[0]) & (gain <= GAIN_BOUNDS[1]), gain, np.nan)
        return np.asarray(value / gain - learnt)
