"""The pose filter against plain averages, batch least squares and the Riccati equation; what quiet time teaches, steps,
ring-down, vibration, creep and outliers against simulated truth.
"""

from __future__ import annotations

import copy
from functools import lru_cache

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation
from support.box_models import random_rotation

from gripmon.judge.smoothing import PoseAverage, PoseFilter, QuietTime, SmoothingSettings

SETTINGS = SmoothingSettings()
PERIOD_S = 1.0 / 60.0
RNG = np.random.default_rng(1)
TRUE = np.eye(4)
TRUE[:3, :3] = random_rotation(RNG)
TRUE[:3, 3] = [0.001, -0.002, 0.115]


def spread(scale: float = 1.0, seed: int = 2) -> np.ndarray:
    """A covariance (6, 6) with correlations: some micrometres, some hundredths of a degree."""
    units = np.array([3e-6, 2e-6, 2e-5, 4e-4, 3e-4, 1e-4]) * scale
    mixing = np.random.default_rng(seed).normal(size=(6, 9))
    correlation = mixing @ mixing.T / 9.0
    return units[:, None] * correlation * units


def moved(pose: np.ndarray, xi: np.ndarray) -> np.ndarray:
    out = pose.copy()
    out[:3, :3] = Rotation.from_rotvec(xi[3:]).as_matrix() @ pose[:3, :3]
    out[:3, 3] += xi[:3]
    return out


def difference(from_T: np.ndarray, to_T: np.ndarray) -> np.ndarray:
    turn = Rotation.from_matrix(to_T[:3, :3] @ from_T[:3, :3].T).as_rotvec()
    return np.concatenate([to_T[:3, 3] - from_T[:3, 3], turn])


def noise(rng: np.random.Generator, covariance: np.ndarray, count: int) -> np.ndarray:
    return rng.normal(size=(count, 6)) @ np.linalg.cholesky(covariance).T


# --- the filter ---


def run_filter(poses, covariances, walk=np.zeros(6)):  # noqa: B008 - never written to
    filtered = PoseFilter(poses[0], covariances[0])
    for pose, covariance in zip(poses[1:], covariances[1:], strict=True):
        filtered.wander(walk)
        innovation, gain, _ = filtered.weigh(pose, covariance)
        filtered.correct(innovation, gain)
    return filtered


def test_a_pose_that_stands_still_is_averaged_and_its_covariance_falls_with_the_count():
    covariance = spread()
    errors = noise(np.random.default_rng(3), covariance, 50)
    filtered = run_filter([moved(TRUE, xi) for xi in errors], [covariance] * 50)
    np.testing.assert_allclose(filtered.covariance, covariance / 50, rtol=1e-8)
    # Rotation vectors don't add up exactly: what is left is the square of the noise.
    np.testing.assert_allclose(difference(TRUE, filtered.mean_T)[:3], errors.mean(axis=0)[:3], atol=1e-12)
    np.testing.assert_allclose(difference(TRUE, filtered.mean_T)[3:], errors.mean(axis=0)[3:], atol=1e-6)


def test_a_wandering_pose_is_what_batch_least_squares_over_all_frames_makes_of_it():
    """All poses of the way as unknowns, measured and tied to their neighbours by the walk: the newest's estimate."""
    rng, count = np.random.default_rng(6), 25
    walk = np.square([2e-6] * 3 + [1e-4] * 3)
    covariances = [spread(scale=rng.uniform(0.5, 2.0), seed=k) for k in range(count)]
    way = np.cumsum(rng.normal(size=(count, 6)) * np.sqrt(walk), axis=0)
    xis = [w + noise(rng, c, 1)[0] for w, c in zip(way, covariances, strict=True)]
    filtered = run_filter([moved(TRUE, xi) for xi in xis], covariances, walk)
    # Comparable units for the normal equations.
    unit = np.array([1e-6] * 3 + [1e-4] * 3)
    normal, right = np.zeros((6 * count, 6 * count)), np.zeros(6 * count)
    for k in range(count):
        here = slice(6 * k, 6 * k + 6)
        information = np.linalg.inv(covariances[k] / np.outer(unit, unit))
        normal[here, here] += information
        right[here] += information @ (xis[k] / unit)
        if k:
            tie = np.kron([[1.0, -1.0], [-1.0, 1.0]], np.diag(unit**2 / walk))
            normal[6 * k - 6 : 6 * k + 6, 6 * k - 6 : 6 * k + 6] += tie
    covariance = np.linalg.inv(normal)
    expected = (covariance @ right)[-6:] * unit
    np.testing.assert_allclose(filtered.covariance, covariance[-6:, -6:] * np.outer(unit, unit), rtol=1e-6, atol=1e-20)
    np.testing.assert_allclose(difference(TRUE, filtered.mean_T)[:3], expected[:3], atol=2e-8)
    np.testing.assert_allclose(difference(TRUE, filtered.mean_T)[3:], expected[3:], atol=2e-6)


