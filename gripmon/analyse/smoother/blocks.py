"""Means of blocks of frames, places in gaps between them, and what lies between places."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from gripmon.analyse.smoother.run import Ints, Run
from gripmon.analyse.smoother.smoother import Smoothed
from gripmon.model.records import Array

GAP_BLOCKS = 4.0
"""Times the usual interval of blocks from which there is a gap, which gets places of its own."""
MOST_GAP_PLACES = 200


class Blocks:
    """Means of up to ``size`` neighbouring frames of a segment."""

    def __init__(self, run: Run, good: Ints, segment: Ints, size: int, y: Array, swing: Array):
        count = len(good)
        new = np.diff(segment, prepend=-1) > 0
        new |= np.diff(run.time_s[good], prepend=-np.inf) > GAP_BLOCKS * size * run.frame_s
        start = np.maximum.accumulate(np.where(new, np.arange(count), 0))
        self._at = np.flatnonzero((np.arange(count) - start) % size == 0)
        self._count = np.diff(np.append(self._at, count)).astype(float)
        self._size, self._y = size, y
        noise = run.claimed[good] + swing
        weight = 1.0 / noise
        total = np.add.reduceat(weight, self._at, axis=0)
        self.mean = np.add.reduceat(weight * y, self._at, axis=0) / total
        self.time_s = np.add.reduceat(run.time_s[good], self._at) / self._count
        self.segment = segment[self._at]
        self._noise = 1.0 / total
        self._swing = np.add.reduceat(swing, self._at, axis=0) / self._count[:, None]

    def variance(self, white: Array) -> Array:
        """(m, 6) of the blocks' own errors, ``white`` (6,) being that of a usual block."""
        return np.maximum(white * self._size * self._noise, 1e-6) + self._swing

    def frame_variance(self) -> Array:
        """(6,) of frames about the mean of their block, wild ones left out."""
        if self._size == 1:
            return np.zeros(6)
        number = np.repeat(np.arange(len(self._at)), self._count.astype(int))
        off = (self._y - self.mean[number]) ** 2
        full = self._count[number] == self._size
        off = off[full] if full.any() else off
        inside = off <= np.quantile(off, 0.98, axis=0)
        return np.asarray((off * inside).sum(axis=0) / inside.sum(axis=0) / 0.8735)


class Spread:
    """Puts blocks among places of gaps."""

    def __init__(self, where: Ints, count: int):
        self._where, self._count = where, count

    def of(self, values: Array, else_value: float) -> Array:
        out = np.full((self._count, *values.shape[1:]), else_value)
        out[self._where] = values
        return out


def held(values: Ints, where: Ints, count: int) -> Ints:
    index = np.zeros(count, np.int64)
    index[where] = np.arange(len(where))
    out: Ints = values[np.maximum.accumulate(index)]
    return out


def with_gaps(run: Run, time_s: Array) -> tuple[Array, Ints]:
    """Times with more of them in long gaps, and before the first and after the last block; where the blocks are."""
    steps = np.diff(time_s)
    steps = steps[steps > 0.0]
    usual = float(np.median(steps)) if len(steps) else 1.0
    extra = []
    edges = np.concatenate([[min(run.time_s[0], time_s[0])], time_s, [max(run.time_s[-1], time_s[-1])]])
    for begin, end in pairwise(edges.tolist()):
        if end - begin > GAP_BLOCKS * usual:
            places = min(int((end - begin) / usual), MOST_GAP_PLACES)
            extra.append(np.linspace(begin, end, places + 2)[1:-1])
    both = np.concatenate([time_s, *extra])
    order = np.argsort(both, kind="stable")
    where = np.empty(len(both), np.int64)
    where[order] = np.arange(len(both))
    return both[order], where[: len(time_s)]


def at(time_s: Array, segment: Ints, smoothed: Smoothed, wanted_s: Array, wanted_segment: Ints) -> tuple[Array, Array]:
    """x (k, 6) and its variance (k, 6) at any times, from the places of the same segment before and after."""
    first = np.searchsorted(segment, wanted_segment, side="left")
    last = np.searchsorted(segment, wanted_segment, side="right") - 1
    after = np.clip(np.searchsorted(time_s, wanted_s, side="left"), first, last)
    before = np.clip(after - 1, first, last)
    inside = (after > before) & (wanted_s >= time_s[before]) & (wanted_s <= time_s[after])
    nearest = np.where(np.abs(time_s[after] - wanted_s) < np.abs(wanted_s - time_s[before]), after, before)
    way = (wanted_s - time_s[nearest])[:, None]
    p = smoothed.covariance[nearest]
    x = smoothed.x[nearest] + way * smoothed.rate[nearest]
    variance = p[..., 0, 0] + 2.0 * way * p[..., 0, 1] + way * way * p[..., 1, 1]
    span = np.where(inside, time_s[after] - time_s[before], 1.0)
    f = (np.where(inside, wanted_s - time_s[before], 0.0) / np.where(span > 0.0, span, 1.0))[:, None]
    between = (1.0 - f) * smoothed.x[before] + f * smoothed.x[after]
    spread = (1.0 - f) * smoothed.covariance[before][..., 0, 0] + f * smoothed.covariance[after][..., 0, 0]
    return np.where(inside[:, None], between, x), np.where(inside[:, None], spread, variance)
