"""The sequential test: its contract on noise of several kinds, its delay, and what it does not fall for."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from scipy import stats
from support.drift_noise import COVARIANCE, SIGMA, autocorrelated, claimed, feed, vibrating, white

from gripmon.judge.drift import DriftSettings, SequentialTest

PLAIN = DriftSettings(tolerated_m=0.0, tolerated_rad=0.0)
NOISES = {"white": white, "autocorrelated": autocorrelated, "vibrating": vibrating}
LENGTHS = [2**k for k in range(13)]


def onsets(test: SequentialTest, shifts: np.ndarray) -> np.ndarray:
    """(n, s) frames in which an alarm begins."""
    moved = np.array([finding.moved for finding in feed(test, shifts)])
    moved[1:] &= ~moved[:-1]
    return moved


# --- the contract ---


@pytest.mark.parametrize("tolerated", [False, True])
@pytest.mark.parametrize("noise", NOISES)
def test_an_unmoved_camera_is_said_to_move_no_more_often_than_stated(noise: str, tolerated: bool):
    """One alarm in 864 frames is stated here, so that they could be counted: 74 in all of these frames, and from the
    first frame on, though nothing is known of the noise then.
    """
    bounds = {} if tolerated else {"tolerated_m": 0.0, "tolerated_rad": 0.0}
    settings = DriftSettings(false_alarms_per_day=1000.0, frames_per_s=10.0, **bounds)
    shifts = NOISES[noise](np.random.default_rng(1), 1000, 64)
    alarms = onsets(SequentialTest(settings, 64), shifts)
    assert alarms.sum() <= 64 * 1000 / 864
    assert alarms[:100].sum() <= 64 * 100 / 864
    assert alarms[-500:].sum() <= 64 * 500 / 864


def noticed_within(test: SequentialTest, noise: np.ndarray, deviations: float) -> np.ndarray:
    """(s,) frames until each stream notices a step in ``noise`` (n, s, 6); the size in standard deviations."""
    direction = np.linalg.cholesky(COVARIANCE) @ np.full(6, 1.0 / np.sqrt(6.0))
    moved = np.array([finding.moved for finding in feed(test, noise + deviations * direction)])
    return np.where(moved.any(axis=0), 1 + moved.argmax(axis=0), np.iinfo(int).max)


@pytest.mark.parametrize("noise", NOISES)
def test_at_a_rate_that_cells_want_there_is_none_in_an_hour_and_steps_are_noticed(noise: str):
    """One alarm a day: 256,000 frames at 60 frames/s are 71 minutes.  A test that never speaks would pass that."""
    rng, test = np.random.default_rng(2), SequentialTest(DriftSettings(), 256)
    assert not onsets(test, NOISES[noise](rng, 1000, 256)).any()
    assert noticed_within(test, white(rng, 30, 256), 60.0).max() <= 10


@pytest.mark.slow("40 s; the same contract at a rate of alarms that can be counted is in the default run")
def test_with_learnt_limits_there_is_none_in_hours_and_steps_are_noticed():
    """One alarm a day, 64 streams.  When all windows are full and limits are learnt there follow three and a half
    hours, in which twenty times the rate would be noticed with a chance of 95 %.
    """
    rng, test = np.random.default_rng(36), SequentialTest(DriftSettings(), 64)

    def noise(frames: int) -> np.ndarray:
        return np.concatenate([kind(rng, frames, 32) for kind in (white, autocorrelated)], axis=1)

    for _ in range(LEARNT_FRAMES // 3000):
        feed(test, noise(3000))
    assert not any(onsets(test, noise(3000)).any() for _ in range(4))
    assert noticed_within(test, noise(30), 60.0).max() <= 10


def test_what_is_tolerated_is_no_drift_though_errors_are_correlated():
    """An offset up to the tolerance, in any direction, on top of noise."""
    settings = DriftSettings(false_alarms_per_day=1000.0, frames_per_s=10.0, tolerated_m=2e-5, tolerated_rad=1e-3)
    rng = np.random.default_rng(3)
    offset = rng.uniform(-1.0, 1.0, (64, 6)) * ([2e-5] * 3 + [1e-3] * 3)
    shifts = white(rng, 1000, 64) + offset
    assert onsets(SequentialTest(settings, 64), shifts).sum() <= 64 * 1000 / 864
    exact = DriftSettings(false_alarms_per_day=1000.0, frames_per_s=10.0, tolerated_m=0.0, tolerated_rad=0.0)
    assert feed(SequentialTest(exact, 64), shifts)[-1].moved.mean() > 0.5, "without tolerance it is one"


@pytest.mark.parametrize("streams", [1, 64])
def test_noise_louder_than_frames_claim_is_learnt(streams: int):
    """Three times the claimed standard deviation: what frames claim doesn't matter once the stream has shown more."""
    settings = DriftSettings(false_alarms_per_day=1000.0, frames_per_s=10.0)
    test = SequentialTest(settings, streams)
    shifts = 3.0 * autocorrelated(np.random.default_rng(4), 4000, streams)
    alarms = onsets(test, shifts)
    assert alarms[2000:].sum() <= 2000 * streams / 864
    usual = np.linalg.solve(COVARIANCE, test.usual_covariance() - COVARIANCE)
    assert 0.3 * 9.0 < np.trace(usual) / 6.0 < 3.0 * 9.0


