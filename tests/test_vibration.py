"""Vibrations in noise, with their size and frequency; and what is none."""

from __future__ import annotations

import numpy as np
import pytest
from support.drift_noise import COVARIANCE, SIGMA

from gripmon.judge.drift.kinds import VibrationWatch
from gripmon.model.records import Vibration

FPS = 60.0
FACTOR = np.linalg.cholesky(COVARIANCE)


def watched(shifts: np.ndarray, smallest_m: float = 2e-5, frames_per_s: float = FPS) -> list[Vibration | None]:
    watch = VibrationWatch(smallest_m)
    return [watch.add(shift, index / frames_per_s, lambda: COVARIANCE) for index, shift in enumerate(shifts)]


def noise(seed: int, frames: int) -> np.ndarray:
    return np.asarray(np.random.default_rng(seed).normal(size=(frames, 6)) @ FACTOR.T)


def wave(hertz: float, frames: int, direction: np.ndarray, phase: float = 0.7, frames_per_s: float = FPS) -> np.ndarray:
    out = np.zeros((frames, 6))
    out[:, :3] = np.sin(2.0 * np.pi * hertz / frames_per_s * np.arange(frames) + phase)[:, None] * direction
    return out


@pytest.mark.parametrize("hertz", [3.0, 12.3, 25.0])
@pytest.mark.parametrize("amplitude_m", [1e-4, 5e-4])
def test_a_sinusoid_is_found_with_its_size_and_frequency(hertz: float, amplitude_m: float):
    seed, direction = int(hertz), amplitude_m * np.array([0.8, 0.6, 0.0])
    found = watched(noise(seed, 400) + wave(hertz, 400, direction, phase=seed))
    last = found[-1]
    assert last is not None
    assert last.frequency_hz == pytest.approx(hertz, abs=0.1 * FPS / 128.0 + 0.05)
    assert last.rms_m == pytest.approx(amplitude_m / np.sqrt(2.0), rel=0.2)
    first = next(index for index, each in enumerate(found) if each is not None)
    assert first < 192, "within three seconds"


@pytest.mark.parametrize("frames_per_s", [25.0, 240.0])
def test_the_frequency_is_in_the_frames_own_time(frames_per_s: float):
    hertz = 0.2 * frames_per_s
    shifts = noise(1, 300) + wave(hertz, 300, np.array([2e-4, 0.0, 0.0]), frames_per_s=frames_per_s)
    last = watched(shifts, frames_per_s=frames_per_s)[-1]
    assert last is not None
    assert last.frequency_hz == pytest.approx(hertz, rel=0.01)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("size", [10.0, 100.0, 1000.0])
def test_a_step_is_none(seed: int, size: float):
    """Wherever it lies among the frames that are looked at."""
    shifts = noise(seed, 600)
    shifts[200 + 7 * seed :] += size * SIGMA
    assert not any(watched(shifts))


@pytest.mark.parametrize("mm_per_min", [0.1, 1.0, 10.0])
def test_a_creep_is_none(mm_per_min: float):
    shifts = noise(1, 600)
    shifts[:, 0] += 1e-3 * mm_per_min / 60.0 / FPS * np.arange(600)
    assert not any(watched(shifts))


@pytest.mark.parametrize("frame", [150, 191])
def test_a_wild_frame_is_none(frame: int):
    shifts = noise(2, 600)
    shifts[frame] += 1e4 * SIGMA
    assert not any(watched(shifts))


def test_one_too_small_to_matter_is_none():
    quiet = np.diag(np.square([1e-7] * 3 + [1e-5] * 3))
    watch, found = VibrationWatch(2e-5), []
    for index, shift in enumerate(wave(10.0, 400, np.array([1e-5, 0.0, 0.0]))):
        found.append(watch.add(shift, index / FPS, lambda: quiet))
    assert not any(found)


def test_it_ends_when_it_ends():
    shifts = noise(3, 800) + np.concatenate([wave(10.0, 400, np.array([2e-4, 0.0, 0.0])), np.zeros((400, 6))])
    found = watched(shifts)
    assert found[399] is not None
    assert not any(found[560:])


def test_one_that_goes_on_is_not_over_when_it_has_been_learnt_as_noise():
    shifts = noise(3, 1200) + np.concatenate([wave(10.0, 800, np.array([2e-4, 0.0, 0.0])), np.zeros((400, 6))])
    learnt = COVARIANCE.copy()
    learnt[0, 0] += 0.5 * 2e-4**2
    watch, found, news = VibrationWatch(2e-5), [], []
    for index, shift in enumerate(shifts):
        usual = COVARIANCE if index < 400 else learnt
        found.append(watch.add(shift, index / FPS, usual.copy))
        news.append(watch.is_news)
    assert all(found[160:800]) and not any(found[960:])
    assert all(news[160:400]) and not any(news[440:])


def test_what_is_forgotten_is_over():
    watch = VibrationWatch(2e-5)
    for index, shift in enumerate(noise(4, 300) + wave(10.0, 300, np.array([2e-4, 0.0, 0.0]))):
        found = watch.add(shift, index / FPS, lambda: COVARIANCE)
    assert found is not None
    watch.forget()
    assert watch.add(np.zeros(6), 10.0, lambda: COVARIANCE) is None


def loud(ratio: float, frames: int) -> np.ndarray:
    """A sinusoid that makes the variance ``ratio`` times what frames claim, in the direction where it is loudest."""
    direction = np.array([0.0, 0.0, 1.0])
    amplitude_m = np.sqrt(2.0 * (ratio - 1.0) / (direction @ np.linalg.solve(COVARIANCE[:3, :3], direction)))
    return wave(11.0, frames, amplitude_m * direction)


@pytest.mark.parametrize("seed", range(2))
def test_a_vibration_has_six_times_the_variance_and_goes_on_down_to_three_times(seed: int):
    """Margins of a third for what 32 frames don't tell."""
    assert not any(watched(noise(seed, 600) + loud(4.0, 600), smallest_m=1e-9))
    assert watched(noise(seed, 600) + loud(9.0, 600), smallest_m=1e-9)[-1] is not None
    fading = noise(seed, 1200) + np.concatenate([loud(ratio, 400) for ratio in (12.0, 4.8, 1.5)])
    found = watched(fading, smallest_m=1e-9)
    assert found[399] is not None and found[799] is not None and found[-1] is None
