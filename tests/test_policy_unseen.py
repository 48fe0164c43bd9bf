"""The policy while nothing is measured: held, lost, found; and how much less a held transform is worth."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.policy_runs import (
    BENT,
    BEYOND,
    BLACK,
    BOUNDED,
    CLEARED,
    HIDDEN,
    LOST,
    PERIOD_S,
    RAISED,
    SETTINGS,
    SUSPECT,
    TRACKING,
    UNKNOWN,
    UPDATED,
    VALID,
    Nothing,
    Run,
    alerts_of,
    explained,
    kinds,
    seen,
    settled,
)

from gripmon.judge.policy import Evidence, Policy, PolicySettings
from gripmon.model.records import NOTHING_WRONG, AlertKind, Cause, Protection, Verdict

K = AlertKind


def test_a_transform_is_suspect_while_its_error_may_exceed_an_alert_limit():
    """At the limit it is valid still; the covariance has no say, nor whether the mount moved."""
    run = settled()
    limit_m, limit_rad = SETTINGS.alert_limit_m, SETTINGS.alert_limit_rad

    def judged(position_m: float, rotation_rad: float) -> tuple[Verdict, str | None]:
        bound = Protection(position_m, rotation_rad, 1e-5, "edge a belongs to something else")
        judgement = run.feed(seen(protection=bound))
        return judgement.verdict, judgement.reason

    assert judged(limit_m, limit_rad) == (VALID, None)
    verdict, reason = judged(1.05 * limit_m, 1e-3)
    assert verdict is SUSPECT and reason is not None
    off, why = reason.split("; ")
    assert off == "the TCP may be 1.1 mm off, alert limit 1 mm"
    assert why == "it can't be excluded that edge a belongs to something else"
    verdict, reason = judged(1e-4, 1.05 * limit_rad)
    assert verdict is SUSPECT and reason is not None and reason.startswith("the rotation may be")
    itself = run.feed(seen(protection=Protection(0.5, 1e-3, 1e-5, NOTHING_WRONG))).reason
    assert itself == "it isn't determined how far the TCP is off, alert limit 1 mm; too little of the gripper is seen"
    for far in ((0.452, 1e-3), (math.nan, 1e-3), (1e-4, 1.7)):
        reason = judged(*far)[1] or ""
        assert reason.startswith("it isn't determined how far the "), (
            "the figure would be of the prior, not of the image"
        )
    assert judged(math.nan, 1e-3)[0] is SUSPECT and judged(1e-4, math.nan)[0] is SUSPECT, "NaN bounds nothing"
    assert run.feed(seen(protection=None)).verdict is SUSPECT
    assert run.feed(seen(sigma=np.full(6, 0.1))).verdict is VALID, "bounds count, which are made of covariances"


def test_a_place_that_nothing_proves_any_more_is_told_after_as_long_as_a_transform_is_held():
    """Knocked along its fingers, or hidden: frames are suspect, and the state goes on to be ``tracking``."""
    run, doubted = settled(), seen(protection=BEYOND, unproven=True)
    frames = round(SETTINGS.hold_s / PERIOD_S)
    assert kinds(run.feed_all([doubted] * frames)) == [], "an ordinary grasp hides the ends for a moment"
    since_s = run.now_s - (frames - 1) * PERIOD_S
    [alert] = run.feed(doubted).alerts
    assert (alert.kind, alert.event, alert.cause, alert.severity) == (K.OCCLUDED, RAISED, Cause.UNKNOWN, "warning")
    assert f"not been seen where they should be since {since_s:.1f} s of the images' clock" in alert.text
    assert kinds(run.feed_all([doubted, HIDDEN] * 8)) == [], "it is the same"
    cleared = run.feed_all([seen()] * 4)
    assert kinds(cleared) == [(K.OCCLUDED, CLEARED)] and cleared[-1].state is TRACKING


@pytest.mark.parametrize("protection", [BOUNDED, BEYOND], ids=["within the limit", "beyond it"])
def test_a_gripper_that_stands_elsewhere_unproven_is_told_with_its_way(protection: Protection):
    """Seconds of it went untold while the bound, which reaches to where it was, was within the limit now and then."""
    run = settled()
    away = [seen(2.5, present=False, believed=False, unproven=True, protection=p) for p in (protection, BOUNDED)]
    frames = round(SETTINGS.hold_s / PERIOD_S)
    told = alerts_of(run.feed_all([*away] * frames))
    [alert] = told
    assert (alert.kind, alert.event, alert.cause, alert.severity) == (K.OCCLUDED, RAISED, Cause.UNKNOWN, "warning")
    assert alert.text.startswith("the gripper has been seen elsewhere since 100.5 s of the images' clock")
    assert "at 101.5 s of the images' clock the TCP was +2.500 +0.000 +0.000 mm" in alert.text
    assert kinds(run.feed_all([seen(where_it_was=True, believed=False)] * 4)) == [(K.OCCLUDED, CLEARED)]


def test_hidden_fingers_that_show_without_their_ends_are_told_as_that():
    """What was said of an older frame doesn't hold: edges are seen again, and they prove nothing."""
    run, doubted = settled(), seen(protection=BEYOND, unproven=True)
    run.feed_all([HIDDEN] * 3)
    told = alerts_of(run.feed_all([doubted, HIDDEN] * 20))
    assert {alert.kind for alert in told} == {K.OCCLUDED} and {alert.event for alert in told} == {UPDATED}
    assert len(told) == 1 and "not been seen where they should be" in told[0].text