def test_what_is_usual_is_what_frames_claim_and_the_stream_has_shown_together():
    """Their sum, with the claims as they are, and followed within some hundred frames where they change."""
    test, scaled = SequentialTest(PLAIN), SequentialTest(PLAIN)
    for _ in range(600):
        test.add(np.zeros((1, 6)), claimed(1))
        scaled.add(np.zeros((1, 6)), 4.0 * claimed(1))
    shown = test.scatter.of_single_frames()[0]
    np.testing.assert_allclose(test.usual_covariance(), COVARIANCE + shown, rtol=1e-6)
    np.testing.assert_allclose(scaled.usual_covariance() - scaled.scatter.of_single_frames()[0], 4.0 * COVARIANCE)
    for _ in range(1000):
        test.add(np.zeros((1, 6)), 9.0 * claimed(1))
    claims = test.usual_covariance() - test.scatter.of_single_frames()[0]
    np.testing.assert_allclose(claims, 9.0 * COVARIANCE, rtol=1e-3)


def bursting(rng: np.random.Generator, frames: int, streams: int) -> np.ndarray:
    """Normal errors whose size wanders by half of itself, as long as half a second at 60 frames/s."""
    log, memory = np.empty((frames, streams)), np.exp(-1.0 / 32.0)
    now = rng.normal(size=streams)
    for index in range(frames):
        now = memory * now + np.sqrt(1.0 - memory**2) * rng.normal(size=streams)
        log[index] = now
    return white(rng, frames, streams) * np.exp(0.5 * log)[..., None]


# --- limits that the stream's own extremes have taught ---

LEARNT_FRAMES = 21_000
"""The longest window, and 64 blocks of 256 frames after it."""


def test_learnt_limits_keep_the_contract_where_alarms_can_be_counted():
    """Sixteen streams of each noise: a rate of one and a half times what is stated would be seen at three and a half
    standard deviations of the count.
    """
    settings = DriftSettings(false_alarms_per_day=1000.0, frames_per_s=10.0, tolerated_m=0.0, tolerated_rad=0.0)
    test, rng = SequentialTest(settings, 32), np.random.default_rng(31)
    shifts = np.concatenate([noise(rng, LEARNT_FRAMES + 5000, 16) for noise in (autocorrelated, bursting)], axis=1)
    feed(test, shifts[:LEARNT_FRAMES])
    last, alarms = np.full(32, -100), np.zeros(32, dtype=int)
    for number, finding in enumerate(feed(test, shifts[LEARNT_FRAMES:])):
        alarms += finding.moved & (number - last > 60)  # within a second: one alert
        last[finding.moved] = number
    for of_noise in (alarms[:16], alarms[16:]):
        assert 0 < of_noise.sum() <= 16 * 5000 / 864


