"""The loop of a second camera between stand-ins: what it survives, and what it says.  The judgement is real."""

from __future__ import annotations

import random
import re
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
from support.pulsed_scenes import PULSE_NS, cell, dark, lit
from support.rubbish import broken_json
from support.stand_ins import Listener, ScriptedSource

from gripmon.daemon.config.second import read_laser
from gripmon.daemon.running import run_second
from gripmon.daemon.watch import DaemonSettings
from gripmon.io.sources import Waiting
from gripmon.laser.judgement import SpotWatchSettings
from gripmon.laser.matching import LONGEST_S, PulseSettings, ReportedPulse, of_message
from gripmon.laser.watching import PulsedWatch
from gripmon.model.records import (
    AlertEvent,
    AlertKind,
    Cause,
    Frame,
    Image,
    LaserPulse,
    MessageRefused,
    PulseFault,
    SpotRecord,
    State,
    Verdict,
    from_json,
)

START_NS, PERIOD_NS = 1_000_000_000_000, 400_000_000
NEVER = 1000.0  # seconds that no test takes


class SpotListener(Listener):
    """Takes spots, too, on the network and in the recording."""

    def __init__(self, **options: object) -> None:
        super().__init__(**options)  # type: ignore[arg-type]
        self.spots: list[SpotRecord] = []
        self.images: list[Image | None] = []

    def spot(self, record: SpotRecord, image: Image | None = None) -> None:
        self._take("spot", record.pulse)
        self.spots.append(record)
        self.images.append(image)


class ScriptedPulses:
    """Pulses that are put in by the source's script."""

    def __init__(self) -> None:
        self.waiting: list[ReportedPulse] = []

    def poll(self) -> ReportedPulse | None:
        return self.waiting.pop(0) if self.waiting else None


class Bench:
    """One second camera; ``items`` are the source's."""

    def __init__(self, *, live: bool = True, **settings: object) -> None:
        self.pulses, self.live = ScriptedPulses(), live
        self.settings = DaemonSettings(**{"state_period_s": NEVER, "stale_after_s": NEVER, **settings})  # type: ignore[arg-type]
        self.network, self.recording = SpotListener(), SpotListener()
        self.pulsed = PulsedWatch(
            read_laser(cell().folder / "laser.yaml"), SpotWatchSettings(), PulseSettings(margin_s=0.02)
        )
        self._rng = np.random.default_rng(3)
        self._seq = 0

    def pulse(self, k: int, *, image: object = None) -> list[object]:
        """A dark frame, one with the laser on, the word of the robot, and a frame after it."""
        begin_ns = START_NS + k * PERIOD_NS
        shown = lit(cell().uv_px(k), self._rng) if image is None else image
        told = ReportedPulse(begin_ns, begin_ns + PULSE_NS, cell().data.base_T_ee[k])
        return [
            self.frame(begin_ns - 50_000_000, dark(self._rng)),
            self.frame(begin_ns + 100_000_000, shown),
            lambda _source: self.pulses.waiting.append(told),
            self.frame(begin_ns + PULSE_NS + 10_000_000, dark(self._rng)),
        ]

    def frame(self, stamp_ns: int, image: object) -> Frame:
        self._seq += 1
        return Frame(self._seq, stamp_ns, image)  # type: ignore[arg-type]

    def run(self, items: Iterable[object], **more: object) -> int:
        return run_second(
            self.pulsed, source=ScriptedSource(items, live=self.live), publisher=self.network,
            recorder=self.recording, settings=self.settings,
            robot="cell", camera="second", feed=self.pulses, **more,  # type: ignore[arg-type]
        )  # fmt: skip

    @property
    def alerts(self) -> list[tuple[AlertKind, AlertEvent]]:
        return [(alert.kind, alert.event) for alert in self.network.alerts]


def pause(seconds: float) -> Callable[[object], None]:
    return lambda _: time.sleep(seconds)