@pytest.mark.parametrize(
    "between", [seen(), seen(protection=BEYOND), seen(unproven=True)], ids=["valid", "proven", "bounded"]
)
def test_what_is_proven_or_bounded_now_and_then_is_no_news(between: Evidence):
    run, doubted = settled(), seen(protection=BEYOND, unproven=True)
    stretch = [doubted] * round(SETTINGS.hold_s / PERIOD_S)
    assert kinds(run.feed_all([*stretch, between] * 5)) == []


def test_every_second_frame_hidden_is_never_lost_and_never_valid():
    run = settled()
    judgements = run.feed_all([HIDDEN, seen()] * 50)
    assert {j.verdict for j in judgements} == {SUSPECT}
    assert kinds(judgements) == [(K.OCCLUDED, RAISED)]


def test_a_gripper_that_is_found_for_one_frame_only_was_never_back():
    run = settled()
    assert run.feed_all([HIDDEN] * 20)[-1].state is LOST
    assert kinds([run.feed(seen())]) == []
    again = run.feed_all([HIDDEN] * 20)
    assert again[-1].state is LOST
    assert again[-1].verdict is UNKNOWN
    assert kinds(again) == []
    assert kinds(run.feed_all([seen()] * 4)) == [(K.LOST, CLEARED)]
    assert kinds(run.feed_all([HIDDEN] * 20)) == [(K.OCCLUDED, RAISED), (K.LOST, UPDATED)]


def test_lost_is_not_over_while_every_second_frame_is_hidden():
    run = settled()
    assert run.feed_all([HIDDEN] * 20)[-1].state is LOST
    assert kinds(run.feed_all([seen(), HIDDEN] * 20)) == []
    assert kinds(run.feed_all([seen()] * 3)) == [(K.LOST, CLEARED)]


def test_frames_that_are_refused_while_hidden_do_not_restart_the_clock():
    run = settled()
    judgements = run.feed_all([HIDDEN, BLACK] * 8)
    assert [j.state for j in judgements].index(LOST) == 8
    told = kinds(judgements)
    assert told.count((K.OCCLUDED, RAISED)) == told.count((K.IMAGE, RAISED)) == 1
    assert set(told) == {(K.OCCLUDED, RAISED), (K.IMAGE, RAISED), (K.LOST, UPDATED)}
    assert len(told) <= 4, "lost, and once more that images are bad, too"


def test_the_alert_about_a_lost_gripper_tells_images_from_views():
    blocked = Nothing(explanation=explained(Cause.VIEW_BLOCKED))
    for nothing, cause in ((HIDDEN, Cause.UNKNOWN), (blocked, Cause.VIEW_BLOCKED), (BLACK, Cause.IMAGE_BAD)):
        alerts = [a for j in settled().feed_all([nothing] * 15) for a in j.alerts]
        [lost] = [a for a in alerts if a.kind is K.LOST]
        assert lost.cause is cause and lost.severity == "error"
        [*_, last] = [a for a in alerts if a.kind in (K.OCCLUDED, K.IMAGE)]
        assert last.cause is cause


def test_a_gripper_never_seen_is_not_said_to_be_hidden():
    [lost] = [a for j in Run().feed_all([HIDDEN] * 15) for a in j.alerts]
    assert (lost.kind, lost.cause) == (K.LOST, Cause.UNKNOWN)


def test_why_the_gripper_is_not_seen_is_said_where_it_is_known():
    hidden = Nothing(explanation=BENT)
    [alert] = settled().feed(hidden).alerts
    assert (alert.kind, alert.cause, alert.part, alert.causes) == (K.OCCLUDED, Cause.FINGER_BENT, "left", BENT.causes)
    assert BENT.text in alert.text


@pytest.mark.parametrize("cause", [Cause.CAMERA_MOUNT, Cause.JAW_OPENING])
def test_what_has_moved_before_does_not_hide_the_gripper(cause: Cause):
    """A hand before a camera that was knocked a moment ago."""
    run = settled()
    run.feed_all([seen(1.0, explanation=explained(cause))] * 3)
    occluded = [a for j in run.feed_all([Nothing(explanation=explained(cause))] * 15) for a in j.alerts]
    assert {a.kind for a in occluded} == {K.OCCLUDED, K.LOST}
    assert all((a.cause, a.causes) == (Cause.UNKNOWN, ()) and str(cause) not in a.text for a in occluded)


def test_a_held_transform_grows_less_certain_with_time():
    policy = Policy(PolicySettings(hold_m_per_sqrt_s=2e-4, hold_rad_per_sqrt_s=3e-3))
    np.testing.assert_array_equal(policy.hold_variance(0.0), np.zeros(6))
    np.testing.assert_allclose(policy.hold_variance(0.25), [1e-8] * 3 + [2.25e-6] * 3)
    # A random walk: variances of two spans add up.
    np.testing.assert_allclose(policy.hold_variance(0.7) + policy.hold_variance(0.3), policy.hold_variance(1.0))