@pytest.mark.slow("8 s: how much is gained; that the contract is kept is in the default run")
def test_a_calm_stream_is_watched_more_closely_than_before_and_than_a_bursting_one():
    """The same step in the same streams: excess after it, before and after enough of the noise has been seen."""
    rng, test, excess = np.random.default_rng(32), SequentialTest(PLAIN, 16), {}

    def calm_and_bursting(seed: int, frames: int) -> np.ndarray:
        return np.concatenate([noise(np.random.default_rng(seed), frames, 8) for noise in (white, bursting)], axis=1)

    shifts = calm_and_bursting(33, LEARNT_FRAMES)
    step = 30.0 * np.linalg.cholesky(COVARIANCE) @ (rng.normal(size=6) / np.sqrt(6.0))
    for frames in (6000, LEARNT_FRAMES):
        feed(test, shifts[:frames] if frames == 6000 else shifts[6000:])
        found = np.array([f.excess for f in feed(copy.deepcopy(test), calm_and_bursting(34, 8) + step)[4:]])
        excess["calm", frames], excess["bursting", frames] = np.median(found[:, :8]), np.median(found[:, 8:])
    assert excess["calm", LEARNT_FRAMES] > 1.3 * excess["calm", 6000]
    assert excess["calm", LEARNT_FRAMES] > 1.5 * excess["bursting", LEARNT_FRAMES]


@pytest.mark.slow("4 s: a finer point of learning; that the contract is kept is in the default run")
def test_a_motion_is_no_noise_to_learn_limits_from():
    """Two streams with the same noise, of which one has made a step of a thousand standard deviations.

    After it the longest window has to be full once more before means are learnt from.
    """
    rng = np.random.default_rng(35)
    shifts = np.repeat(white(rng, LEARNT_FRAMES + 5000, 1), 2, axis=1)
    test = SequentialTest(PLAIN, 2)
    feed(test, shifts[:10_000])
    feed(test, shifts[10_000:10_040] + np.array([[0.0], [1000.0]]) * SIGMA)
    test.restart(np.array([False, True]))
    feed(test, shifts[10_040:])
    small = white(rng, 8, 1) + 30.0 * SIGMA
    unmoved, moved = np.median([f.excess for f in feed(test, np.repeat(small, 2, axis=1))[4:]], axis=0)
    assert moved == pytest.approx(unmoved, rel=0.3)


# --- delay ---


def expected_delay(sizes: float, *, rate: float = 1.0, frames_per_s: float = 60.0) -> int:
    """Frames until a step of so many standard deviations is found, where frames claim COVARIANCE but have no noise.

    All windows of L frames, of which m lie behind the step, are off by m / L of it; the median of three shows it one
    frame late.
    """
    limit = 1.55 * stats.chi2.isf(rate / (86_400.0 * frames_per_s * 2 * 13), 6)
    for behind in range(1, 4097):
        for length in LENGTHS:
            part = min(behind / length, 1.0) * sizes
            before = max(0.0, min(behind / length - 1.0, 1.0)) * sizes
            if part**2 > limit or (part - before) ** 2 / 2.0 > limit:
                return behind + 1
    raise AssertionError("never")


@pytest.fixture(scope="module")
def rested() -> SequentialTest:
    """All of whose windows are full of frames without noise; to be copied."""
    test = SequentialTest(PLAIN)
    feed(test, np.zeros((9000, 1, 6)))
    return test


@pytest.mark.parametrize("sizes", [13.0, 60.0])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_delay_of_a_step_is_that_of_the_formulas(rested: SequentialTest, sizes: float, sign: float):
    rng, test = np.random.default_rng(5), copy.deepcopy(rested)
    direction = np.linalg.cholesky(COVARIANCE) @ rng.normal(size=6)
    direction /= np.sqrt(direction @ np.linalg.solve(COVARIANCE, direction))
    expected = expected_delay(sizes)
    found = feed(test, np.tile(sign * sizes * direction, (expected + 50, 1, 1)), np.array([False]))
    delay = 1 + next(n for n, finding in enumerate(found) if finding.moved[0])
    # Nothing seen of the noise isn't quite no noise: the prior is forgotten only slowly at the longest lengths.
    assert expected <= delay <= expected + 1


