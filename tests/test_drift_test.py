"""The drift test against Page's, its stated false-alarm rate, its delay, and how often it speaks."""

from __future__ import annotations

import numpy as np
import pytest
from policy_runs import DRIFTING, SETTINGS, TRACKING, VALID, kinds, seen, settled

from gripmon.policy import DriftTest, Evidence, PolicySettings
from gripmon.records import AlertKind, Cause

K = AlertKind


def cusum(shifts: np.ndarray, sigma: np.ndarray, smallest: np.ndarray, limit: float) -> np.ndarray:
    """Twelve CUSUMs (n, 2, 6) without an upper bound, by running sums and their running minimum (Page 1954)."""
    out = np.empty((len(shifts), 2, 6))
    for k, sign in enumerate((1.0, -1.0)):
        # Log-likelihood ratio of N(smallest, sigma) against N(0, sigma).
        ratio = (shifts**2 - (shifts - sign * smallest) ** 2) / (2.0 * sigma**2)
        total = np.cumsum(np.clip(ratio, -limit, limit), axis=0)
        out[:, k] = total - np.minimum(np.minimum.accumulate(total, axis=0), 0.0)
    return out


SMALLEST = np.array([SETTINGS.smallest_drift_m] * 3 + [SETTINGS.smallest_drift_rad] * 3)


INDEPENDENT = PolicySettings(correlation_frames=1.0)


def test_frames_that_err_together_count_as_one():
    """Ten repetitions of each error, and the setting that says so, alarm where ten times fewer frames would."""
    rng = np.random.default_rng(7)
    sigma, single, repeated = SMALLEST, DriftTest(INDEPENDENT), DriftTest(PolicySettings(correlation_frames=10.0))
    shifts = rng.normal(loc=0.8, size=(300, 1)) * SMALLEST
    alone = [single.add(shift, sigma) for shift in shifts]
    together = [repeated.add(shift, sigma) for shift in shifts for _ in range(10)]
    assert any(alone)
    assert together.index(True) // 10 == alone.index(True)


def test_the_sums_are_those_of_page():
    rng = np.random.default_rng(1)
    sigma = SMALLEST * [0.5, 1.0, 2.0, 0.7, 1.0, 1.5]
    shifts = rng.normal(size=(600, 6)) * sigma
    shifts[300:, 1] += 0.4 * SMALLEST[1]
    shifts[450:, 4] -= 1.2 * SMALLEST[4]
    test = DriftTest(INDEPENDENT)
    expected = cusum(shifts, sigma, SMALLEST, 0.2 * test.threshold).max(axis=(1, 2)) >= test.threshold
    first = int(expected.argmax())
    assert 450 < first < 560, "the trial has an alarm"
    assert [test.add(shift, sigma) for shift in shifts[: first + 1]] == [False] * first + [True]


def test_the_threshold_is_the_bound_for_the_tolerated_alarms_a_day():
    """Lorden: each of twelve sums alarms once in exp(h) frames at most."""
    for rate, fps in ((0.01, 60.0), (1.0, 25.0)):
        test = DriftTest(PolicySettings(correlation_frames=1.0, false_alarms_per_day=rate, frames_per_s=fps))
        assert 12.0 * fps * 86400.0 / np.exp(test.threshold) == pytest.approx(rate)


@pytest.mark.parametrize("relative", [1.0, 2.0])
def test_white_noise_alarms_no_more_often_than_stated(relative: float):
    """One alarm in 86 frames is tolerated here; the bound must hold, and not by orders of magnitude."""
    settings = PolicySettings(correlation_frames=1.0, false_alarms_per_day=1000.0, frames_per_s=1.0)
    rng, test, sigma = np.random.default_rng(2), DriftTest(settings), relative * SMALLEST
    shifts = rng.normal(size=(30_000, 6)) * sigma
    alarms = 0
    for shift in shifts:
        if test.add(shift, sigma):
            alarms += 1
            test.reset()
    tolerated = len(shifts) / 86.4
    assert alarms <= tolerated + 4.0 * np.sqrt(tolerated)
    assert alarms >= 0.02 * tolerated