def test_a_covariance_that_is_not_positive_definite_is_refused():
    filtered = PoseFilter(TRUE, spread())
    with pytest.raises(ValueError, match="not positive definite"):
        filtered.weigh(TRUE, -2.0 * spread())


def test_the_gate_lets_all_but_one_in_a_million_of_honest_measurements_pass():
    from scipy.stats import chi2

    from gripmon.judge.smoothing import GATE_SQUARE

    assert chi2.sf(GATE_SQUARE, 6) == pytest.approx(1e-6, rel=1e-6)


# --- what is made of a stream ---


def run(xis, covariance, average=None, quiet=True):
    """Poses (n, 6) from the true one through the average: what it stands by, (n, 6), and the claimed covariances."""
    average = PoseAverage(SETTINGS) if average is None else average
    out, claimed = [], []
    for xi in xis:
        average.wander(PERIOD_S)
        average.add(moved(TRUE, xi), covariance, quiet)
        out.append(difference(TRUE, average.cam_T_grip))
        claimed.append(average.claimed_covariance)
    return np.array(out), np.array(claimed)


def normalised(errors, covariances):
    return np.array([e @ np.linalg.solve(c, e) for e, c in zip(errors, covariances, strict=True)])


def correlated(rng, covariance, count, frames, share):
    """Errors of which ``share`` of the variance has a correlation time and the rest is white."""
    factor = np.exp(-1.0 / frames)
    # From a stationary start.
    state = factor * rng.normal(size=(1, 6))
    slow, _ = lfilter([np.sqrt(1.0 - factor**2)], [1.0, -factor], rng.normal(size=(count, 6)), axis=0, zi=state)
    mixed = np.sqrt(share) * slow + np.sqrt(1.0 - share) * rng.normal(size=(count, 6))
    return mixed @ np.linalg.cholesky(covariance).T


def rms(values):
    return np.sqrt(np.mean(np.square(values), axis=0))


@pytest.mark.parametrize(("frames", "share"), [(1.0, 0.0), (1e6, 0.9)])
def test_the_claimed_covariance_is_honest_for_errors_that_last(frames: float, share: float):
    """From white noise to a background that never moves: mean normalised error of some independent streams."""
    covariance, nees, better = spread(), [], []
    for seed in range(16):
        errors = correlated(np.random.default_rng(seed), covariance, 1500, frames, share)
        out, claimed = run(errors, covariance)
        nees.append(normalised(out[600:], claimed[600:]).mean())
        better.append(rms(out[600:]) / rms(errors[600:]))
    # 6 is what honesty wants; with the least that is kept, white noise is claimed too large.
    assert np.mean(nees) < 6.0 + 4.0 * np.std(nees) / 4.0
    assert np.mean(nees) > (0.5 if frames <= 1.0 else 3.0)
    assert np.mean(better) < {1.0: 0.4, 1e6: 1.01}[frames]


def test_process_noise_is_learnt_within_its_bounds():
    """Little for a camera that stands; of a walk that leaves the noise behind within four seconds, its own size."""
    covariance = spread(scale=0.3)
    prior = np.square([1e-5] * 3 + [1e-4] * 3)
    standing, walking = PoseAverage(SETTINGS), PoseAverage(SETTINGS)
    rng = np.random.default_rng(8)
    run(noise(rng, covariance, 7200), covariance, standing)
    assert (standing.learnt.walk <= 0.05 * prior).all()
    walk = 2.0 * np.sqrt(covariance.diagonal())
    truth = np.cumsum(rng.normal(size=(7200, 6)) * walk * np.sqrt(PERIOD_S), axis=0)
    run(truth + noise(rng, covariance, 7200), covariance, walking)
    # Thirty ways of four seconds: a quarter of their mean square is its standard deviation; along y the setting, which
    # is a hundred times the walk, still counts for a hundredth.
    ratio = walking.learnt.walk / walk**2
    assert (ratio > 0.3).all() and (ratio < [2.2, 3.5, 2.2, 2.2, 2.2, 2.2]).all(), ratio


