"""The judgement beside the monitor, as tables: what happens (and when, in seconds) -> the alerts."""

from __future__ import annotations

import numpy as np
import pytest
from support.loopback import frame_record
from support.stand_ins import REFUSED

from gripmon.daemon.watch import DaemonSettings, Watch
from gripmon.model.records import Alert, AlertKind, Cause, OpenAlert, Severity, State, Verdict

RAISED, CLEARED = "source raised", "source cleared"
GOOD, BAD, NONE = "good", "bad", "none"
SETTINGS = DaemonSettings(stale_after_s=0.5, no_camera_alert_after_s=3.0)


@pytest.mark.parametrize(
    ("events", "alerts", "state"),
    [
        ([(0.1, GOOD), (0.2, GOOD)], [], State.TRACKING),
        ([(0.1, GOOD), (0.59, NONE)], [], State.TRACKING),
        ([(0.1, GOOD), (0.61, NONE)], [], State.STALE),
        ([(0.6, NONE)], [], State.STALE),
        ([(0.6, NONE), (2.9, NONE)], [], State.STALE),
        ([(2.0, NONE), (3.0, NONE), (9.0, NONE)], [(3.0, RAISED)], State.STALE),
        ([(3.0, NONE), (5.0, GOOD), (5.1, GOOD)], [(3.0, RAISED), (5.0, CLEARED)], State.TRACKING),
        ([(1.0, NONE), (1.5, GOOD)], [], State.TRACKING),
        ([(3.0, NONE), (4.0, GOOD), (7.1, NONE)], [(3.0, RAISED), (4.0, CLEARED), (7.1, RAISED)], State.STALE),
        ([(1.0, BAD), (4.0, NONE), (4.1, BAD)], [(4.0, RAISED), (4.1, CLEARED)], State.TRACKING),
        ([(1.0, BAD), (2.9, BAD), (9.0, BAD)], [], State.TRACKING),
    ],
)  # fmt: skip
def test_what_the_watch_says(events: list[tuple[float, object]], alerts: list[tuple[float, str]], state: State):
    watch = Watch(SETTINGS, now_s=0.0)
    said: list[tuple[float, str]] = []
    for now_s, event in events:
        if event == NONE:
            due = watch.no_frame("unplugged", now_s, round(1e9 * now_s))
        else:
            due = watch.frame(frame_record(**({} if event == GOOD else REFUSED)), now_s)
        said += [(now_s, f"{alert.kind} {alert.event}") for alert in due]
    assert said == alerts
    assert watch.state is state


def test_a_silence_and_a_failure_have_one_id_each_from_beginning_to_end():
    watch = Watch(SETTINGS, now_s=0.0)
    [silent] = watch.no_frame("unplugged", 3.0, 30)
    assert (silent.event, silent.severity, silent.since_ns) == ("raised", "error", 30)
    [heard] = watch.frame(frame_record(), 4.0)
    assert (heard.event, heard.severity, heard.alert_id, heard.since_ns) == ("cleared", "info", silent.alert_id, 30)
    [failed] = watch.end_of_frame("internal error: so", "", 4.0, 40)
    assert watch.end_of_frame("internal error: so", "", 4.1, 41) == []
    assert (failed.kind, failed.event) == ("lost", "raised")
    assert (watch.state, watch.verdict) == (State.LOST, "unknown")
    [judged] = watch.end_of_frame("", "", 4.2, 42)
    assert (judged.event, judged.alert_id) == ("cleared", failed.alert_id)
    [unheard] = watch.end_of_frame("", "the network: closed", 4.3, 43)
    assert (unheard.kind, unheard.event) == ("output", "raised")
    [again] = watch.no_frame("unplugged", 9.0, 90)
    assert len({silent.alert_id, failed.alert_id, unheard.alert_id, again.alert_id}) == 4


def test_a_refusal_is_said_once_though_its_figures_change():
    watch = Watch(SETTINGS, now_s=0.0)
    messages = []
    for reason in ("black: at most 1 %", "black: at most 2 %", "white: at least 99 %", "white: at least 98 %"):
        watch.frame(frame_record(**(REFUSED | {"reason": reason})), now_s=1.0)
        messages.append(watch.message)
    assert messages == ["frames refused: black: at most 1 %"] * 2 + ["frames refused: white: at least 99 %"] * 2
    assert watch.frames_refused == 4
    watch.frame(frame_record(reason="too few edges agree"), now_s=1.0)
    assert watch.message == "too few edges agree"
    for off in ("0.61 mm off, alert limit 0.5 mm", "1.3e+02 mm off, alert limit 0.5 mm"):
        watch.frame(frame_record(reason=f"the TCP may be {off}"), now_s=1.0)
        assert watch.message == "the TCP may be 0.61 mm off, alert limit 0.5 mm", "figures change with every frame"
    watch.frame(frame_record(), now_s=1.0)
    assert watch.message == ""


def test_the_rate_is_that_of_the_last_frames():
    watch = Watch(SETTINGS, now_s=0.0)
    for i in range(200):
        watch.frame(frame_record(i), now_s=10.0 + i / (30.0 if i < 100 else 50.0))
    assert watch.frames_per_s(10.0 + 199 / 50.0) == pytest.approx(50.0)
    assert watch.frames_per_s(10.0 + 199 / 50.0 + 0.6) == 0.0
    watch.frame(frame_record(200), now_s=30.0)
    watch.frame(frame_record(201), now_s=30.1)
    assert watch.frames_per_s(30.1) == pytest.approx(10.0)


def test_drift_and_protection_are_the_last_transforms_while_it_counts():
    watch = Watch(SETTINGS, now_s=0.0)
    assert (watch.last.tcp_shift_m, watch.last.sigma_m) == (None, None)
    covariance = np.diag([1e-10, 4e-10, 2.5e-9, 1.0, 1.0, 1.0]).ravel().tolist()
    watch.frame(frame_record(covariance=tuple(covariance)), now_s=1.0)
    assert watch.last.tcp_shift_m == frame_record().drift.tcp_shift_m and watch.last.sigma_m == pytest.approx(5e-5)
    assert watch.last.protection_m == 0.00045
    watch.no_frame("unplugged", 9.0, 9)
    assert (watch.last.tcp_shift_m, watch.last.sigma_m, watch.last.protection_m) == (None, None, None)
    watch.frame(frame_record(drift=None, covariance=None, cam_T_grip=None, verdict=Verdict.SUSPECT), now_s=10.0)
    assert (watch.last.tcp_shift_m, watch.last.sigma_m) == (None, None)


def test_standing_alerts_are_the_monitors_and_those_of_the_silence():
    watch = Watch(SETTINGS, now_s=0.0)
    drift = Alert(
        AlertKind.DRIFT, Cause.CAMERA_MOUNT, Severity.WARNING, "moved", alert_id="7-a", since_ns=40, acknowledged=True
    )
    assert watch.standing(()) == ()
    [silent] = watch.no_frame("unplugged", 3.0, 30)
    standing = watch.standing((OpenAlert("drift", drift),))
    assert [(a.alert_id, a.kind, a.text, a.since_ns, a.acknowledged) for a in standing] == [
        (silent.alert_id, AlertKind.SOURCE, silent.text, 30, False),
        ("7-a", AlertKind.DRIFT, "moved", 40, True),
    ]
    watch.frame(frame_record(), 4.0)
    assert [alert.alert_id for alert in watch.standing((OpenAlert("drift", drift),))] == ["7-a"]
