"""``tools/bench drift``: counting, tails and delays on streams with known answers."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tools"))

from benchmarks.drift_streams import (
    BLOCK_FRAMES,
    FRAMES_PER_DAY,
    Alarms,
    Hotelling,
    count_alarms,
    delays,
    tuned_threshold,
)
from benchmarks.noise_model import Noise

STREAMS = 32


class White:
    """Independent normal errors as claimed, one unit along each axis: T² of a frame is chi-square with 6 degrees."""

    def streams(self, count: int, rng: np.random.Generator) -> White:
        self._count, self._rng = count, rng
        return self

    def next(self, frames: int) -> Noise:
        factor = np.broadcast_to(np.eye(6), (frames, self._count, 6, 6))
        return Noise(self._rng.normal(size=(frames, self._count, 6)), None, factor)


def test_alarms_of_a_known_chart_are_as_many_as_its_tail_says():
    """Of chi-square with 6 degrees of freedom 25.55 is exceeded with a chance of 2.7e-4."""
    alarms = count_alarms(
        {"T²": Hotelling(25.55)}, White(), STREAMS, 8 * BLOCK_FRAMES, np.random.default_rng(1), lambda n: None
    )["T²"]
    expected = 2.7e-4 * alarms.frames
    assert abs(alarms.count - expected) < 4.0 * np.sqrt(expected), "a second's silence after an alarm hardly matters"
    low, high = alarms.interval_per_day
    assert low < alarms.per_day < high
    assert alarms.per_day == pytest.approx(alarms.count / alarms.frames * FRAMES_PER_DAY)
    assert alarms.tail_per_day() == pytest.approx(2.7e-4 * FRAMES_PER_DAY, rel=0.4)


def test_the_fitted_tail_reaches_beyond_what_was_counted():
    """Largest of 1024 values with an exponential tail: known at any height."""
    rng = np.random.default_rng(2)
    maxima = rng.exponential(size=(4000, BLOCK_FRAMES)).max(axis=1)
    alarms = Alarms(maxima.size * BLOCK_FRAMES, 0, maxima)
    height = 18.0
    assert maxima.max() < height
    assert alarms.tail_per_day(height) == pytest.approx(np.exp(-height) * FRAMES_PER_DAY, rel=0.9)
    assert tuned_threshold(alarms, 1.0) == pytest.approx(np.log(FRAMES_PER_DAY), rel=0.15)


def test_no_alarm_has_an_upper_limit_only():
    low, high = Alarms(10**7, 0, np.zeros(1)).interval_per_day
    assert low == 0.0
    assert high == pytest.approx(3.69 / 1e7 * FRAMES_PER_DAY, rel=0.01), "-ln 0.025"


def test_delays_count_from_the_step_and_never_is_infinite():
    step = np.array([1e3, 0.0, 0.0, 0.0, 0.0, 0.0])
    found = delays(
        {"T²": Hotelling(60.0)}, White(), STREAMS, 10,
        {"at once": lambda k: step, "third": lambda k: step * (k >= 3), "never": lambda k: 0.0 * step},
        20, np.random.default_rng(3), lambda n: None,
    )  # fmt: skip
    assert (found["at once"]["T²"] == 1).all()
    assert (found["third"]["T²"] == 3).all()
    assert np.isinf(found["never"]["T²"]).all()