def test_nothing_is_learnt_while_time_is_not_quiet():
    covariance = spread()
    average = PoseAverage(SETTINGS)
    run(np.cumsum(noise(np.random.default_rng(9), covariance, 900), axis=0) * 0.1, covariance, average, quiet=False)
    fresh = QuietTime(SETTINGS)
    np.testing.assert_array_equal(average.learnt.scatter, fresh.scatter)
    np.testing.assert_array_equal(average.learnt.walk, fresh.walk)


def test_what_quiet_time_taught_survives_forgetting():
    covariance, average = spread(), PoseAverage(SETTINGS)
    run(noise(np.random.default_rng(10), covariance, 3600), covariance, average)
    scatter, walk = average.learnt.scatter, average.learnt.walk
    assert scatter == pytest.approx(np.ones(6), abs=0.3)
    average.forget()
    assert average.cam_T_grip is None
    there = moved(TRUE, np.array([0.01, 0.0, 0.0, 0.0, 0.3, 0.0]))
    average.add(there, covariance)
    np.testing.assert_array_equal(average.cam_T_grip, there)
    np.testing.assert_array_equal(average.claimed_covariance, covariance)
    np.testing.assert_array_equal(average.learnt.scatter, scatter)
    np.testing.assert_array_equal(average.learnt.walk, walk)


@lru_cache(maxsize=64)
def kept_settled(seed, count):
    covariance, average = spread(), PoseAverage(SETTINGS)
    run(correlated(np.random.default_rng(seed), covariance, count, 8.0, 0.5), covariance, average)
    return average


def settled(seed=11, count=1800):
    """An average after so many frames of covariance :func:`spread`; the caller's own."""
    return copy.deepcopy(kept_settled(seed, count))


def test_a_single_outlier_leaves_the_average_where_it_was_and_is_claimed_as_doubt():
    covariance = spread()
    average = settled()
    before_T, before = average.cam_T_grip, average.claimed_covariance
    out = np.array([0.001, 0, 0, 0, 0, 0])
    average.add(moved(before_T, out), covariance)
    np.testing.assert_allclose(difference(before_T, average.cam_T_grip), np.zeros(6), atol=3e-6)
    assert average.claimed_covariance[0, 0] == pytest.approx(1e-6, rel=0.05)
    average.add(before_T, covariance)
    assert np.abs(difference(before_T, average.cam_T_grip)[0]) < 0.2 * np.sqrt(covariance[0, 0])
    assert average.claimed_covariance[0, 0] < 2.0 * before[0, 0]
    # One good measurement between two outliers: neither is believed.
    average.add(moved(before_T, out), covariance)
    assert np.abs(difference(before_T, average.cam_T_grip)[0]) < 0.5 * np.sqrt(covariance[0, 0])


@pytest.mark.parametrize("axis", [1, 5])
def test_a_jump_starts_the_average_anew_with_its_second_frame_from_both(axis: int):
    covariance = spread()
    average = settled()
    jump = np.zeros(6)
    jump[axis] = 60.0 * np.sqrt(covariance[axis, axis])
    apart = np.linalg.cholesky(covariance)[:, axis]
    average.add(moved(TRUE, jump), covariance)
    average.add(moved(TRUE, jump + apart), covariance)
    np.testing.assert_allclose(difference(TRUE, average.cam_T_grip), jump + 0.5 * apart, atol=1e-5 * (axis > 2) + 1e-12)


def test_two_outliers_that_contradict_each_other_are_not_averaged():
    covariance = spread()
    average = settled()
    jump = np.array([0.001, 0, 0, 0, 0, 0])
    average.add(moved(TRUE, jump), covariance)
    average.add(moved(TRUE, -jump), covariance)
    np.testing.assert_array_equal(average.cam_T_grip, moved(TRUE, -jump))


