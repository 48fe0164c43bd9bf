"""Dropped frames: said when they are many for long, with the rates that tell what to change."""

from __future__ import annotations

import pytest
from support.daemon_bench import Bench, pause
from support.stand_ins import ScriptedSource

from gripmon.daemon.watch import DROP_WINDOW_S, DaemonSettings, Drops, Watch
from gripmon.model.records import AlertEvent, AlertKind, Cause, Severity


def after(drops: Drops, seconds: int, handled_per_s: int, dropped_per_s: int, since_s: int = 0) -> list[str]:
    """What is said in each second of a camera of these rates."""
    return [
        drops.look((since_s + s) * handled_per_s, (since_s + s) * dropped_per_s, 100.0 + since_s + s)
        for s in range(seconds + 1)
    ]


@pytest.mark.parametrize(("handled_per_s", "dropped_per_s"), [(60, 0), (50, 10), (0, 0)])
def test_few_are_nobodys_business(handled_per_s: int, dropped_per_s: int):
    assert set(after(Drops(0.2), 60, handled_per_s, dropped_per_s)) == {""}


def test_many_are_said_after_ten_seconds_with_what_to_change():
    said = after(Drops(0.2), 20, 10, 50)
    assert not any(said[: int(DROP_WINDOW_S)]) and all(said[int(DROP_WINDOW_S) :])
    assert said[-1] == (
        "83 % of the frames were dropped in 10 s: 60 a second arrived, the monitor had time for 10; lower the camera's "
        "rate (source.fps, or its driver's) to that, give smaller images, or free the processor of other work"
    )


def test_a_slow_second_is_forgotten():
    drops = Drops(0.2)
    said = [drops.look(30 * s, 60 * min(s, 1), float(s)) for s in range(40)]
    assert not any(said)


def test_a_camera_that_comes_late_is_judged_from_its_first_frame_on():
    drops = Drops(0.2)
    assert not any(after(drops, 30, 0, 0))  # the monitor waits
    said = [drops.look(10 * s - 3, 3, 130.0 + s) for s in range(1, 21)]  # its first frames find the monitor not ready
    assert not any(said)
    assert drops.look(197, 303, 151.0) and drops.look(197, 303, 152.0)
    said = [drops.look(197, 303, 152.0 + s) for s in range(1, 21)]  # it is gone, and with it what was wrong
    assert said[0] and not said[-1]


def test_it_is_over_when_they_are_few():
    drops = Drops(0.2)
    assert after(drops, 20, 10, 50)[-1]
    said = [drops.look(200 + 60 * s, 1000, 120.0 + s) for s in range(1, 21)]
    assert said[0] and not said[-1]


def test_one_hundred_per_cent_is_never():
    assert set(after(Drops(1.0), 60, 1, 59)) == {""}


def test_the_alert_is_raised_and_cleared_once():
    watch = Watch(DaemonSettings(), 0.0)
    told = []
    for second in range(60):
        watch.frames = 10 * second
        told += watch.dropped(50 * min(second, 30), float(second), 0)
    assert [(alert.kind, alert.cause, alert.event) for alert in told] == [
        (AlertKind.STREAM, Cause.TOO_SLOW, AlertEvent.RAISED),
        (AlertKind.STREAM, Cause.TOO_SLOW, AlertEvent.CLEARED),
    ]
    assert told[0].severity is Severity.WARNING


def test_the_daemon_raises_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("gripmon.daemon.watch.DROP_WINDOW_S", 0.02)
    monkeypatch.setattr("gripmon.daemon.watch._LOOK_EVERY_S", 0.0)

    def drop(source: object) -> None:
        assert isinstance(source, ScriptedSource)
        source.dropped += 9

    bench = Bench([each for seq in range(4) for each in (drop, pause(0.03), seq)])
    bench.run()
    assert (AlertKind.STREAM, Cause.TOO_SLOW) in bench.alerts