@pytest.mark.slow("8 s; offsets that an uncertain reference doesn't explain are in the default run")
def test_an_offset_without_a_step_is_found_by_the_mean():
    """Fourteen normalised standard deviations in noise that is all that frames claim."""
    rng, test = np.random.default_rng(6), SequentialTest(PLAIN, 16)
    feed(test, autocorrelated(rng, 10_000, 16))
    test.restart(np.full(16, True))
    offset = 14.0 * np.linalg.cholesky(COVARIANCE)[:, 0]
    found = feed(test, autocorrelated(rng, 3000, 16) + offset)
    moved = np.array([finding.moved for finding in found])
    assert moved[-1].all()
    assert not any((f.moved & f.stepped).any() for f in found)
    assert not moved[0].any()


def test_a_step_is_told_from_an_offset_and_its_length_dates_it():
    rng, test = np.random.default_rng(7), SequentialTest(PLAIN)
    feed(test, white(rng, 3000, 1))
    found = feed(test, white(rng, 6, 1) + 200.0 * SIGMA)
    first = next(f for f in found if f.moved[0])
    assert first.stepped[0]
    assert first.length[0] <= 2
    assert first.excess[0] > 1.0
    assert not any(f.moved[0] for f in found[:1]), "the first frame after the step can't decide"


# --- what does not decide ---


@pytest.mark.parametrize("sizes", [10.0, 1e4])
def test_one_wild_frame_never_decides(sizes: float):
    """Not the first one either, and not one every now and then."""
    rng = np.random.default_rng(8)
    shifts = white(rng, 1200, 8)
    shifts[0, :4] += sizes * SIGMA
    for frame in (1, 40, 500, 503, 1000, 1199):
        shifts[frame, 4:] += rng.choice([-1.0, 1.0], (4, 6)) * sizes * SIGMA
    test = SequentialTest(DriftSettings(), 8)
    assert not any(finding.moved.any() for finding in feed(test, shifts))
    feed(test, white(rng, 50, 8))
    test.restart(np.full(8, True))
    again = white(rng, 50, 8)
    again[0] += sizes * SIGMA
    assert not any(finding.moved.any() for finding in feed(test, again))


def test_two_wild_frames_of_a_real_step_do():
    rng, test = np.random.default_rng(9), SequentialTest(DriftSettings())
    feed(test, white(rng, 1000, 1))
    found = feed(test, white(rng, 2, 1) + 1e4 * SIGMA)
    assert [bool(f.moved[0]) for f in found] == [False, True]


def test_a_frame_that_claims_more_error_moves_the_mean_less():
    """Poor frames, and honest about it: twenty times the noise, and the covariance to go with it."""
    rng = np.random.default_rng(10)
    test = SequentialTest(DriftSettings(), 16)
    feed(test, white(rng, 1000, 16))
    for shift in 20.0 * white(rng, 30, 16):
        assert not test.add(shift, 400.0 * claimed(16)).moved.any()


# --- restart, reference, rate ---


def test_after_a_restart_drift_is_reckoned_anew_but_the_noise_is_remembered():
    rng = np.random.default_rng(11)
    test = SequentialTest(PLAIN, 2)
    feed(test, white(rng, 2000, 2))
    assert feed(test, white(rng, 100, 2) + 100.0 * SIGMA)[-1].moved.all()
    learnt = test.scatter.windows.copy()
    test.restart(np.array([True, False]))
    assert test.windows.frames.tolist() == [0, 2098], "the first two frames make no median of three"
    np.testing.assert_array_equal(test.scatter.windows, learnt)
    after = feed(test, white(rng, 100, 2))
    assert not any(f.moved[0] for f in after)
    assert any(f.moved[1] for f in after), "the other stream was not restarted: it sees the step back"