@pytest.mark.parametrize(("moves_px", "fault"), [(0.0, None), (6.0, PulseFault.MOVING), (25.0, PulseFault.MOVING)])
def test_a_hand_that_moves_during_a_pulse_is_told_from_something_that_moved(moves_px, fault):
    """Each spot would be off by half of its way, three of them look like a motion."""
    bench, rng, items = Bench(), np.random.default_rng(2), []
    for k in range(6):
        first, _, told, last = bench.pulse(k)
        way = moves_px * np.array([0.8, 0.6])
        lights = [
            bench.frame(START_NS + k * PERIOD_NS + (3 + 3 * j) * 10_000_000, lit(cell().uv_px(k) + way * j / 4, rng))
            for j in range(5)
        ]
        items += [first, *lights, told, last]
    bench.run(items)
    assert [record.fault for record in bench.network.spots] == [fault] * 6
    assert not [alert for alert in bench.network.alerts if alert.kind is AlertKind.DRIFT]
    assert fault is None or all("during the pulse" in record.reason for record in bench.network.spots)


@pytest.mark.parametrize("background", [True, False])
def test_a_spot_that_is_not_seen_without_a_background_says_what_would_help(background):
    bench = Bench()
    items = bench.pulse(0, image=dark(np.random.default_rng(1)))
    bench.run(items if background else items[1:])
    (record,) = bench.network.spots
    assert record.fault is PulseFault.NO_SPOT and record.background is background
    assert ("no frame to subtract" in record.reason) is not background


def test_pulses_are_judged_said_and_recorded():
    bench = Bench()
    assert bench.run([item for k in range(3) for item in bench.pulse(k)]) == 0
    assert [(spot.pulse, spot.used, spot.frames, spot.background) for spot in bench.network.spots] == [
        (k, True, 1, True) for k in range(3)
    ]
    assert bench.recording.spots == bench.network.spots and all(image is not None for image in bench.recording.images)
    assert [state.state for state in bench.network.states][-2:] == [State.TRACKING, State.STALE]
    assert (bench.network.states[-2].verdict, bench.network.states[-1].message) == (Verdict.VALID, "stopped")
    assert not bench.alerts and bench.network.closed == bench.recording.closed == 1


def test_an_internal_error_costs_one_pulse(monkeypatch: pytest.MonkeyPatch):
    bench = Bench()
    judge = bench.pulsed.judge

    def fails_once(shown: object) -> object:
        if shown.pulse.number == 1:  # type: ignore[attr-defined]
            raise ValueError("singular\nmatrix")
        return judge(shown)  # type: ignore[arg-type]

    monkeypatch.setattr(bench.pulsed, "judge", fails_once)
    assert bench.run([item for k in range(3) for item in bench.pulse(k)] + bench.pulse(3)[:1]) == 0
    assert [spot.fault for spot in bench.network.spots] == [None, PulseFault.INTERNAL, None]
    assert bench.network.spots[1].reason == "internal error: ValueError: singular matrix"
    assert bench.alerts == [(AlertKind.LOST, AlertEvent.RAISED), (AlertKind.LOST, AlertEvent.CLEARED)]
    assert (State.LOST, "internal error: ValueError: singular matrix") in [
        (state.state, state.message) for state in bench.network.states
    ]


def test_errors_that_persist_end_it_with_code_3(monkeypatch: pytest.MonkeyPatch):
    bench = Bench(give_up_after_errors=3)
    monkeypatch.setattr(bench.pulsed, "judge", lambda shown: 1 / 0)
    assert bench.run([item for k in range(8) for item in bench.pulse(k)]) == 3
    assert len(bench.network.spots) == 3


@pytest.mark.parametrize("fails", ["spot", "state", "alert", "everything"])
def test_a_broken_output_does_not_keep_the_others_from_hearing(fails: str):
    bench = Bench()
    bench.network.fails = fails
    assert bench.run([item for k in range(3) for item in bench.pulse(k)]) == 0
    assert len(bench.recording.spots) == 3


def test_images_of_another_size_are_an_alert_until_they_fit_again():
    bench = Bench()
    small = np.zeros((48, 64), np.uint8)
    items = [bench.frame(START_NS - (30 - k) * 100_000_000, small) for k in range(20)]
    assert bench.run([*items, *bench.pulse(0), *bench.pulse(1)]) == 0
    assert bench.alerts == [(AlertKind.IMAGE, AlertEvent.RAISED), (AlertKind.IMAGE, AlertEvent.CLEARED)]
    assert "64x48 pixels; 640x480 as the calibration says" in bench.network.alerts[0].text
    assert bench.network.states[-1].frames_refused == 20 and bench.network.spots[0].used


