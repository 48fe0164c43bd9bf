"""The policy as tables of frames and judgements; the drift test against Page's and its stated false-alarm rate."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import msgspec
import numpy as np
import pytest

from gripmon.policy import DriftTest, Evidence, Judgement, Policy, PolicySettings
from gripmon.records import AlertKind, Cause, Severity, State, Verdict

SETTINGS = PolicySettings(settle_frames=4, confirm_frames=2, hold_s=1.0, image_alert_after_s=0.5)
PERIOD_S = 0.125
SIGMA = np.array([4e-6, 4e-6, 1.5e-5, 3e-4, 3e-4, 1e-4])
"""What a frame of the simulated gripper is worth."""


def seen(
    x_mm: float = 0.0,
    *,
    turn_rad: float = 0.0,
    jumped: bool = False,
    sigma: np.ndarray = SIGMA,
    cause: Cause = Cause.CAMERA_MOUNT,
) -> Evidence:
    """A measured frame: the TCP shifted along the camera's x axis, turned about z."""
    shift = np.array([1e-3 * x_mm, 0.0, 0.0, 0.0, 0.0, turn_rad])
    return Evidence(shift, sigma, abs(1e-3 * x_mm), abs(turn_rad), jumped, cause)


@dataclass(frozen=True)
class Nothing:
    """A frame without a measurement; with a reason the image was refused."""

    refusal: str | None = None


HIDDEN, BLACK = Nothing(), Nothing("black")
TRACKING, DRIFTING, RECALIBRATING = State.TRACKING, State.DRIFTING, State.RECALIBRATING
ACQUIRING, OCCLUDED, LOST = State.ACQUIRING, State.OCCLUDED, State.LOST
VALID, SUSPECT, UNKNOWN = Verdict.VALID, Verdict.SUSPECT, Verdict.UNKNOWN


class Run:
    """Feeds frames, one every ``PERIOD_S``."""

    def __init__(self, settings: PolicySettings = SETTINGS) -> None:
        self.policy = Policy(settings)
        self.now_s = 100.0
        self.measured = False

    def feed(self, frame: Evidence | Nothing) -> Judgement:
        self.now_s += PERIOD_S
        if isinstance(frame, Nothing):
            return self.policy.unmeasured(self.now_s, frame.refusal, self.measured)
        self.measured = True
        return self.policy.measured(frame)

    def feed_all(self, frames: Iterable[Evidence | Nothing]) -> list[Judgement]:
        return [self.feed(frame) for frame in frames]


def kinds(judgements: Iterable[Judgement]) -> list[AlertKind]:
    return [alert.kind for judgement in judgements for alert in judgement.alerts]


def settled(settings: PolicySettings = SETTINGS) -> Run:
    run = Run(settings)
    assert run.feed_all([seen()] * 3)[-1].state is TRACKING
    return run


