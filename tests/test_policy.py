"""The policy as tables of frames and judgements."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from policy_runs import (
    ACQUIRING,
    BLACK,
    DRIFTING,
    HIDDEN,
    LOST,
    OCCLUDED,
    RECALIBRATING,
    SETTINGS,
    SUSPECT,
    TRACKING,
    UNKNOWN,
    VALID,
    Nothing,
    Run,
    kinds,
    seen,
    settled,
)

from gripmon.policy import Evidence, Policy, PolicySettings
from gripmon.records import AlertKind, Cause, Severity, State, Verdict

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
        (seen(), ACQUIRING, SUSPECT, [], False),
        *[(seen(), TRACKING, VALID, [], False)] * 2,
        (seen(), TRACKING, VALID, [K.RECOVERED], False),
    ],
    "a start without a gripper": [
        *[(HIDDEN, ACQUIRING, UNKNOWN, [], False)] * 9,  # one second and no longer
        (HIDDEN, LOST, UNKNOWN, [K.LOST], False),
        *[(HIDDEN, LOST, UNKNOWN, [], False)] * 10,
        (seen(), ACQUIRING, SUSPECT, [], False),
        *[(seen(), TRACKING, VALID, [], False)] * 2,
        (seen(), TRACKING, VALID, [K.RECOVERED], False),
    ],
    "a short occlusion: held, confirmed, no more than one alert": [
        (seen(), ACQUIRING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
        (HIDDEN, OCCLUDED, SUSPECT, [K.OCCLUDED], False),
        (HIDDEN, OCCLUDED, SUSPECT, [], False),
        (seen(), OCCLUDED, SUSPECT, [], False),
        *[(seen(), TRACKING, VALID, [], False)] * 2,
        (seen(), TRACKING, VALID, [K.RECOVERED], False),
        (HIDDEN, OCCLUDED, SUSPECT, [K.OCCLUDED], False),
    ],
    "a view that comes and goes: told once": [
        (seen(), ACQUIRING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
        (HIDDEN, OCCLUDED, SUSPECT, [K.OCCLUDED], False),
        *[
            (seen(), OCCLUDED, SUSPECT, [], False),
            (seen(), TRACKING, VALID, [], False),
            (HIDDEN, OCCLUDED, SUSPECT, [], False),
        ] * 5,
    ],
    "a long occlusion: held, lost, found": [
        (seen(), ACQUIRING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
        (HIDDEN, OCCLUDED, SUSPECT, [K.OCCLUDED], False),
        *[(HIDDEN, OCCLUDED, SUSPECT, [], False)] * 7,  # one second and no longer
        (HIDDEN, LOST, UNKNOWN, [K.LOST], False),
        *[(HIDDEN, LOST, UNKNOWN, [], False)] * 30,
        (seen(), ACQUIRING, SUSPECT, [], False),
        *[(seen(), TRACKING, VALID, [], False)] * 2,
        (seen(), TRACKING, VALID, [K.RECOVERED], False),
    ],
    "refused frames: the state stays, the image is reported once, only time makes it lost": [
        (seen(), ACQUIRING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
        *[(BLACK, TRACKING, SUSPECT, [], False)] * 4,
        (BLACK, TRACKING, SUSPECT, [K.IMAGE], False),
        *[(BLACK, TRACKING, SUSPECT, [], False)] * 3,
        (BLACK, LOST, UNKNOWN, [K.LOST], False),
        (BLACK, LOST, UNKNOWN, [], False),
        (seen(), ACQUIRING, SUSPECT, [], False),
        *[(seen(), TRACKING, VALID, [], False)] * 2,
        (seen(), TRACKING, VALID, [K.RECOVERED], False),
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
        (seen(1.0, jumped=True), TRACKING, SUSPECT, [K.STEP], False),
        *[(seen(1.0), TRACKING, VALID, [], False)] * 3,
        (seen(1.0), DRIFTING, VALID, [K.DRIFT], False),
        (seen(1.0), DRIFTING, VALID, [], False),
    ],
    "a jump past the limit: recalibrates when it has stood still for four frames": [
        (seen(), ACQUIRING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(4.5, jumped=True), RECALIBRATING, SUSPECT, [K.STEP], False),
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
        (seen(1.0, jumped=True), TRACKING, SUSPECT, [K.STEP], False),
        (seen(jumped=True), TRACKING, SUSPECT, [K.STEP], False),
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
    assert kinds(judgements) == [K.STEP, K.DRIFT]


def test_a_slow_creep_past_the_limit_recalibrates_only_when_it_stops():
    run = settled()
    creeping = run.feed_all([seen(x) for x in np.arange(0.0, 6.0, 0.06)])
    assert not any(j.recalibrate for j in creeping)
    assert run.feed_all([seen(6.0)] * 5)[-1].recalibrate


def test_an_uncertain_transform_is_suspect():
    run = settled()
    wide = np.array([4e-6, 4e-6, 1.05e-4, 3e-4, 3e-4, 1e-4])
    assert run.feed(seen(sigma=wide)).verdict is SUSPECT
    assert run.feed(seen(sigma=wide * 0.9)).verdict is VALID


def test_every_second_frame_hidden_is_never_lost_and_never_valid():
    run = settled()
    judgements = run.feed_all([HIDDEN, seen()] * 50)
    assert {j.verdict for j in judgements} == {SUSPECT}
    assert K.LOST not in kinds(judgements)
    assert kinds(judgements) == [K.OCCLUDED]


def test_a_gripper_that_is_found_for_one_frame_only_was_never_back():
    run = settled()
    assert run.feed_all([HIDDEN] * 20)[-1].state is LOST
    assert kinds([run.feed(seen())]) == []
    again = run.feed_all([HIDDEN] * 20)
    assert again[-1].state is LOST
    assert again[-1].verdict is UNKNOWN
    assert kinds(again) == []
    assert kinds(run.feed_all([seen()] * 4)) == [K.RECOVERED]
    assert kinds(run.feed_all([HIDDEN] * 20)) == [K.OCCLUDED, K.LOST]


def test_frames_that_are_refused_while_hidden_do_not_restart_the_clock():
    run = settled()
    judgements = run.feed_all([HIDDEN, BLACK] * 10)
    assert [j.state for j in judgements].index(LOST) == 8
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


# --- an inexact reference ---

INEXACT = np.array([2e-4] * 3 + [5e-3] * 3)


def test_the_error_of_an_inexact_reference_is_no_drift_but_what_comes_on_top_is():
    run = Run(reference_sigma=INEXACT)
    assert kinds(run.feed_all([seen(0.3)] * 100)) == []
    assert kinds(run.feed_all([seen(0.5)] * 20)) == [K.DRIFT]
    assert kinds(run.feed_all([seen(0.3)] * 100)) == [K.RECOVERED]


def test_a_shift_that_the_references_uncertainty_does_not_explain_is_a_drift():
    run = Run(reference_sigma=0.1 * INEXACT)
    assert kinds(run.feed_all([seen(0.3)] * 40)) == [K.DRIFT]


def test_a_new_reference_is_not_corrected_for_the_error_of_the_old_one():
    run = Run(reference_sigma=INEXACT)
    run.feed_all([seen(0.3)] * 20)
    assert run.feed_all([seen(4.5, jumped=True)] + [seen(4.5)] * 5)[-1].recalibrate
    run.policy.recalibrated("moved")
    assert kinds(run.feed_all([seen()] * 100)) == []
