"""What the policy's alerts say: how bad, since when, why, and what they keep to themselves; and how long they live."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from support.policy_runs import (
    BENT,
    BLACK,
    CLEARED,
    KNOCKED,
    PERHAPS_BENT,
    PERIOD_S,
    RAISED,
    SETTINGS,
    UPDATED,
    Run,
    alerts_of,
    kinds,
    seen,
    settled,
)

from gripmon.model.records import AlertKind, Cause, Verdict, Vibration

K = AlertKind


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


def test_a_worse_drift_is_reported_at_once_a_better_one_later():
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


@pytest.mark.parametrize(("since_first", "where"), [(False, "the reference"), (True, "the first frames")])
def test_a_motion_says_from_where_its_size_counts(since_first: bool, where: str):
    run = settled()
    [alert] = run.feed(seen(0.5)._replace(since_first=since_first)).alerts
    at = f"at {run.now_s:.1f} s of the images' clock the TCP was"
    assert alert.text.startswith(f"a step: {at} +0.500 +0.000 +0.000 mm from where {where} had it (1 sigma")


def test_what_is_read_later_says_of_which_time_it_is():
    """An open alert is shown as it was raised for as long as nothing new is to be said."""
    run = settled()
    run.now_s += 1_700_000_000.0
    [moved] = run.feed(seen(0.5)).alerts
    assert "at 2023-11-14 22:15:" in moved.text and " UTC the TCP was" in moved.text
    frames = round(SETTINGS.hold_s / PERIOD_S) + 2
    told = [a.text for a in alerts_of(run.feed_all([BLACK] * frames)) if a.kind in (K.LOST, K.IMAGE)]
    assert len(told) == 2 and all(" since 2023-11-14 22:15:" in text for text in told)


def test_causes_and_the_part_are_in_the_alerts():
    [bent] = settled().feed(seen(0.3, explanation=BENT)).alerts
    assert (bent.kind, bent.cause, bent.part, bent.severity) == (K.GRIPPER, Cause.FINGER_BENT, "left", "error")
    assert bent.causes == BENT.causes
    [moved] = settled().feed(seen(0.3, explanation=KNOCKED)).alerts
    assert (moved.cause, moved.part, moved.causes) == (Cause.CAMERA_MOUNT, None, KNOCKED.causes)
    assert KNOCKED.text in moved.text
    [unknown] = settled().feed(seen(0.3)).alerts
    assert unknown.cause is Cause.UNKNOWN


def test_a_cause_that_is_not_confirmed_makes_a_transform_suspect_and_is_not_named():
    run = settled()
    doubted = run.feed(seen(0.0, explanation=PERHAPS_BENT))
    assert (doubted.verdict, doubted.reason, doubted.alerts) == (Verdict.SUSPECT, PERHAPS_BENT.text, ())
    [moved] = run.feed(seen(0.3, explanation=PERHAPS_BENT)).alerts
    assert (moved.kind, moved.cause, moved.part) == (K.STEP, Cause.UNKNOWN, None)
    confirmed = run.feed(seen(0.3, explanation=BENT)).alerts
    assert [(a.kind, a.event, a.cause, a.part) for a in confirmed] == [
        (K.STEP, UPDATED, Cause.FINGER_BENT, "left"),
        (K.GRIPPER, RAISED, Cause.FINGER_BENT, "left"),
    ]
    doubted_again = run.feed_all([seen(0.3, explanation=PERHAPS_BENT)] * 30)
    assert (K.GRIPPER, CLEARED) not in kinds(doubted_again)
    assert (K.GRIPPER, CLEARED) in kinds(run.feed_all([seen(0.3)] * 30))


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


@pytest.mark.parametrize(("hertz", "said"), [(0.23, " rms at about 0.23 Hz"), (9.7, " at about 9.7 Hz"), (0.0, " rms")])
def test_a_slow_vibration_is_not_one_at_0_hz(hertz: float, said: str):
    [alert] = settled().feed(seen(vibration=Vibration(1e-4, hertz))).alerts
    assert alert.text.endswith(said)


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