def test_no_usable_image_at_all_is_a_failure():
    bench = Bench()
    assert bench.run([bench.frame(START_NS + k, None) for k in range(3)]) == 3


def test_a_pulse_whose_frame_is_torn_says_so():
    bench = Bench()
    bench.run([*bench.pulse(0, image=np.zeros((4, 4), np.uint8)), *bench.pulse(1)])
    assert [spot.fault for spot in bench.network.spots] == [PulseFault.IMAGE, None]


def test_a_camera_that_goes_away_and_comes_back():
    bench = Bench(stale_after_s=0.01, no_camera_alert_after_s=0.05)
    silence = [pause(0.06), Waiting("unplugged"), Waiting("unplugged")]
    assert bench.run([*bench.pulse(0), *bench.pulse(1), *silence, *bench.pulse(2)]) == 0
    assert bench.alerts == [(AlertKind.SOURCE, AlertEvent.RAISED), (AlertKind.SOURCE, AlertEvent.CLEARED)]
    assert bench.network.alerts[0].cause is Cause.NO_CAMERA
    assert "no frames: unplugged" in [state.message for state in bench.network.states]
    assert [spot.used for spot in bench.network.spots] == [True] * 3


def test_a_source_that_breaks_is_said_and_ends_it():
    bench = Bench()
    assert bench.run([*bench.pulse(0), OSError("the bus is gone")]) == 3
    assert "the source failed: OSError: the bus is gone" in bench.network.alerts[-1].text


def test_a_robot_that_forgets_its_laser_is_an_alert_until_it_remembers():
    bench = Bench()
    items = [bench.frame(START_NS - 900_000_000, dark(np.random.default_rng(1))), pause(0.3), Waiting("slow")]
    bench.run([*items, *bench.pulse(0)], no_spot_alert_after_s=0.25)
    assert (AlertKind.STREAM, AlertEvent.RAISED) in bench.alerts
    said = bench.network.alerts[0].text
    assert said.startswith("no usable spot for ") and said.endswith(" s: no pulse yet")


def test_recorded_frames_with_a_table_need_no_feed():
    bench = Bench(live=False)
    items = [item for k in range(3) for item in bench.pulse(k) if isinstance(item, Frame)]
    told = [ReportedPulse(START_NS + k * PERIOD_NS, START_NS + k * PERIOD_NS + PULSE_NS, cell().data.base_T_ee[k])
            for k in range(4)]  # fmt: skip
    assert bench.run(items, table=told) == 0
    assert [spot.used for spot in bench.network.spots] == [True] * 3 + [False]
    assert bench.network.spots[3].fault is PulseFault.NO_FRAME, "the frames ended before it"


def told_or_why_not(payload: bytes) -> ReportedPulse | str:
    try:
        return of_message(from_json(payload, LaserPulse))
    except (MessageRefused, ValueError) as error:
        return str(error)


def test_whatever_a_stranger_sends_is_refused_in_one_line():
    """Or it is a pulse that can be, by chance."""
    rng, refused = random.Random(8), 0
    pose = {"translation_m": [0.1, 0.2, 0.3], "rotation_xyzw": [0.0, 0.0, 0.0, 1.0]}
    good = {"stamp_ns": 5, "until_ns": 10, "base_T_ee": pose}
    for _ in range(4000):
        payload = broken_json(rng, good, ("stamp_ns", "until_ns", "base_T_ee"))
        told = told_or_why_not(payload)
        if isinstance(told, str):
            refused += 1
            assert told and "\n" not in told, payload
        else:
            assert 0 < told.until_ns - told.stamp_ns <= 1e9 * LONGEST_S and np.isfinite(told.base_T_ee).all()
    assert refused > 3500


def test_the_pulse_on_the_page_is_one():
    page = (Path(__file__).parent.parent / "docs" / "howto" / "laser.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```json\n(.*?)```", page, re.DOTALL)
    told = of_message(from_json(block.encode(), LaserPulse))
    assert told.until_ns - told.stamp_ns == 250_000_000