def test_a_restart_may_keep_the_newest_frames():
    rng, test = np.random.default_rng(12), SequentialTest(PLAIN)
    feed(test, white(rng, 1000, 1))
    feed(test, white(rng, 20, 1) + 100.0 * SIGMA)
    test.restart(np.array([True]), 10)
    assert test.windows.frames.tolist() == [10]
    assert feed(test, white(rng, 1, 1) + 100.0 * SIGMA)[0].moved[0], "it is still away from the reference"
    mean, _ = test.level(10)
    np.testing.assert_allclose(mean[0], 100.0 * SIGMA, rtol=0.05)


def test_an_uncertain_reference_explains_a_shift_but_no_step():
    rng, offset = np.random.default_rng(13), 100.0 * SIGMA
    certain, uncertain = SequentialTest(PLAIN), SequentialTest(PLAIN)
    uncertain.set_reference_covariance(np.diag(np.square(offset)))
    shifts = white(rng, 500, 1) + offset
    assert any(f.moved[0] for f in feed(certain, shifts))
    assert not any(f.moved[0] for f in feed(uncertain, shifts))
    assert any(f.moved[0] and f.stepped[0] for f in feed(uncertain, white(rng, 10, 1)))
    _, covariance = uncertain.level(100)
    assert (covariance[0].diagonal() >= np.square(offset)).all()


def test_the_contract_is_in_days_whatever_the_frame_rate():
    """The faster the frames come the less often one of them may alarm: the same evidence counts for less."""
    slow, fast = (SequentialTest(PLAIN) for _ in range(2))
    rng = np.random.default_rng(14)
    shifts = white(rng, 40, 1)
    slow.set_frames_per_s(1.0)
    fast.set_frames_per_s(1000.0)
    pairs = zip(feed(slow, shifts), feed(fast, shifts), strict=True)
    assert all(f.excess[0] < s.excess[0] for s, f in list(pairs)[3:])
    fast.set_frames_per_s(1.0)  # measured again in the middle of the stream
    more = white(rng, 300, 1)
    pairs = [(s.excess[0], f.excess[0]) for s, f in zip(feed(slow, more), feed(fast, more), strict=True)]
    np.testing.assert_allclose(*zip(*pairs[260:], strict=True), rtol=1e-4)  # what was learnt is taken over now and then


def test_streams_know_nothing_of_one_another():
    rng = np.random.default_rng(16)
    shifts = autocorrelated(rng, 800, 64)
    shifts[600:, 20:40] += 30.0 * SIGMA
    together = feed(SequentialTest(DriftSettings(), 64), shifts)
    for stream in (0, 25, 63):
        alone = feed(SequentialTest(DriftSettings()), shifts[:, stream : stream + 1])
        for one, all_of_them in zip(alone, together, strict=True):
            assert one.moved[0] == all_of_them.moved[stream]
            assert one.length[0] == all_of_them.length[stream]
            assert one.stepped[0] == all_of_them.stepped[stream]
            np.testing.assert_allclose(one.excess[0], all_of_them.excess[stream], rtol=1e-6)


def test_it_is_one_whether_a_frame_teaches_at_once_or_with_the_next():
    """What is learnt after the transform has left is what the next frame would have learnt first."""
    at_once, later = (SequentialTest(DriftSettings()) for _ in range(2))
    for shift in autocorrelated(np.random.default_rng(6), 400, 1):
        one, other = at_once.add(shift, claimed(1)), later.add(shift, claimed(1))
        at_once.learn()
        at_once.learn()  # a second time teaches nothing
        assert one.moved == other.moved and one.excess == other.excess
    assert at_once.refreshes - later.refreshes in (0, 1) and later.refreshes > 20
    later.learn()
    np.testing.assert_array_equal(at_once.scatter.of_differences, later.scatter.of_differences)


def test_what_has_no_root_is_an_error():
    with pytest.raises(np.linalg.LinAlgError, match="positive definite"):
        SequentialTest(DriftSettings()).square_beyond(np.ones(6), -np.eye(6))
    with pytest.raises(np.linalg.LinAlgError, match="positive definite"):
        SequentialTest(DriftSettings()).add(np.zeros((1, 6)), -np.eye(6)[None])