Row = tuple[Evidence | Nothing, State, Verdict, list[AlertKind], bool]
K = AlertKind
TABLES: dict[str, list[Row]] = {
    "a start: the second frame that agrees makes it valid": [
        (seen(), ACQUIRING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(), TRACKING, VALID, [], False),
    ],
    "a start on a camera that was moved before: the jump is no news": [
        (seen(4.5, jumped=True), ACQUIRING, SUSPECT, [], False),
        (seen(4.5), RECALIBRATING, VALID, [], False),
        (seen(4.5), RECALIBRATING, VALID, [], False),
        (seen(4.5), RECALIBRATING, VALID, [], True),
        (seen(4.5), RECALIBRATING, VALID, [K.DRIFT], True),
    ],
    "a start without an image": [
        (BLACK, ACQUIRING, UNKNOWN, [], False),
        *[(BLACK, ACQUIRING, UNKNOWN, [], False)] * 3,
        (BLACK, ACQUIRING, UNKNOWN, [K.IMAGE], False),
        (BLACK, ACQUIRING, UNKNOWN, [], False),
        (seen(), ACQUIRING, SUSPECT, [K.RECOVERED], False),
        (seen(), TRACKING, VALID, [], False),
    ],
    "a start without a gripper": [
        *[(HIDDEN, ACQUIRING, UNKNOWN, [], False)] * 20,
        (seen(), ACQUIRING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
    ],
    "a short occlusion: held, confirmed, no more than one alert": [
        (seen(), ACQUIRING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
        (HIDDEN, OCCLUDED, SUSPECT, [K.OCCLUDED], False),
        (HIDDEN, OCCLUDED, SUSPECT, [], False),
        (seen(), OCCLUDED, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
    ],
    "a long occlusion: held, lost, found": [
        (seen(), ACQUIRING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
        (HIDDEN, OCCLUDED, SUSPECT, [K.OCCLUDED], False),
        *[(HIDDEN, OCCLUDED, SUSPECT, [], False)] * 8,  # one second and no longer
        (HIDDEN, LOST, UNKNOWN, [K.LOST], False),
        *[(HIDDEN, LOST, UNKNOWN, [], False)] * 30,
        (seen(), ACQUIRING, SUSPECT, [K.RECOVERED], False),
        (seen(), TRACKING, VALID, [], False),
    ],
    "refused frames: the state stays, the image is reported once, only time makes it lost": [
        (seen(), ACQUIRING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
        *[(BLACK, TRACKING, SUSPECT, [], False)] * 4,
        (BLACK, TRACKING, SUSPECT, [K.IMAGE], False),
        *[(BLACK, TRACKING, SUSPECT, [], False)] * 4,
        (BLACK, LOST, UNKNOWN, [K.LOST], False),
        (BLACK, LOST, UNKNOWN, [], False),
        (seen(), ACQUIRING, SUSPECT, [K.RECOVERED], False),
        (seen(), TRACKING, VALID, [], False),
    ],
    "one refused frame: back at once": [
        (seen(), ACQUIRING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
        (BLACK, TRACKING, SUSPECT, [], False),
        (seen(), TRACKING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
    ],
    "a jump within the limit: suspect until confirmed, then a drift": [
        (seen(), ACQUIRING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(1.0, jumped=True), TRACKING, SUSPECT, [K.JUMP], False),
        *[(seen(1.0), TRACKING, VALID, [], False)] * 3,
        (seen(1.0), DRIFTING, VALID, [K.DRIFT], False),
        (seen(1.0), DRIFTING, VALID, [], False),
    ],
    "a jump past the limit: recalibrates when it has stood still for four frames": [
        (seen(), ACQUIRING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(4.5, jumped=True), RECALIBRATING, SUSPECT, [K.JUMP], False),
        (seen(4.5), RECALIBRATING, VALID, [], False),
        (seen(4.8), RECALIBRATING, VALID, [], False),  # it still rings
        (seen(4.4), RECALIBRATING, VALID, [], False),
        (seen(4.5), RECALIBRATING, VALID, [K.DRIFT], False),
        (seen(4.51), RECALIBRATING, VALID, [], False),
        (seen(4.5), RECALIBRATING, VALID, [], False),
        (seen(4.5), RECALIBRATING, VALID, [], True),
        (seen(4.5), RECALIBRATING, VALID, [], True),
    ],
    "two jumps": [
        (seen(), ACQUIRING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(1.0, jumped=True), TRACKING, SUSPECT, [K.JUMP], False),
        (seen(jumped=True), TRACKING, SUSPECT, [K.JUMP], False),
        (seen(), TRACKING, VALID, [], False),
    ],
    "a turn past the limit without a shift": [
        (seen(), ACQUIRING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(turn_rad=0.021), RECALIBRATING, VALID, [], False),
        (seen(turn_rad=0.019), TRACKING, VALID, [], False),
    ],
}  # fmt: skip


@pytest.mark.parametrize("table", TABLES.values(), ids=list(TABLES))
def test_tables(table: list[Row]):
    run = Run()
    for number, (frame, state, verdict, alerts, recalibrate) in enumerate(table):
        judgement = run.feed(frame)
        assert (judgement.state, judgement.verdict, [a.kind for a in judgement.alerts], judgement.recalibrate) == (
            state,
            verdict,
            alerts,
            recalibrate,
        ), f"row {number}"


def test_a_drift_is_alerted_once_and_ends_with_one_more_alert():
    run = settled()
    away = run.feed_all([seen(0.3)] * 200)
    assert kinds(away) == [K.DRIFT]
    assert all(j.verdict is VALID for j in away), "the transform itself is corrected"
    first = next(i for i, j in enumerate(away) if j.state is DRIFTING)
    assert all(j.state is DRIFTING for j in away[first:])
    back = run.feed_all([seen()] * 200)
    assert kinds(back) == [K.RECOVERED]
    assert back[-1].state is TRACKING


def test_past_the_limit_the_drift_alert_is_an_error_that_says_how_far():
    within, beyond = settled(), settled()
    [warning] = [a for j in within.feed_all([seen(0.3)] * 20) for a in j.alerts]
    [error] = [a for j in beyond.feed_all([seen(-3.0)] * 20) for a in j.alerts]
    assert (warning.kind, warning.severity, warning.cause) == (K.DRIFT, Severity.WARNING, Cause.CAMERA_MOUNT)
    assert (error.kind, error.severity) == (K.DRIFT, Severity.ERROR)
    assert "+0.300" in warning.text
    assert "-3.000" in error.text and "past the limit" in error.text


def test_after_a_recalibration_drift_is_reckoned_from_zero():
    run = settled()
    assert run.feed_all([seen(4.5, jumped=True)] + [seen(4.5)] * 5)[-1].recalibrate
    alert = run.policy.recalibrated("moved by 4.5 mm")
    assert (alert.kind, alert.text) == (K.RECALIBRATED, "moved by 4.5 mm")
    after = run.feed_all([seen()] * 100)
    assert kinds(after) == [], "the old drift is not said to be gone"
    assert {j.state for j in after} == {TRACKING}
    assert kinds(run.feed_all([seen(0.3)] * 20)) == [K.DRIFT]


def test_without_recalibration_past_the_limit_is_a_drift_for_ever():
    run = settled(msgspec.structs.replace(SETTINGS, recalibrate=False))
    judgements = run.feed_all([seen(4.5, jumped=True)] + [seen(4.5)] * 50)
    assert not any(j.recalibrate for j in judgements)
    assert judgements[-1].state is DRIFTING
    assert kinds(judgements) == [K.JUMP, K.DRIFT]


def test_a_slow_creep_past_the_limit_recalibrates_only_when_it_stops():
    run = settled()
    creeping = run.feed_all([seen(x) for x in np.arange(0.0, 6.0, 0.06)])
    assert not any(j.recalibrate for j in creeping)
    assert run.feed_all([seen(6.0)] * 5)[-1].recalibrate


def test_an_uncertain_transform_is_suspect():
    run = settled()
    wide = np.array([4e-6, 4e-6, 3.1e-4, 3e-4, 3e-4, 1e-4])
    assert run.feed(seen(sigma=wide)).verdict is SUSPECT
    assert run.feed(seen(sigma=wide * 0.9)).verdict is VALID


def test_every_second_frame_hidden_is_never_lost_and_never_valid():
    run = settled()
    judgements = run.feed_all([HIDDEN, seen()] * 50)
    assert {j.verdict for j in judgements} == {SUSPECT}
    assert K.LOST not in kinds(judgements)
    assert kinds(judgements) == [K.OCCLUDED]


def test_a_gripper_that_is_found_for_one_frame_only_is_lost_again_and_says_so():
    run = settled()
    assert run.feed_all([HIDDEN] * 20)[-1].state is LOST
    assert kinds([run.feed(seen())]) == [K.RECOVERED]
    again = run.feed_all([HIDDEN] * 20)
    assert again[-1].state is LOST
    assert again[-1].verdict is UNKNOWN
    assert K.LOST in kinds(again)


def test_frames_that_are_refused_while_hidden_do_not_restart_the_clock():
    run = settled()
    judgements = run.feed_all([HIDDEN, BLACK] * 10)
    assert [j.state for j in judgements].index(LOST) == 9
    assert sorted(kinds(judgements)) == sorted([K.OCCLUDED, K.IMAGE, K.LOST])


def test_the_alert_about_a_lost_gripper_tells_images_from_views():
    for nothing, cause in ((HIDDEN, Cause.VIEW_BLOCKED), (BLACK, Cause.IMAGE_BAD)):
        alerts = [a for j in settled().feed_all([nothing] * 15) for a in j.alerts]
        [lost] = [a for a in alerts if a.kind is K.LOST]
        assert lost.cause is cause and lost.severity is Severity.ERROR
        [*_, last] = [a for a in alerts if a.kind in (K.OCCLUDED, K.IMAGE)]
        assert last.cause is cause


def test_a_held_transform_grows_less_certain_with_time():
    policy = Policy(PolicySettings(hold_m_per_sqrt_s=2e-4, hold_rad_per_sqrt_s=3e-3))
    np.testing.assert_array_equal(policy.hold_variance(0.0), np.zeros(6))
    np.testing.assert_allclose(policy.hold_variance(0.25), [1e-8] * 3 + [2.25e-6] * 3)
    # A random walk: variances of two spans add up.
    np.testing.assert_allclose(policy.hold_variance(0.7) + policy.hold_variance(0.3), policy.hold_variance(1.0))


# --- the drift test ---


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


def test_the_sums_are_those_of_page():
    rng = np.random.default_rng(1)
    sigma = SMALLEST * [0.5, 1.0, 2.0, 0.7, 1.0, 1.5]
    shifts = rng.normal(size=(600, 6)) * sigma
    shifts[300:, 1] += 0.4 * SMALLEST[1]
    shifts[450:, 4] -= 1.2 * SMALLEST[4]
    test = DriftTest(SETTINGS)
    expected = cusum(shifts, sigma, SMALLEST, 0.2 * test.threshold).max(axis=(1, 2)) >= test.threshold
    first = int(expected.argmax())
    assert 450 < first < 560, "the trial has an alarm"
    assert [test.add(shift, sigma) for shift in shifts[: first + 1]] == [False] * first + [True]


def test_the_threshold_is_the_bound_for_the_tolerated_alarms_a_day():
    """Lorden: each of twelve sums alarms once in exp(h) frames at most."""
    for rate, fps in ((0.01, 60.0), (1.0, 25.0)):
        test = DriftTest(PolicySettings(false_alarms_per_day=rate, frames_per_s=fps))
        assert 12.0 * fps * 86400.0 / np.exp(test.threshold) == pytest.approx(rate)


@pytest.mark.parametrize("relative", [1.0, 2.0])
def test_white_noise_alarms_no_more_often_than_stated(relative: float):
    """One alarm in 86 frames is tolerated here; the bound must hold, and not by orders of magnitude."""
    settings = PolicySettings(false_alarms_per_day=1000.0, frames_per_s=1.0)
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
    test = DriftTest(PolicySettings())
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
    run = settled(PolicySettings())
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
    test = DriftTest(PolicySettings())
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
    run = settled(PolicySettings(suspect_sigma_m=1.0))
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