@pytest.mark.parametrize("relative", [0.3, 1.0, 3.0])
def test_a_million_frames_of_an_unmoved_camera_stay_quiet(relative: float):
    """At the default rate 12 / exp(h) is one alarm in 5e8 frames."""
    test = DriftTest(PolicySettings(correlation_frames=1.0))
    sigma = relative * SMALLEST
    rng = np.random.default_rng(3)
    highest = 0.0
    for _ in range(10):
        shifts = rng.normal(size=(100_000, 6)) * sigma
        highest = max(highest, cusum(shifts, sigma, SMALLEST, 0.2 * test.threshold).max())
    assert highest < test.threshold
    assert highest > 0.3 * test.threshold, "the noise does speak for a drift now and then"


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_systematic_offset_below_half_the_smallest_drift_stays_quiet(sign: float):
    """Calibration is never perfect: with the noise of real frames 0.4 of the smallest drift is no drift."""
    run = settled(PolicySettings(correlation_frames=1.0))
    rng = np.random.default_rng(4)
    offset = sign * 0.4 * SMALLEST
    sigma = SMALLEST / 50.0
    for _ in range(3000):
        shift = offset + rng.normal(size=6) * sigma
        judgement = run.feed(Evidence(shift, sigma, 0.0, 0.0, False, Cause.UNKNOWN))
        assert (judgement.state, judgement.verdict, judgement.alerts) == (TRACKING, VALID, ())


@pytest.mark.parametrize(("relative", "frames"), [(0.02, 6), (0.1, 6), (0.5, 30), (1.0, 90), (2.0, 350)])
@pytest.mark.parametrize("axis", [0, 2, 4])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_smallest_drift_is_found_within_the_expected_number_of_frames(
    relative: float, frames: int, axis: int, sign: float
):
    """Each frame adds (drift / sigma)² / 2 on average; bounds are twice what the default threshold of 22.6 needs."""
    test = DriftTest(PolicySettings(correlation_frames=1.0))
    sigma = relative * SMALLEST
    rng = np.random.default_rng(5)
    delays = []
    for _ in range(20):
        test.reset()
        shift = np.zeros(6)
        shift[axis] = sign * SMALLEST[axis]
        delays.append(next(n for n in range(1, 5000) if test.add(shift + rng.normal(size=6) * sigma, sigma)))
    assert np.median(delays) <= frames
    assert min(delays) >= 5, "no four frames may decide"


def test_one_wild_frame_does_not_decide():
    run = settled()
    judgements = run.feed_all([seen(2.0), *[seen()] * 20])
    assert kinds(judgements) == []
    assert {j.state for j in judgements} == {TRACKING}


@pytest.mark.parametrize("relative", [0.02, 0.5, 1.0])
def test_a_constant_drift_is_alerted_once_whatever_the_noise(relative: float):
    """An operator gets one alert, not one at every frame that by chance speaks against the drift."""
    run = settled(PolicySettings(correlation_frames=1.0, suspect_sigma_m=1.0))
    rng, sigma = np.random.default_rng(6), relative * SMALLEST
    judgements = []
    for _ in range(3000):
        shift = SMALLEST + rng.normal(size=6) * sigma
        judgements.append(run.feed(Evidence(shift, sigma, 1e-4, 3e-3, False, Cause.CAMERA_MOUNT)))
    assert kinds(judgements) == [K.DRIFT]


def test_a_slow_creep_is_alerted_once():
    run = settled()
    rng, sigma = np.random.default_rng(7), 0.05 * SMALLEST
    judgements = []
    for size in np.linspace(0.0, 1.5, 4000):
        shift = size * SMALLEST + rng.normal(size=6) * sigma
        judgements.append(run.feed(Evidence(shift, sigma, 1e-4, 3e-3, False, Cause.CAMERA_MOUNT)))
    assert kinds(judgements)[0] is K.DRIFT
    assert len(kinds(judgements)) <= 3, "at half the smallest drift it may be taken back once"
    first = next(n for n, j in enumerate(judgements) if j.state is DRIFTING)
    assert 0.4 < 1.5 * first / 4000 < 0.6, "half the smallest drift is where drift is more likely than none"
