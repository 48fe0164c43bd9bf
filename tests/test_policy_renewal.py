"""The policy past the limit: when it asks for a new reference, and what becomes of its alerts then."""

from __future__ import annotations

import numpy as np
from support.policy_runs import (
    CLEARED,
    DRIFTING,
    KNOCKED,
    RAISED,
    SUSPECT,
    TRACKING,
    Run,
    alerts_of,
    explained,
    kinds,
    seen,
    settled,
    told,
)

from gripmon.model.records import AlertKind, Cause

K = AlertKind


def past_the_limit() -> Run:
    run = settled()
    assert run.feed_all([seen(4.5, jumped=True, present=False)] + [seen(4.5)] * 4)[-1].recalibrate
    return run


def test_a_new_reference_ends_what_was_said_of_the_motion():
    run = past_the_limit()
    [over] = run.policy.recalibrated(run.now_s)
    assert (over.kind, over.event) == (K.STEP, CLEARED)
    assert not run.policy.drifting
    after = run.feed_all([seen()] * 20)
    assert kinds(after) == [], "the old drift is not said to be gone again"
    assert {j.state for j in after} == {TRACKING}
    assert kinds([run.feed(seen(0.3))]) == [(K.STEP, RAISED)]


def test_a_refusal_is_told_once_and_cleared_with_the_reason_for_it():
    run = past_the_limit()
    [refused] = run.policy.refused("the corners lie on a line", KNOCKED, run.now_s, run.stamp_ns)
    run.policy.not_recalibrated()
    assert (refused.kind, refused.event, refused.severity) == (K.REFUSED, RAISED, "error")
    assert "the corners lie on a line" in refused.text and refused.cause is Cause.CAMERA_MOUNT
    waiting = run.feed_all([seen(4.5)] * 3)
    assert not any(j.recalibrate for j in waiting), "tried again only after as many still frames"
    assert run.feed(seen(4.5)).recalibrate
    assert run.policy.refused("the corners lie on a line", KNOCKED, run.now_s, run.stamp_ns) == ()
    back = [event for event in kinds(run.feed_all([seen(1.0)] * 3)) if event[0] is K.REFUSED]
    assert back == [(K.REFUSED, CLEARED)]


def test_a_refusal_ends_when_there_is_a_new_reference_after_all():
    run = past_the_limit()
    run.policy.refused("no", KNOCKED, run.now_s, run.stamp_ns)
    assert told(run.policy.recalibrated(run.now_s)) == [(K.STEP, CLEARED), (K.REFUSED, CLEARED)]


def test_a_proposal_stays_until_somebody_decides():
    run = past_the_limit()
    [proposed] = run.policy.proposed("accept?", KNOCKED, run.now_s, run.stamp_ns)
    assert (proposed.kind, proposed.event, proposed.severity) == (K.PROPOSED, RAISED, "warning")
    assert run.policy.proposed("accept?", KNOCKED, run.now_s, run.stamp_ns) == ()
    run.feed_all([seen()] * 20)
    assert run.policy.alerts.about("renewal") is not None, "though the camera is back, it waits for its answer"
    [decided] = run.policy.decided("rejected", run.now_s)
    assert (decided.kind, decided.event, decided.text) == (K.PROPOSED, CLEARED, "rejected")
    assert decided.alert_id == proposed.alert_id
    assert run.policy.decided("rejected", run.now_s) == ()


def test_without_recalibration_past_the_limit_is_a_drift_for_ever():
    run = settled(may_recalibrate=False)
    judgements = run.feed_all([seen(4.5, jumped=True, present=False)] + [seen(4.5)] * 50)
    assert not any(j.recalibrate for j in judgements)
    assert {j.state for j in judgements[1:]} == {DRIFTING}
    assert kinds(judgements) == [(K.STEP, RAISED)]


def test_another_camera_is_neither_trusted_nor_made_the_reference():
    run = settled()
    judgements = run.feed_all([seen(4.5, explanation=explained(Cause.CAMERA_REPLACED))] * 10)
    assert {(j.state, j.verdict, j.recalibrate) for j in judgements} == {(DRIFTING, SUSPECT, False)}
    assert kinds(judgements) == [(K.STEP, RAISED)]
    assert alerts_of(judgements)[0].cause is Cause.CAMERA_REPLACED


def test_a_slow_creep_past_the_limit_recalibrates_only_when_it_stops():
    run = settled()
    creeping = run.feed_all([seen(x) for x in np.arange(0.0, 6.0, 0.06)])
    assert not any(j.recalibrate for j in creeping)
    assert run.feed_all([seen(6.0)] * 5)[-1].recalibrate
