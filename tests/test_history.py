"""Step or creep, how fast, and how long until the limit: on simulated minutes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import linregress

from gripmon.judge.drift.kinds import BLOCK_S, History, goes_on
from gripmon.judge.policy.settings import time_left_s

FPS = 20.0
SIGMA = np.array([5e-6, 4e-6, 2e-5, 3e-4, 3e-4, 1e-4])


def history(shifts: np.ndarray) -> History:
    out = History()
    for index, shift in enumerate(shifts):
        out.add(shift, 100.0 + index / FPS)
    return out


def times_s(seconds: float) -> np.ndarray:
    return np.arange(0.0, seconds, 1.0 / FPS)


def noise(rng: np.random.Generator, frames: int) -> np.ndarray:
    return np.asarray(rng.normal(size=(frames, 6)) * SIGMA)


TOWARDS = np.array([1.0 / SIGMA[0], 0.0, 0.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("mm_per_min", [0.3, 1.0, -3.0])
def test_a_creep_is_told_with_its_rate_and_its_beginning(seed: int, mm_per_min: float):
    rng, t = np.random.default_rng(seed), times_s(60.0)
    velocity_m_per_s = 1e-3 * mm_per_min / 60.0
    shifts = noise(rng, len(t))
    shifts[:, 0] += velocity_m_per_s * np.maximum(t - 20.0, 0.0)
    creep = history(shifts).creep(TOWARDS)
    assert creep is not None
    # By least squares on the last 24 blocks of half a second, each the mean of ten frames.
    blocks_s = BLOCK_S * np.arange(24)
    sigma = SIGMA[0] / math.sqrt(BLOCK_S * FPS) / math.sqrt(((blocks_s - blocks_s.mean()) ** 2).sum())
    assert abs(creep.velocity[0] - velocity_m_per_s) < 5.0 * sigma
    assert creep.rate_m_per_min == pytest.approx(1e-3 * abs(mm_per_min), rel=0.1, abs=300.0 * sigma)
    assert creep.since_s == pytest.approx(100.0 + 20.0, abs=4.0)
    assert not history(shifts).is_step(TOWARDS)


def test_a_creep_that_has_come_to_rest_is_over():
    rng, t = np.random.default_rng(1), times_s(100.0)
    shifts = noise(rng, len(t))
    shifts[:, 0] += 2e-5 * np.clip(t - 10.0, 0.0, 20.0)
    assert history(shifts).creep(TOWARDS) is None


@pytest.mark.parametrize("blocks", range(6))
def test_of_a_few_seconds_nothing_is_said(blocks: int):
    shifts = np.zeros((round(blocks * BLOCK_S * FPS), 6))
    shifts[:, 0] = np.arange(len(shifts)) * 1e-5
    assert history(shifts).creep(TOWARDS) is None
    assert not history(shifts).is_step(TOWARDS)


def test_blocks_are_complete_by_time_whatever_the_frame_rate():
    """Also with gaps: a block that a gap ends counts, an empty one never does."""
    out = History()
    complete = [out.add(np.zeros(6), s) for s in (0.0, 0.3, 0.49, 0.5, 0.6, 9.0, 9.1, 9.5)]
    assert complete == [False, False, False, True, False, True, False, True]
    out.clear()
    assert not out.add(np.zeros(6), 20.0)


def test_a_creep_goes_on_where_a_step_does_not():
    ramp = np.concatenate([np.zeros(20), np.linspace(0.0, 10.0, 30)])
    step = np.concatenate([np.zeros(20), np.full(30, 10.0)])
    rng = np.random.default_rng(2)
    for _ in range(20):
        assert goes_on(ramp + rng.normal(size=50))
        assert not goes_on(step + rng.normal(size=50))


@pytest.mark.parametrize("seed", range(4))
def test_the_time_left_is_when_stepping_ahead_gets_there(seed: int):
    rng = np.random.default_rng(seed)
    limit_m, limit_rad = 2.5e-3, 0.02
    shift = rng.normal(size=6) * ([8e-4] * 3 + [6e-3] * 3)
    velocity = rng.normal(size=6) * ([1e-4] * 3 + [1e-3] * 3)
    if seed % 3 == 0:
        velocity[3:] = 0.0
    step_s, ahead_s = 0.01, 0.0
    while (
        np.linalg.norm((shift + velocity * ahead_s)[:3]) < limit_m
        and np.linalg.norm((shift + velocity * ahead_s)[3:]) < limit_rad
    ):
        ahead_s += step_s
    assert time_left_s(shift, velocity, limit_m, limit_rad) == pytest.approx(ahead_s, abs=step_s)


def test_no_time_is_left_past_the_limit_and_no_end_without_motion():
    inside, outside, still = np.full(6, 1e-4), np.full(6, 0.1), np.zeros(6)
    assert time_left_s(outside, still, 2.5e-3, 0.02) == 0.0
    assert time_left_s(outside, -outside, 2.5e-3, 0.02) == 0.0
    assert time_left_s(inside, still, 2.5e-3, 0.02) is None


@pytest.mark.parametrize(("slope_sigmas", "told"), [(3.7, False), (4.3, True)])
def test_a_rate_counts_from_four_standard_deviations_on(slope_sigmas: float, told: bool):
    """Of six blocks of one frame each, whose regression is SciPy's."""
    t, off = np.arange(6.0), np.array([0.0, 1.0, 0.0, 0.0, -1.0, 0.0])
    off -= np.polyval(np.polyfit(t, off, 1), t)
    slope = slope_sigmas * linregress(t, off).stderr
    blocks = off + slope * t
    assert linregress(t, blocks).slope / linregress(t, blocks).stderr == pytest.approx(slope_sigmas)
    seen = History()
    for index, value in enumerate(np.append(blocks, 0.0)):
        seen.add(value * SIGMA, 100.0 + BLOCK_S * index)
    assert (seen.creep(TOWARDS) is not None) is told
