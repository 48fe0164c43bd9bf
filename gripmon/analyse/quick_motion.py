"""Quick motion: change points (the pose changes within one or a few frames), vibration of the mount, and swinging after
a knock.  After the slow motion is subtracted, frames contain noise and quick motion.

Change points are localised to the frame, from the frames on both sides.  At each place the mean of the frames after it
is compared with that of the frames before, over several lengths.  A steady creep (the running median of the
differences) is subtracted, and the covariance of the rest is estimated from the recording, without its largest tenth;
where all of it is larger for a while, the threshold rises.  The threshold keeps the probability of a false alarm in an
hour's frames at :data:`FALSE_ALARMS_PER_HOUR` for errors with Student's distribution.

A line in the spectrum above the noise floor is a vibration, which a Wiener filter restores (all six axes together at
each frequency).  Where frames scatter far more than their reported variance for a while, the transform follows them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import signal, stats
from scipy.ndimage import median_filter, uniform_filter1d

from gripmon.analyse.smoothing import CHI2_MEDIAN
from gripmon.model.records import Array

SIDE_FRAMES = (4, 8, 16)
"""Frames on each side."""
FALSE_ALARMS_PER_HOUR = 0.02
STUDENT_DOF, STUDENT_DOF_POWER = 12.0, 1.0 / 3.0
"""Student's degrees of freedom of a frame's error before cluttered backgrounds, on simulated images, and the power of
the number of frames with which those of a mean grow, as in the drift test.
"""
BURST_MARGIN = 2.5
"""Factor on the threshold for changes that the reported variance may explain, since errors come in bursts (2.2 was
reached in 1.8 hours of streams simulated after images).
"""
CALM_FRACTION = 0.9
"""Fraction of the squared differences, the smallest, that is taken as noise."""
LOCAL_WINDOWS = 48
"""Half the window, in strides, of the median that gives the local size of differences."""
MIN_CHANGE_CHI2 = 4.0
"""Squared size, in reported variances, below which a change may as well be a passing background."""
SAME_CHANGE_FRAMES = 12
"""Frames within which there is only one change."""
PLACE_PROBABILITY = 0.95
MIN_NOISE_VARIANCE = 1e-9
"""Least noise variance, in reported variances: frames may be bitwise equal."""


@dataclass(frozen=True)
class FoundChange:
    """A change between the frames ``index - 1`` and ``index``; with :data:`PLACE_PROBABILITY` between the frame before
    ``first`` and ``last``.  ``excess``: statistic over threshold.
    """

    index: int
    first: int
    last: int
    excess: float = 1.0


def threshold(length: int, frames_per_hour: float, dof: int = 6) -> float:
    """Threshold for squared distances with ``dof`` degrees of freedom, of means of ``length`` frames."""
    chance = FALSE_ALARMS_PER_HOUR / max(frames_per_hour, 1.0) / len(SIDE_FRAMES)
    return float(dof * stats.f.isf(chance, dof, STUDENT_DOF * length**STUDENT_DOF_POWER))


def differences(y: Array, length: int) -> Array:
    """Mean of the ``length`` rows from each place on minus that of those before it (n, a); NaN at the ends."""
    total = np.concatenate([np.zeros((1, y.shape[1])), np.cumsum(y, axis=0)])
    out = np.full(y.shape, np.nan)
    middle = total[length:-length]
    out[length : len(y) - length + 1] = (total[2 * length :] - 2.0 * middle + total[: -2 * length]) / length
    return out


def squared_changes(y: Array, length: int) -> Array:
    """Squared size (n,) of the differences in units of their usual spread; 0 at the ends."""
    out = np.zeros(len(y))
    if len(y) < 8 * length:
        return out
    inside = slice(length, len(y) - length + 1)
    moved = differences(y, length)[inside]
    stride = max(length // 2, 1)
    # The slow creep, estimated by a running median of a subset.
    window = 2 * LOCAL_WINDOWS + 1
    coarse = median_filter(moved[::stride], size=(min(window, len(moved[::stride]) | 1), 1), mode="nearest")
    moved = moved - np.repeat(coarse, stride, axis=0)[: len(moved)]
    squared = _mahalanobis(moved)
    usual = _local_median(squared, stride)
    out[inside] = squared / np.maximum(usual / max(float(np.median(squared)), MIN_NOISE_VARIANCE), 1.0)
    return out


def _mahalanobis(moved: Array) -> Array:
    """Squared distances by the covariance of the calm part, corrected for its truncation."""
    dof = moved.shape[1]
    covariance: Array = np.diag(np.median(moved * moved, axis=0) / CHI2_MEDIAN + MIN_NOISE_VARIANCE)
    for _ in range(6):
        squared = np.einsum("ni,ij,nj->n", moved, np.linalg.inv(covariance), moved, optimize=True)
        calm = squared <= np.quantile(squared, CALM_FRACTION)
        kept = stats.chi2.cdf(stats.chi2.ppf(CALM_FRACTION, dof), dof + 2) / CALM_FRACTION
        covariance = (moved[calm].T @ moved[calm]) / calm.sum() / kept + MIN_NOISE_VARIANCE * np.eye(dof)
    return np.asarray(np.einsum("ni,ij,nj->n", moved, np.linalg.inv(covariance), moved, optimize=True))


def _local_median(squared: Array, stride: int) -> Array:
    some = squared[::stride]
    smooth = median_filter(some, size=min(2 * LOCAL_WINDOWS + 1, len(some) | 1), mode="nearest")
    return np.repeat(smooth, stride)[: len(squared)]


def find(y: Array, frames_per_hour: float) -> list[FoundChange]:
    """Change points in the frames ``y`` (n, a), whitened by their reported covariance."""
    limits = [threshold(length, frames_per_hour, y.shape[1]) for length in SIDE_FRAMES]
    statistic = np.stack(
        [squared_changes(y, length) / limit for length, limit in zip(SIDE_FRAMES, limits, strict=True)]
    )
    found: list[FoundChange] = []
    for index in _peaks(statistic.max(axis=0), 1.0):
        place = _place(y, index, int(SIDE_FRAMES[int(statistic[:, index].argmax())]))
        if place is not None and (not found or place.index - found[-1].index >= SAME_CHANGE_FRAMES // 2):
            found.append(replace(place, excess=float(statistic[:, index].max())))
    return found


def _peaks(statistic: Array, limit: float) -> list[int]:
    """Local maxima above ``limit``, none near a higher one, in order of time."""
    left = statistic.copy()
    above = np.flatnonzero(left > limit)
    taken: list[int] = []
    for index in above[np.argsort(-left[above])].tolist():
        if left[index] > limit:
            taken.append(index)
            left[max(index - SAME_CHANGE_FRAMES, 0) : index + SAME_CHANGE_FRAMES] = 0.0
    return sorted(taken)


def _place(y: Array, index: int, length: int) -> FoundChange | None:
    """The most likely place within a window: each side has its own mean, errors are white."""
    begin, end = max(index - 2 * length, 0), min(index + 2 * length, len(y))
    part = y[begin:end]
    candidates = np.arange(max(index - length, begin + 1), min(index + length, end - 1) + 1) - begin
    total = np.concatenate([np.zeros((1, y.shape[1])), np.cumsum(part, axis=0)])
    all_sum, count = total[-1], len(part)
    # The within-group sum of squares is the total minus the split's between-group one.
    spread = _own_noise(part)
    before, after = total[candidates], all_sum - total[candidates]
    explained = (before**2 / candidates[:, None] + after**2 / (count - candidates)[:, None]) / spread
    gain = 0.5 * (explained.sum(axis=1) - explained.sum(axis=1).max())
    best = int(gain.argmax())
    probability = np.exp(gain)
    probability /= probability.sum()
    low = high = best
    while probability[low : high + 1].sum() < PLACE_PROBABILITY:
        left = probability[low - 1] if low > 0 else -1.0
        right = probability[high + 1] if high + 1 < len(candidates) else -1.0
        low, high = (low - 1, high) if left >= right else (low, high + 1)
    return FoundChange(*(int(begin + candidates[k]) for k in (best, low, high)))


def _own_noise(part: Array) -> Array:
    """Variance (a,) of frames about their neighbours."""
    step = np.diff(part, axis=0)
    return np.asarray(np.median(step * step, axis=0) / CHI2_MEDIAN / 2.0 + MIN_NOISE_VARIANCE)


SPECTRUM_FRAMES, SPECTRUM_STEP_FRAMES = 256, 64
AVERAGED_SPECTRA = 32
"""Windows over which a spectrum is averaged."""
FLOOR_BINS = (3, 12)
"""Bins beside a line whose median is the floor; the higher of both sides, since the spectrum may fall steeply."""
LINE_OVER_FLOOR = 8.0
"""Multiple of the floor from which the largest of six eigenvalues is not due to chance (with about twelve windows that
don't overlap it is three times the floor on average).
"""
LOWEST_BIN = 5
"""First frequency bin in which a line is searched for; slower motion remains there."""
SWING_FRAMES = 12
"""Frames over which squares are averaged to find swinging."""
SWING_OVER_USUAL, SWING_OVER_CLAIMED = 8.0, 5.0
"""Variance of a swinging camera's frames, in multiples of the usual one and of the reported one."""


def vibration(rest: Array) -> tuple[Array, Array]:
    """The vibration in the residuals (n, a) of frames, and the mean squares (n, a) of its error."""
    none = np.zeros_like(rest)
    if len(rest) < 2 * SPECTRUM_FRAMES:
        return none, none.copy()
    shape = signal.get_window("hann", SPECTRUM_FRAMES)
    transform = signal.ShortTimeFFT(shape, SPECTRUM_STEP_FRAMES, 1.0)
    spectra = transform.stft(rest.T)
    spectra = np.moveaxis(spectra, 0, -1)  # (frequencies, windows, a)
    frequencies, windows, series = spectra.shape
    kept = np.zeros_like(spectra)
    lost = np.zeros((frequencies, windows, series))
    for begin in range(0, windows, AVERAGED_SPECTRA):
        part = slice(begin, min(begin + AVERAGED_SPECTRA, windows))
        own, variance = _stands_out(spectra[:, max(part.stop - AVERAGED_SPECTRA, 0) : part.stop])
        kept[:, part] = np.einsum("fij,fwj->fwi", own, spectra[:, part])
        lost[:, part] = variance[:, None]
    back = transform.istft(np.moveaxis(kept, -1, 0), k1=len(rest)).T
    power = (lost.sum(axis=0) * 2.0) / (SPECTRUM_FRAMES * float((shape**2).sum()))
    at = np.clip(transform.t(len(rest)), 0, len(rest) - 1)
    error = np.stack([np.interp(np.arange(len(rest)), at, power[:, j]) for j in range(series)], axis=1)
    return np.real(back), error


def _stands_out(spectra: Array) -> tuple[Array, Array]:
    """Wiener gains (f, a, a) from the windows' mean cross spectra, and the power of their error (f, a)."""
    count = spectra.shape[1]
    cross = np.einsum("fwi,fwj->fij", spectra, spectra.conj()) / count
    power = np.real(np.einsum("fii->fi", cross))
    floor = _floor(power) + 1e-300
    root = np.sqrt(floor)
    values, directions = np.linalg.eigh(cross / (root[:, :, None] * root[:, None, :]))
    share = np.where(values > LINE_OVER_FLOOR, 1.0 - 1.0 / np.maximum(values, 1.0), 0.0)
    share[:LOWEST_BIN] = 0.0
    gain = np.einsum("fik,fk,fjk->fij", directions, share, directions.conj())
    gain = root[:, :, None] * gain / root[:, None, :]
    error = np.einsum("fik,fk->fi", np.abs(directions) ** 2, share) * floor
    return gain, error


def _floor(power: Array) -> Array:
    """(f, a) the spectrum without lines."""
    near, far = FLOOR_BINS
    size = far - near
    # The median around a place ``offset`` away.
    middle = median_filter(power, size=(size, 1), mode="nearest")
    offset = near + size // 2
    below = np.concatenate([np.repeat(middle[:1], offset, axis=0), middle[:-offset]])
    above = np.concatenate([middle[offset:], np.repeat(middle[-1:], offset, axis=0)])
    return np.maximum(below, above)


def swings(rest: Array, claimed: Array) -> Array:
    """Variance (n, a) of swinging, 0 where there is none; ``claimed`` (n, a): reported variance of the frames."""
    squares = np.where(np.isfinite(rest), rest, 0.0) ** 2
    local = uniform_filter1d(squares, SWING_FRAMES, axis=0, mode="nearest")
    usual = np.median(local, axis=0)
    ratio = (local / np.maximum(claimed, 1e-12)).mean(axis=1)
    swinging = (ratio > SWING_OVER_CLAIMED) & ((local / (usual + 1e-12)).mean(axis=1) > SWING_OVER_USUAL)
    return np.where(swinging[:, None], np.maximum(local - usual, 0.0), 0.0)