def test_after_a_step_that_others_noticed_the_average_is_that_of_the_frames_since():
    """A step that is too small for single frames to show."""
    covariance, count = spread(), 12
    step = 1.5 * np.linalg.cholesky(covariance)[:, 1]
    sizes = []
    for seed in range(30):
        average = settled(seed, 240)
        run(step + noise(np.random.default_rng(500 + seed), covariance, count), covariance, average)
        average.step(count)
        miss = difference(TRUE, average.cam_T_grip) - step
        sizes.append(miss @ np.linalg.solve(covariance, miss))
    # Of a frame it is 6, of the mean of twelve independent ones 0.5; some frames look like motion that goes on.
    assert np.mean(sizes) < 2.5
    average.step(0)
    assert average.cam_T_grip is None


def bump(size_m: float, ring: bool) -> np.ndarray:
    """A second after a knock of the camera: the TCP goes along y and the view turns about x, 0.12 m away; a third of it
    rings down at 9 Hz within an eighth of a second.
    """
    t_s = np.arange(60) * PERIOD_S
    way = 1.0 - ring * 0.3 * np.exp(-t_s / 0.12) * np.cos(2.0 * np.pi * 9.0 * t_s)
    return np.outer(way, np.array([0.1, 1.0, 0.0, 8.0, 0.5, 0.0]) * size_m)


@pytest.mark.parametrize("size_m", [1e-4, 4.5e-3])
@pytest.mark.parametrize("ring", [False, True], ids=["step", "ring-down"])
def test_after_a_step_the_average_is_no_worse_than_the_frames(size_m: float, ring: bool):
    """From its second frame on, no one telling the average that anything happened."""
    covariance = spread()
    truth, smoothed, raw, nees = bump(size_m, ring), [], [], []
    for seed in range(40):
        average = settled(seed, 240)
        errors = correlated(np.random.default_rng(1000 + seed), covariance, 60, 8.0, 0.5)
        out, claimed = run(truth + errors, covariance, average)
        smoothed.append(out - truth)
        raw.append(errors)
        nees.append(normalised(out[1:] - truth[1:], claimed[1:]))
    smoothed, raw = np.array(smoothed)[:, 1:], np.array(raw)[:, 1:]
    assert (rms(smoothed.reshape(-1, 6)) < 1.2 * rms(raw.reshape(-1, 6))).all()
    # Each tenth of a second for itself, too; all axes in units of the frames' error.
    share = np.sqrt(np.mean((smoothed / rms(raw.reshape(-1, 6))) ** 2, axis=(0, 2)))
    assert share[:54].reshape(9, 6).mean(axis=1).max() < (1.45 if ring else 1.2), share
    assert np.mean(nees) < 8.0


@pytest.mark.parametrize("speed_m_per_s", [1e-4 / 60.0, 1e-3 / 60.0])
def test_in_creep_the_average_does_not_fall_behind(speed_m_per_s: float):
    """0.1 and 1 mm a minute; the policy noticed, so that nothing more is learnt."""
    covariance = spread()
    truth = np.outer(np.arange(600) * PERIOD_S, np.array([0.0, 1.0, 0.0, 8.0, 0.0, 0.0]) * speed_m_per_s)
    smoothed, raw, nees = [], [], []
    for seed in range(8):
        average = settled(seed)
        errors = correlated(np.random.default_rng(2000 + seed), covariance, 600, 8.0, 0.5)
        out, claimed = run(truth + errors, covariance, average, quiet=False)
        smoothed.append(out - truth)
        raw.append(errors)
        nees.append(normalised(out - truth, claimed))
    worse = rms(np.concatenate(smoothed)) / rms(np.concatenate(raw))
    assert (worse < 1.2).all(), worse
    assert np.mean(nees) < 9.0


def test_vibration_is_not_hidden():
    """A mount that swings by three times a frame's error: the transform goes along, its covariance says the rest."""
    covariance = spread()
    size = 3.0 * np.sqrt(covariance[1, 1])
    truth = np.outer(np.sin(2.0 * np.pi * 13.0 * np.arange(3600) * PERIOD_S), [0.0, size, 0.0, 0.0, 0.0, 0.0])
    errors = noise(np.random.default_rng(13), covariance, 3600)
    out, claimed = run(truth + errors, covariance)
    late = slice(1800, None)
    miss = (out - truth)[late]
    assert rms(miss)[1] < 1.2 * rms(errors[late])[1]
    assert (rms(miss)[[0, 2]] < 0.9 * rms(errors[late])[[0, 2]]).all()
    assert np.mean(miss[:, 1] ** 2 / claimed[late, 1, 1]) < 1.3
