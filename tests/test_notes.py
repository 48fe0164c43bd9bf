"""What a monitor says of how it judged: the test's statistic, and the shift that would be noticed, held against what
is noticed.
"""

from __future__ import annotations

import copy

import numpy as np
import pytest
from support.drift_noise import COVARIANCE, SIGMA, white
from support.watched import frames_of, new_monitor

from gripmon.judge.drift import DriftSettings, MotionWatch, SequentialTest
from gripmon.model.records import Frame, Limits

PLAIN = DriftSettings(tolerated_m=0.0, tolerated_rad=0.0)
FRAMES = 64


@pytest.fixture(scope="module")
def learnt() -> SequentialTest:
    """A test that knows its noise and was just begun again."""
    test, rng = SequentialTest(PLAIN), np.random.default_rng(0)
    for shift in white(rng, 1500, 1):
        test.add(shift, COVARIANCE[None])
    test.restart(np.array([True]))
    return test


def found(test: SequentialTest, shifts: np.ndarray) -> bool:
    return any(bool(test.add(shift, COVARIANCE[None]).moved[0]) for shift in shifts)


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_constant_shift_is_noticed_above_what_is_said_and_not_below(learnt: SequentialTest, axis: int, sign: float):
    shifts = white(np.random.default_rng(1), FRAMES + 16, 1)
    probe = copy.deepcopy(learnt)
    assert not found(probe, shifts[:FRAMES])
    noticed = probe.noticed()
    assert noticed is not None and (noticed > 0.1 * SIGMA).all() and (noticed < 30.0 * SIGMA).all()
    offset = np.zeros(6)
    offset[axis] = sign * noticed[axis]
    for share, seen in ((0.5, False), (1.6, True)):
        assert found(copy.deepcopy(learnt), shifts + share * offset) is seen


def test_nothing_is_said_before_there_is_anything_to_go_by():
    assert SequentialTest(PLAIN).noticed() is None


def test_the_statistic_passes_one_where_the_motion_begins():
    watch, rng = MotionWatch(PLAIN), np.random.default_rng(3)
    watch.reset(np.zeros((6, 6)))
    shifts = white(rng, 700, 1)[:, 0]
    shifts[600:, 1] += 8.0 * SIGMA[1]
    begun = []
    for i, shift in enumerate(shifts):
        motion = watch.add(shift, COVARIANCE, i / 60.0)
        assert watch.statistic_share is not None
        if not begun:
            assert (watch.statistic_share > 1.0) is motion.begun
        begun += [i] if motion.begun else []
    assert begun and 600 < begun[0] < 620
    watch.skip()
    assert watch.statistic_share is None, "a frame that isn't weighed has no statistic"


def test_a_monitor_says_by_what_it_judges():
    monitor = new_monitor()
    frames = frames_of("static")[0]
    policy, drift = monitor._settings.policy, monitor._settings.drift
    for frame in frames:
        monitor.process(frame)
    notes = monitor.notes()
    assert notes.statistic_share is not None and 0.0 <= notes.statistic_share < 1.0
    limits = notes.limits
    assert isinstance(limits, Limits)
    assert (limits.warn_m, limits.limit_m) == (policy.warn_m, policy.limit_m)
    assert (limits.warn_rad, limits.limit_rad) == (policy.warn_rad, policy.limit_rad)
    assert limits.tolerated == tuple(drift.tolerated.tolist())
    assert limits.offset is not None and limits.scatter is not None and min(limits.scatter) > 0.0
    black = Frame(frames[-1].seq + 1, frames[-1].stamp_ns + 16_666_667, np.zeros_like(frames[-1].image))
    monitor.process(black)
    assert monitor.notes().statistic_share is None
