"""The policy as tables: what is seen -> state, verdict, alerts with their events, and whether to recalibrate."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from policy_runs import (
    ACQUIRING,
    BLACK,
    CLEARED,
    DRIFTING,
    HIDDEN,
    LOST,
    OCCLUDED,
    RAISED,
    RECALIBRATING,
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
    told,
)

from gripmon.policy import Evidence, Policy, PolicySettings
from gripmon.records import AlertEvent, AlertKind, Cause, State, Verdict, Vibration

K = AlertKind
Told = list[tuple[AlertKind, AlertEvent]]
Row = tuple[Evidence | Nothing, State, Verdict, Told, bool]

START: list[Row] = [(seen(), ACQUIRING, SUSPECT, [], False), (seen(), TRACKING, VALID, [], False)]
HUMMING = Vibration(2e-4, 12.0)
BENT = explained(Cause.FINGER_BENT, "left")
WRONG_JAW, REFOCUSED = explained(Cause.JAW_OPENING), explained(Cause.LENS)
KNOCKED = explained(Cause.CAMERA_MOUNT)

TABLES: dict[str, list[Row]] = {
    "a start: the second frame that agrees makes it valid": [*START, (seen(), TRACKING, VALID, [], False)],
    "a start on a camera that was moved before: measured anew when it has stood still, whatever the test says": [
        (seen(4.5, jumped=True, present=False), ACQUIRING, SUSPECT, [], False),
        (seen(4.5, present=False), RECALIBRATING, VALID, [], False),
        (seen(4.5, present=False), RECALIBRATING, VALID, [], False),
        (seen(4.5, present=False), RECALIBRATING, VALID, [], True),
        (seen(4.5), RECALIBRATING, VALID, [(K.STEP, RAISED)], True),
    ],
    "a start without an image": [
        *[(BLACK, ACQUIRING, UNKNOWN, [], False)] * 4,
        (BLACK, ACQUIRING, UNKNOWN, [(K.IMAGE, RAISED)], False),
        (BLACK, ACQUIRING, UNKNOWN, [], False),
        (seen(), ACQUIRING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(), TRACKING, VALID, [(K.IMAGE, CLEARED)], False),
        (seen(), TRACKING, VALID, [], False),
    ],
    "a start without a gripper": [
        *[(HIDDEN, ACQUIRING, UNKNOWN, [], False)] * 9,  # one second and no longer
        (HIDDEN, LOST, UNKNOWN, [(K.LOST, RAISED)], False),
        *[(HIDDEN, LOST, UNKNOWN, [], False)] * 10,
        (seen(), ACQUIRING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(), TRACKING, VALID, [(K.LOST, CLEARED)], False),
    ],
    "a short occlusion: held, confirmed, cleared": [
        *START,
        (HIDDEN, OCCLUDED, SUSPECT, [(K.OCCLUDED, RAISED)], False),
        (HIDDEN, OCCLUDED, SUSPECT, [], False),
        (seen(), OCCLUDED, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(), TRACKING, VALID, [(K.OCCLUDED, CLEARED)], False),
        (HIDDEN, OCCLUDED, SUSPECT, [(K.OCCLUDED, RAISED)], False),
    ],
    "a view that comes and goes: told once, cleared once": [
        *START,
        (HIDDEN, OCCLUDED, SUSPECT, [(K.OCCLUDED, RAISED)], False),
        *[
            (seen(), OCCLUDED, SUSPECT, [], False),
            (seen(), TRACKING, VALID, [], False),
            (HIDDEN, OCCLUDED, SUSPECT, [], False),
        ] * 5,
        (seen(), OCCLUDED, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(), TRACKING, VALID, [(K.OCCLUDED, CLEARED)], False),
    ],
    "a long occlusion: held, lost (the same alert, worse), found": [
        *START,
        (HIDDEN, OCCLUDED, SUSPECT, [(K.OCCLUDED, RAISED)], False),
        *[(HIDDEN, OCCLUDED, SUSPECT, [], False)] * 7,  # one second and no longer
        (HIDDEN, LOST, UNKNOWN, [(K.LOST, UPDATED)], False),
        *[(HIDDEN, LOST, UNKNOWN, [], False)] * 30,
        (seen(), ACQUIRING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(), TRACKING, VALID, [(K.LOST, CLEARED)], False),
    ],
    "refused frames: the state stays, the image is reported once, only time makes it lost": [
        *START,
        *[(BLACK, TRACKING, SUSPECT, [], False)] * 4,
        (BLACK, TRACKING, SUSPECT, [(K.IMAGE, RAISED)], False),
        *[(BLACK, TRACKING, SUSPECT, [], False)] * 3,
        (BLACK, LOST, UNKNOWN, [(K.LOST, RAISED)], False),
        (BLACK, LOST, UNKNOWN, [], False),
        (seen(), ACQUIRING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(), TRACKING, VALID, [(K.LOST, CLEARED), (K.IMAGE, CLEARED)], False),
    ],
    "one refused frame: back at once": [
        *START,
        (BLACK, TRACKING, SUSPECT, [], False),
        (seen(), TRACKING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
    ],
    "a jump within the limit: suspect until confirmed, a drift when the test has found it": [
        *START,
        (seen(1.0, jumped=True, present=False), TRACKING, SUSPECT, [], False),
        (seen(1.0), DRIFTING, VALID, [(K.STEP, RAISED)], False),
        *[(seen(1.0), DRIFTING, VALID, [], False)] * 20,
    ],
    "one wild frame: not a word": [
        *START,
        (seen(1.0, jumped=True, present=False), TRACKING, SUSPECT, [], False),
        (seen(jumped=True), TRACKING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
    ],
    "a drift that goes: cleared when it has been gone for long enough, not before": [
        *START,
        (seen(0.3), DRIFTING, VALID, [(K.STEP, RAISED)], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(0.3), DRIFTING, VALID, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(), TRACKING, VALID, [(K.STEP, CLEARED)], False),
        (seen(0.3), DRIFTING, VALID, [(K.STEP, RAISED)], False),
    ],
    "a jump past the limit: recalibrates when it has stood still for four frames": [
        *START,
        (seen(4.5, jumped=True, present=False), RECALIBRATING, SUSPECT, [], False),
        (seen(4.5), RECALIBRATING, VALID, [(K.STEP, RAISED)], False),
        (seen(4.8), RECALIBRATING, VALID, [], False),  # it still rings
        (seen(4.4), RECALIBRATING, VALID, [], False),
        (seen(4.5), RECALIBRATING, VALID, [], False),
        (seen(4.51), RECALIBRATING, VALID, [], False),
        (seen(4.5), RECALIBRATING, VALID, [], False),
        (seen(4.5), RECALIBRATING, VALID, [], True),
        (seen(4.5), RECALIBRATING, VALID, [], True),
    ],
    "a turn past the limit without a shift": [
        *START,
        (seen(turn_rad=0.021), RECALIBRATING, VALID, [(K.STEP, RAISED)], False),
        (seen(turn_rad=0.019), DRIFTING, VALID, [], False),
    ],
    "past the limit, then it isn't seen: counted anew": [
        *START,
        *[(seen(4.5, present=False), RECALIBRATING, VALID, [], False)] * 3,
        (HIDDEN, OCCLUDED, SUSPECT, [(K.OCCLUDED, RAISED)], False),
        (seen(4.5, present=False), OCCLUDED, SUSPECT, [], False),
        (seen(4.5, present=False), RECALIBRATING, VALID, [], False),
        (seen(4.5, present=False), RECALIBRATING, VALID, [(K.OCCLUDED, CLEARED)], False),
        (seen(4.5, present=False), RECALIBRATING, VALID, [], True),
    ],
    "a finger bent: suspect, told as that and not as a motion, cleared when it is straight": [
        *START,
        (seen(0.3, explanation=BENT), DRIFTING, SUSPECT, [(K.GRIPPER, RAISED)], False),
        *[(seen(0.3, explanation=BENT), DRIFTING, SUSPECT, [], False)] * 20,
        (seen(), TRACKING, VALID, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(), TRACKING, VALID, [(K.GRIPPER, CLEARED)], False),
    ],
    "a finger bent so much that it looks past the limit: never calibrated anew": [
        *START,
        (seen(4.5, explanation=BENT), DRIFTING, SUSPECT, [(K.GRIPPER, RAISED)], False),
        *[(seen(4.5, explanation=BENT), DRIFTING, SUSPECT, [], False)] * 20,
    ],
    "a motion whose cause turns out to be the finger: both stay told, with the cause": [
        *START,
        (seen(0.3), DRIFTING, VALID, [(K.STEP, RAISED)], False),
        (seen(0.3, explanation=BENT), DRIFTING, SUSPECT, [(K.STEP, UPDATED), (K.GRIPPER, RAISED)], False),
        (seen(0.3, explanation=BENT), DRIFTING, SUSPECT, [], False),
    ],
    "the jaw reported wrong: suspect": [
        *START,
        (seen(4.5, explanation=WRONG_JAW), DRIFTING, SUSPECT, [(K.GRIPPER, RAISED)], False),
    ],
    "the jaw is blamed until the edges are seen well, then the mount: what was wrong is taken back at once": [
        *START,
        (seen(1.0, explanation=WRONG_JAW), DRIFTING, SUSPECT, [(K.GRIPPER, RAISED)], False),
        (seen(1.0, explanation=KNOCKED), DRIFTING, VALID, [(K.STEP, RAISED), (K.GRIPPER, CLEARED)], False),
    ],
    "another focus: suspect": [
        *START,
        (seen(4.5, explanation=REFOCUSED), DRIFTING, SUSPECT, [(K.LENS, RAISED)], False),
    ],
    "the mount moved: valid, for the transform follows it": [
        *START,
        (seen(1.0), DRIFTING, VALID, [(K.STEP, RAISED)], False),
        (seen(1.0, explanation=KNOCKED), DRIFTING, VALID, [(K.STEP, UPDATED)], False),
        (seen(1.0, explanation=KNOCKED), DRIFTING, VALID, [], False),
    ],
    "a gripper that contradicts its model: suspect while it does": [
        *START,
        (seen(astray=True), TRACKING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
    ],
    "a stream at fault: suspect while it is": [
        *START,
        (seen(stream_at_fault=True), TRACKING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
    ],
    "vibration: told, the transform stays valid, cleared": [
        *START,
        (seen(vibration=HUMMING), TRACKING, VALID, [(K.VIBRATION, RAISED)], False),
        *[(seen(vibration=HUMMING), TRACKING, VALID, [], False)] * 20,
        (seen(), TRACKING, VALID, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(), TRACKING, VALID, [(K.VIBRATION, CLEARED)], False),
    ],
    "a creep from a drift: the kind is told when it is known, not faster than once a second": [
        *START,
        (seen(0.1, kind=K.DRIFT), DRIFTING, VALID, [(K.DRIFT, RAISED)], False),
        *[(seen(0.1, creep_mm_per_min=1.0), DRIFTING, VALID, [], False)] * 7,
        (seen(0.1, creep_mm_per_min=1.0), DRIFTING, VALID, [(K.CREEP, UPDATED)], False),
        *[(seen(0.1, creep_mm_per_min=1.1), DRIFTING, VALID, [], False)] * 20,
    ],
}  # fmt: skip


@pytest.mark.parametrize("table", TABLES.values(), ids=list(TABLES))
def test_tables(table: list[Row]):
    run = Run()
    for number, (frame, state, verdict, alerts, recalibrate) in enumerate(table):
        judgement = run.feed(frame)
        assert (judgement.state, judgement.verdict, told(judgement.alerts), judgement.recalibrate) == (
            state,
            verdict,
            alerts,
            recalibrate,
        ), f"row {number}"


@pytest.mark.parametrize("table", TABLES.values(), ids=list(TABLES))
def test_alerts_in_the_tables_live_once(table: list[Row]):
    """Whatever happens: an id is raised before it is updated or cleared, and nothing is said of it afterwards."""
    run, alive, dead = Run(), set[str](), set[str]()
    for frame, *_ in table:
        for alert in run.feed(frame).alerts:
            assert alert.alert_id
            assert (alert.alert_id in alive) == (alert.event is not RAISED)
            assert alert.alert_id not in dead
            alive.add(alert.alert_id)
            if alert.event is CLEARED:
                alive.remove(alert.alert_id)
                dead.add(alert.alert_id)
    assert {each.alert.alert_id for each in run.policy.alerts.open} == alive


@pytest.mark.parametrize(
    ("x_mm", "turn_rad", "severity"),
    [
        (0.09, 0.0, "info"),
        (0.11, 0.0, "warning"),
        (-2.4, 0.0, "warning"),
        (-2.6, 0.0, "error"),
        (0.0, 0.0029, "info"),
        (0.0, 0.0031, "warning"),
        (0.0, -0.021, "error"),
        (0.11, 0.021, "error"),
    ],
)
def test_severity_follows_the_limits_at_the_tcp(x_mm: float, turn_rad: float, severity: str):
    run = settled(msgspec.structs.replace(SETTINGS, warn_m=1e-4, warn_rad=3e-3, limit_m=2.5e-3, limit_rad=0.02))
    [alert] = run.feed(seen(x_mm, turn_rad=turn_rad)).alerts
    assert (alert.kind, alert.event, alert.severity) == (K.STEP, RAISED, severity)
    assert alert.tcp_shift_m == (pytest.approx(1e-3 * x_mm), 0.0, 0.0)
    assert alert.rotation_rad == pytest.approx(abs(turn_rad))
    assert f"{x_mm:+.3f}" in alert.text
    assert alert.since_ns == run.stamp_ns


def test_a_drift_that_gets_worse_is_said_at_once_and_one_that_gets_better_after_a_while():
    run = settled()
    [raised] = run.feed(seen(0.05)).alerts
    [worse] = run.feed(seen(0.2)).alerts
    [worst] = run.feed(seen(3.0)).alerts
    quiet = run.feed_all([seen(0.05)] * 7)
    [better] = run.feed(seen(0.05)).alerts
    assert [a.severity for a in (raised, worse, worst, better)] == ["info", "warning", "error", "info"]
    assert kinds(quiet) == []
    assert {a.alert_id for a in (raised, worse, worst, better)} == {raised.alert_id}
    assert {a.since_ns for a in (raised, worse, worst, better)} == {raised.since_ns}


def test_a_creep_says_how_fast_and_how_long_until_the_limit():
    [alert] = settled().feed(seen(0.5, creep_mm_per_min=0.25)).alerts
    assert alert.kind is K.CREEP
    assert alert.rate_m_per_min == pytest.approx(2.5e-4)
    assert alert.time_left_s == pytest.approx(480.0), "2 mm left"
    assert "0.250 mm/min" in alert.text and "8 min to the limit" in alert.text
    [past] = settled().feed(seen(2.6, creep_mm_per_min=1.0)).alerts
    assert past.time_left_s == 0.0
    assert "past the limit" in past.text
    [step] = settled().feed(seen(0.5)).alerts
    assert (step.rate_m_per_min, step.time_left_s) == (None, None)


def test_causes_and_the_part_are_in_the_alerts():
    [bent] = settled().feed(seen(0.3, explanation=BENT)).alerts
    assert (bent.kind, bent.cause, bent.part, bent.severity) == (K.GRIPPER, Cause.FINGER_BENT, "left", "error")
    assert bent.causes == BENT.causes
    [moved] = settled().feed(seen(0.3, explanation=KNOCKED)).alerts
    assert (moved.cause, moved.part, moved.causes) == (Cause.CAMERA_MOUNT, None, KNOCKED.causes)
    assert KNOCKED.text in moved.text
    [unknown] = settled().feed(seen(0.3)).alerts
    assert unknown.cause is Cause.UNKNOWN


def test_a_drift_at_the_edge_of_a_limit_is_not_told_again_and_again():
    run = settled()
    warned = run.feed_all([seen(0.105 if i % 60 < 30 else 0.095) for i in range(600)])
    assert kinds(warned) == [(K.STEP, RAISED)]
    eased = alerts_of(run.feed_all([seen(0.075)] * 60))
    assert [a.severity for a in eased] == ["info"]


@pytest.mark.parametrize(("rms_mm", "severity"), [(0.05, "info"), (0.11, "warning")])
def test_vibration_says_its_size_and_frequency(rms_mm: float, severity: str):
    [alert] = settled().feed(seen(vibration=Vibration(1e-3 * rms_mm, 12.2))).alerts
    assert (alert.kind, alert.severity) == (K.VIBRATION, severity)
    assert f"{rms_mm:.3f} mm" in alert.text and "12 Hz" in alert.text


# --- a new reference, or none ---


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


# --- nothing measured ---


def test_an_uncertain_transform_is_suspect():
    run = settled()
    wide = np.array([4e-6, 4e-6, 1.05e-4, 3e-4, 3e-4, 1e-4])
    assert run.feed(seen(sigma=wide)).verdict is SUSPECT
    assert run.feed(seen(sigma=wide * 0.9)).verdict is VALID


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


# --- the stream of frames ---

FROZEN = ("frozen", Cause.CAMERA_FROZEN, "the same image 9 times")
BACKWARDS = ("clock", Cause.CLOCK, "stamps go back")


def test_faults_of_the_stream_live_beside_one_another():
    run = Run()
    table = [
        ([], []),
        ([FROZEN], [(Cause.CAMERA_FROZEN, RAISED)]),
        ([FROZEN], []),
        ([FROZEN, BACKWARDS], [(Cause.CLOCK, RAISED)]),
        ([BACKWARDS], []),
        ([BACKWARDS], []),
        ([BACKWARDS], [(Cause.CAMERA_FROZEN, CLEARED)]),
        ([], []),
        ([BACKWARDS], []),  # back before it was cleared
        ([], []),
        ([], []),
        ([], [(Cause.CLOCK, CLEARED)]),
        ([], []),
    ]
    for number, (faults, alerts) in enumerate(table):
        out = run.feed_stream(*faults)
        assert [(a.cause, a.event) for a in out] == alerts, f"row {number}"
        assert all(a.kind is K.STREAM for a in out)


# --- acknowledged, restarted ---


def test_an_acknowledged_alert_is_silent_unless_it_gets_worse():
    run = settled()
    [raised] = run.feed(seen(0.2)).alerts
    [seen_by] = run.policy.alerts.acknowledge(raised.alert_id)
    assert (seen_by.event, seen_by.acknowledged, seen_by.alert_id) == (UPDATED, True, raised.alert_id)
    assert kinds(run.feed_all([seen(x) for x in np.linspace(0.2, 2.4, 60)])) == []
    [worse] = run.feed(seen(3.0)).alerts
    assert (worse.severity, worse.acknowledged) == ("error", False)


def test_after_a_restart_what_was_open_still_is():
    before = settled()
    before.feed(seen(0.2))
    before.feed(seen(0.2, explanation=BENT))
    kept = before.policy.alerts.open
    after = Run()
    after.policy.alerts.restore(kept, before.policy.alerts.raised, after.now_s)
    assert after.policy.drifting
    assert kinds(after.feed_all([seen(0.2, explanation=BENT)] * 5)) == [], "said before"
    over = [a for j in after.feed_all([seen()] * 5) for a in j.alerts]
    assert {(a.alert_id, a.event) for a in over} == {(each.alert.alert_id, CLEARED) for each in kept}
    [new] = after.feed(seen(0.2)).alerts
    assert new.alert_id not in {each.alert.alert_id for each in kept}
