"""Drift tests side by side on simulated streams of estimates: how often they cry wolf, and how soon they notice."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from scipy import stats

from benchmarks import kit
from benchmarks.noise_model import NoiseModel
from gripmon.judge.drift import DriftSettings, SequentialTest

FRAMES_PER_S = 60.0
FRAMES_PER_DAY = 86_400.0 * FRAMES_PER_S
ALERT_FRAMES = 60
CHUNK = 256
BLOCK_FRAMES = 1024
"""The largest statistic of this many frames is one value for the tail."""


class Chart(Protocol):
    """Something that says how far beyond its threshold each stream is, 1 at the threshold."""

    def add(self, shift: np.ndarray, covariance: np.ndarray) -> np.ndarray: ...
    def restart(self, streams: np.ndarray) -> None: ...


class Ours:
    """The monitor's own test."""

    def __init__(self, streams: int, alarms_per_day: float) -> None:
        settings = DriftSettings(false_alarms_per_day=alarms_per_day, frames_per_s=FRAMES_PER_S)
        self.test = SequentialTest(settings, streams)

    def add(self, shift: np.ndarray, covariance: np.ndarray) -> np.ndarray:
        return self.test.add(shift, covariance).excess

    def restart(self, streams: np.ndarray) -> None:
        self.test.restart(streams)


class Bare:
    """An alarm when the TCP's shift is beyond a number of metres."""

    def __init__(self, threshold: float) -> None:
        self.threshold = threshold

    def add(self, shift: np.ndarray, covariance: np.ndarray) -> np.ndarray:
        return np.linalg.norm(shift[:, :3], axis=1) / self.threshold

    def restart(self, streams: np.ndarray) -> None: ...


class Hotelling:
    """An alarm when a frame's squared shift, normalised by the reported covariance, is beyond a number."""

    def __init__(self, threshold: float) -> None:
        self.threshold = threshold

    def add(self, shift: np.ndarray, covariance: np.ndarray) -> np.ndarray:
        return kit.nees(shift, covariance) / self.threshold

    def restart(self, streams: np.ndarray) -> None: ...


@dataclass(frozen=True)
class Alarms:
    """Alarms that were counted in ``frames``, and the largest excess of every block of every stream."""

    frames: int
    count: int
    block_maxima: np.ndarray

    @property
    def per_day(self) -> float:
        return self.count / self.frames * FRAMES_PER_DAY

    @property
    def interval_per_day(self) -> tuple[float, float]:
        """Exact 95 % confidence limits for a Poisson count (Garwood 1936)."""
        low = 0.0 if self.count == 0 else 0.5 * float(stats.chi2.ppf(0.025, 2 * self.count))
        high = 0.5 * float(stats.chi2.ppf(0.975, 2 * self.count + 2))
        return low / self.frames * FRAMES_PER_DAY, high / self.frames * FRAMES_PER_DAY

    def tail_per_day(self, excess: float = 1.0) -> float:
        """Alarms a day at a threshold ``excess`` times as high, by a generalised Pareto tail fitted to the largest
        twentieth of the blocks.
        """
        start = float(np.quantile(self.block_maxima, 0.95))
        beyond = self.block_maxima[self.block_maxima > start] - start
        if excess <= start:
            share = float((self.block_maxima > excess).mean())
        else:
            shape, _, scale = stats.genpareto.fit(beyond, floc=0.0)
            share = 0.05 * float(stats.genpareto.sf(excess - start, shape, scale=scale))
        return -math.log1p(-min(share, 1.0 - 1e-12)) / BLOCK_FRAMES * FRAMES_PER_DAY


def frames_of(model: NoiseModel, streams: int, frames: int, rng: np.random.Generator) -> Iterator[tuple[Any, Any]]:
    """Shifts (s, 6) and reported covariances (s, 6, 6), one frame after the other."""
    source = model.streams(streams, rng)
    for begin in range(0, frames, CHUNK):
        noise = source.next(min(CHUNK, frames - begin))
        covariance = noise.covariance
        yield from zip(noise.shift, covariance, strict=True)


def count_alarms(
    charts: dict[str, Chart],
    model: NoiseModel,
    streams: int,
    frames: int,
    rng: np.random.Generator,
    tick: Callable[[int], None],
) -> dict[str, Alarms]:
    """Every chart on the same ``frames`` of each of ``streams`` streams in which the camera doesn't move.

    After an alarm the stream's chart begins again; alarms that follow one another within a second are one alert, as in
    the monitor.
    """
    counts = dict.fromkeys(charts, 0)
    maxima: dict[str, list[np.ndarray]] = {name: [] for name in charts}
    newest = {name: np.zeros(streams) for name in charts}
    alarmed = {name: np.full(streams, -(10**9)) for name in charts}
    for number, (shift, covariance) in enumerate(frames_of(model, streams, frames, rng), 1):
        for name, chart in charts.items():
            excess = chart.add(shift, covariance)
            np.maximum(newest[name], excess, out=newest[name])
            moved = excess > 1.0
            if moved.any():
                counts[name] += int(np.count_nonzero(moved & (number - alarmed[name] > ALERT_FRAMES)))
                alarmed[name][moved] = number
                chart.restart(moved)
        if number % BLOCK_FRAMES == 0:
            for name in charts:
                maxima[name].append(newest[name])
                newest[name] = np.zeros(streams)
            tick(BLOCK_FRAMES * streams)
    return {name: Alarms(frames * streams, counts[name], np.concatenate(maxima[name])) for name in charts}


def tuned_threshold(alarms: Alarms, per_day: float) -> float:
    """By how much a chart's threshold must be multiplied to alarm ``per_day`` times a day."""
    low, high = 1e-3, 1e3
    for _ in range(60):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if alarms.tail_per_day(middle) > per_day else (low, middle)
    return high


def delays(
    charts: dict[str, Chart],
    model: NoiseModel,
    streams: int,
    warm_up: int,
    motions: dict[str, Callable[[int], np.ndarray]],
    frames: int,
    rng: np.random.Generator,
    tick: Callable[[int], None],
) -> dict[str, dict[str, np.ndarray]]:
    """Frames (s,) until each chart notices each motion, infinite if it doesn't within ``frames``.

    A motion is a function from the number of frames since it began to the shift (6,) or (s, 6) that it adds.  All meet
    the same charts after the same ``warm_up`` frames, and the same noise.
    """
    source = model.streams(streams, rng)
    for begin in range(0, warm_up, CHUNK):
        noise = source.next(min(CHUNK, warm_up - begin))
        for shift, covariance in zip(noise.shift, noise.covariance, strict=True):
            for chart in charts.values():
                chart.add(shift, covariance)
        tick(CHUNK * streams)
    out: dict[str, dict[str, np.ndarray]] = {}
    for name, motion in motions.items():
        mine, theirs = copy.deepcopy(charts), copy.deepcopy(source)
        noticed = {chart: np.full(streams, np.inf) for chart in charts}
        for begin in range(0, frames, CHUNK):
            noise = theirs.next(min(CHUNK, frames - begin))
            for k, (shift, covariance) in enumerate(zip(noise.shift, noise.covariance, strict=True), begin + 1):
                moved = shift + motion(k)
                for chart_name, chart in mine.items():
                    excess = chart.add(moved, covariance)
                    known = noticed[chart_name]
                    known[(excess > 1.0) & ~np.isfinite(known)] = k
            if all(np.isfinite(values).all() for values in noticed.values()):
                break
        out[name] = noticed
        tick(frames * streams)
    return out
