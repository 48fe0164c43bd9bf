"""Frames between which the pose changed at once, and frames that are outliers; both on whitened vectors.

At each place the mean of the frames after it is compared with that of the frames before.  A steady creep (the running
median of the differences) is subtracted.  A change has to exceed what the recording's own differences show, and what
two backgrounds may differ by: a frame's error lasts as long as its background, and its reported variance bounds it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import signal, stats
from scipy.ndimage import median_filter

from gripmon.analyse.vectors import Bools, Run
from gripmon.model.records import Array

SIDE_FRAMES, MEAN_FRAMES = 8, 32
"""Frames on each side of a place: by which a change is found; by which its size is judged."""
FEWEST_FOR_MEANS = 4 * SIDE_FRAMES
"""Frames from which changes are found by means."""
FALSE_ALARMS_PER_HOUR = 0.02
"""Less than one in a day of two shifts."""
MEAN_DOF = 24.0
"""Student's degrees of freedom of a mean of 8 frames: the drift test's 12 of a frame, times the cube root of 8."""
CALM_FRACTION = 0.5
"""Fraction of the squared differences, the smallest, that is taken as noise: a step shows in 16 of them, and a short
recording may have several (Rousseeuw's minimum covariance determinant takes half, too).
"""
LOCAL_FRAMES = 384
"""Frames of the running medians: at 60 frames/s a few seconds, in which a creep is steady."""
PLACE_PROBABILITY = 0.95
MIN_VARIANCE = 1e-9
"""Least noise variance, in reported variances: frames may be bitwise equal."""
MEDIAN_SQUARE = float(stats.chi2.median(1))
"""Median of a squared standard normal variable."""
OUTLIER_SIGMAS, OUTLIER_FRAMES, OUTLIER_WINDOWS = 8.0, 2, (9, 17, 65)
"""A frame this far from the median of its window is an outlier if at most so many in the second window are; the third
is that of the usual distance.  More in a row are motion.
"""


@dataclass(frozen=True)
class FoundChange:
    """A change between the frames ``index - 1`` and ``index``; with :data:`PLACE_PROBABILITY` between the frame before
    ``first`` and ``last``.
    """

    index: int
    first: int
    last: int


def outlier_frames(run: Run) -> Bools:
    """(n,) frames far from their neighbours on both sides, singly or in pairs."""
    out = np.zeros(len(run.y), bool)
    good = np.flatnonzero(run.usable)
    near, crowd, wide = OUTLIER_WINDOWS
    if len(good) < 2 * near:
        return out
    square = (run.y[good] - median_filter(run.y[good], size=(near, 1), mode="nearest")) ** 2
    usual = np.maximum(np.median(square, axis=0), median_filter(square, size=(wide, 1), mode="nearest"))
    limit = OUTLIER_SIGMAS**2 * (usual / MEDIAN_SQUARE + MIN_VARIANCE)
    far = (square > limit).any(axis=1) & (square > 4.0 * run.claimed[good]).any(axis=1)
    out[good[far & (np.convolve(far, np.ones(crowd), mode="same") <= OUTLIER_FRAMES)]] = True
    return out


def find(run: Run) -> tuple[list[FoundChange], list[FoundChange]]:
    """The change points among the usable frames, in order; and those that are undecided: by no more than two
    backgrounds may differ, so that it was the pose or the background.  A gap before one is part of its interval.
    Of fewer than :data:`FEWEST_FOR_MEANS` frames each is compared with the one before it.
    """
    good, largest = np.flatnonzero(run.usable), largest_background_change(run)
    y = run.y[good]
    if len(good) < FEWEST_FOR_MEANS:  # each frame may be the first after a change
        jumps = (np.diff(y, axis=0) ** 2).sum(axis=1)
        each = [FoundChange(i, i, i) for i in good[1:].tolist()]
        clear = [change for change, jump in zip(each, jumps.tolist(), strict=True) if jump > largest]
        return clear, [change for change in each if change not in clear]
    limit = float(6 * stats.f.isf(_chance(run), 6, MEAN_DOF))
    peaks, _ = signal.find_peaks(squared_changes(y), height=limit, distance=2 * SIDE_FRAMES)
    places = sorted((_place(y, peak) for peak in peaks.tolist()), key=lambda place: place.index)
    found: list[FoundChange] = []
    undecided: list[FoundChange] = []
    before = -SIDE_FRAMES
    for place in places:
        if place.index - before < SIDE_FRAMES:
            continue
        change = FoundChange(*good[[place.index, place.first, place.last]].tolist())
        if float((_jump(y, place.index) ** 2).sum()) > largest:
            found.append(change)
            before = place.index
        else:
            undecided.append(change)
    return found, undecided


def _chance(run: Run) -> float:
    return FALSE_ALARMS_PER_HOUR * run.frame_s / 3600.0


def largest_background_change(run: Run) -> float:
    """Squared difference of two normal errors, in reported variances, that is as seldom as a false alarm, should every
    frame have a background of its own.
    """
    return 2.0 * float(stats.chi2.isf(_chance(run), 6))


def _jump(y: Array, index: int) -> Array:
    before, after = y[max(index - MEAN_FRAMES, 0) : index], y[index : index + MEAN_FRAMES]
    return np.asarray(np.median(after, axis=0) - np.median(before, axis=0))


def squared_changes(y: Array) -> Array:
    """(n,) squared differences between the means of :data:`SIDE_FRAMES` rows of (n, 6) from each place on and before
    it, in units of their usual spread; 0 at the ends.  chi² with 6 degrees of freedom for normal errors.
    """
    out, count = np.zeros(len(y)), SIDE_FRAMES
    if len(y) < 4 * count:
        return out
    total = np.concatenate([np.zeros((1, y.shape[1])), np.cumsum(y, axis=0)])
    moved = (total[2 * count :] - 2.0 * total[count:-count] + total[: -2 * count]) / count
    moved = moved - _running_median(moved)
    covariance: Array = np.diag(np.median(moved * moved, axis=0) / MEDIAN_SQUARE + MIN_VARIANCE)
    dof = y.shape[1]
    kept = float(stats.chi2.cdf(stats.chi2.ppf(CALM_FRACTION, dof), dof + 2)) / CALM_FRACTION
    for _ in range(6):
        square = np.einsum("ni,ij,nj->n", moved, np.linalg.inv(covariance), moved, optimize=True)
        calm = moved[square <= np.quantile(square, CALM_FRACTION)]
        covariance = calm.T @ calm / len(calm) / kept + MIN_VARIANCE * np.eye(dof)
    square = np.einsum("ni,ij,nj->n", moved, np.linalg.inv(covariance), moved, optimize=True)
    usual = _running_median(square[:, None])[:, 0] / stats.chi2.median(dof)
    out[count : len(y) - count + 1] = square / np.maximum(usual, 1.0)
    return out


def _running_median(values: Array) -> Array:
    stride = SIDE_FRAMES // 2
    some = values[::stride]
    smooth = median_filter(some, size=(min(LOCAL_FRAMES // stride, len(some)) | 1, 1), mode="nearest")
    return np.asarray(np.repeat(smooth, stride, axis=0)[: len(values)])


def _place(y: Array, peak: int) -> FoundChange:
    """The most likely place near a peak: each side has its own mean, errors are white."""
    begin, end = max(peak - 2 * SIDE_FRAMES, 0), min(peak + 2 * SIDE_FRAMES, len(y))
    part = y[begin:end]
    split = np.arange(max(peak - SIDE_FRAMES, begin + 1), min(peak + SIDE_FRAMES, end - 1) + 1) - begin
    before = np.cumsum(part, axis=0)[split - 1]
    noise = np.median(np.diff(part, axis=0) ** 2, axis=0) / MEDIAN_SQUARE / 2.0 + MIN_VARIANCE
    # The sum of squares within both sides is the total minus that between them.
    between = before**2 / split[:, None] + (part.sum(axis=0) - before) ** 2 / (len(part) - split)[:, None]
    gain = 0.5 * (between / noise).sum(axis=1)
    probability = np.exp(gain - gain.max())
    probability /= probability.sum()
    low = high = int(probability.argmax())
    while probability[low : high + 1].sum() < PLACE_PROBABILITY:
        left = probability[low - 1] if low > 0 else -1.0
        right = probability[high + 1] if high + 1 < len(split) else -1.0
        low, high = (low - 1, high) if left >= right else (low, high + 1)
    return FoundChange(*(int(begin + split[k]) for k in (probability.argmax(), low, high)))
