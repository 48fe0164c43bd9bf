"""What a stream of shifts adds up to, end to end: a step, a creep with its rate, a vibration, and the way back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from support.drift_noise import COVARIANCE, SIGMA, autocorrelated, white

from gripmon.judge.drift import DriftSettings, MotionWatch
from gripmon.model.records import AlertKind, Motion

FPS = 60.0


@dataclass
class Stream:
    """Frames of one camera, 60 a second."""

    watch: MotionWatch
    rng: np.random.Generator
    frames: int = 0

    def feed(self, shifts: np.ndarray, *, memory: float = 0.5) -> list[Motion]:
        """Shifts (n, 6) with noise on top that is all that frames claim."""
        noise = autocorrelated(self.rng, len(shifts), 1, memory)[:, 0]
        out = []
        for shift in shifts + noise:
            out.append(self.watch.add(shift, COVARIANCE, self.frames / FPS))
            self.frames += 1
        return out


def quiet_stream(seed: int, frames: int = 1200) -> Stream:
    stream = Stream(MotionWatch(DriftSettings()), np.random.default_rng(seed))
    stream.watch.reset(np.zeros((6, 6)))
    assert not any(m.present or m.vibration for m in stream.feed(np.zeros((frames, 6))))
    return stream


def along_x(metres: np.ndarray | float, frames: int) -> np.ndarray:
    out = np.zeros((frames, 6))
    out[:, 0] = metres
    return out


@pytest.mark.parametrize("size_m", [1e-4, -4.5e-3])
def test_a_step_is_found_at_once_dated_and_called_one(size_m: float):
    stream = quiet_stream(0)
    after = stream.feed(along_x(size_m, 900))
    first = next(n for n, motion in enumerate(after) if motion.present)
    assert 1 <= first <= 15
    assert after[first].begun and not any(m.begun for m in after[first + 1 :])
    assert all(motion.present for motion in after[first:])
    assert {motion.kind for motion in after[first:]} == {AlertKind.STEP}
    stepped = [n for n, motion in enumerate(after) if motion.stepped]
    assert stepped and stepped[0] == first
    assert after[first].step_frames <= first + 1
    assert max(stepped) < 60, "one step is one step"
    assert all(m.creep is None for m in after)
    last = after[-1]
    assert last.frames == 8
    assert abs(last.shift[0] - size_m) < 5.0 * SIGMA[0]
    assert (np.abs(last.shift[1:]) < 5.0 * SIGMA[1:]).all()


@pytest.mark.parametrize("mm_per_min", [0.3, 5.0])
def test_a_creep_is_called_one_and_has_its_rate(mm_per_min: float):
    stream = quiet_stream(0)
    rate_m_per_s = 1e-3 * mm_per_min / 60.0
    after = stream.feed(along_x(rate_m_per_s * np.arange(2400) / FPS, 2400))
    first = next(n for n, motion in enumerate(after) if motion.present)
    assert rate_m_per_s * first / FPS < 1.5e-4, "long before it is large"
    present = [n for n, motion in enumerate(after) if motion.present]
    assert max(np.diff([*present, len(after)])) < FPS, "no alert would be cleared in between"
    assert all(motion.present for motion in after[first + 300 :])
    assert not any(motion.stepped for motion in after)
    assert AlertKind.STEP not in {m.kind for m in after[first:]}
    known = next(n for n, motion in enumerate(after) if motion.kind is AlertKind.CREEP)
    assert known - first < 15.0 * FPS
    last = after[-1]
    assert last.kind is AlertKind.CREEP and last.creep is not None
    assert last.creep.rate_m_per_min == pytest.approx(1e-3 * mm_per_min, rel=0.15)
    assert last.creep.velocity[0] > 0.0
    assert last.creep.since_s == pytest.approx(1200 / FPS, abs=6.0)


@pytest.mark.parametrize("amplitude_m", [5e-5, 3e-4])
def test_once_a_vibration_is_known_its_swings_are_no_steps(amplitude_m: float):
    """The first of them may look like one: no one can know it then."""
    stream = quiet_stream(0)
    t = np.arange(1200) / FPS
    during = stream.feed(along_x(amplitude_m * np.sin(2.0 * np.pi * 11.0 * t), 1200))
    first = next(n for n, motion in enumerate(during) if motion.vibration is not None)
    assert first < 4.0 * FPS
    for motion in during[first:]:
        assert motion.vibration is not None and not motion.stepped and not motion.quiet
    assert not any(motion.present for motion in during[first + 300 :]), "on average it is where it was"
    last = during[-1].vibration
    assert last is not None
    assert last.frequency_hz == pytest.approx(11.0, abs=0.5)
    assert last.rms_m == pytest.approx(amplitude_m / np.sqrt(2.0), rel=0.2)
    after = stream.feed(np.zeros((900, 6)))
    assert not any(motion.vibration or motion.present for motion in after[300:])


@pytest.mark.parametrize("size_m", [3e-4, 3e-3])
def test_a_step_is_found_though_it_vibrates(size_m: float):
    """At once where it is large beside the vibration, else by the means over some periods."""
    stream = quiet_stream(5)
    t = np.arange(1800) / FPS
    waves = along_x(2e-4 * np.sin(2.0 * np.pi * 7.0 * t), 1800)
    assert stream.feed(waves[:900])[-1].vibration is not None
    after = stream.feed(waves[900:] + along_x(size_m, 900))
    first = next(n for n, motion in enumerate(after) if motion.present)
    assert first <= (2 if size_m > 1e-3 else 512)
    assert after[-1].present


@pytest.mark.parametrize("size_m", [1e-4, 1e-3])
def test_a_camera_that_is_pushed_back_is_back(size_m: float):
    stream = quiet_stream(0)
    assert stream.feed(along_x(size_m, 600))[-1].present
    back = stream.feed(np.zeros((900, 6)))
    gone = next(n for n, motion in enumerate(back) if not motion.present)
    assert gone < 3.0 * FPS
    assert not any(motion.present for motion in back[gone + 60 :]), "and stays so"


def test_a_step_on_top_of_a_step_is_another_one():
    stream = quiet_stream(0)
    stream.feed(along_x(1e-3, 600))
    again = stream.feed(along_x(2e-3, 600))
    assert any(motion.stepped for motion in again[:15])
    assert not any(motion.begun for motion in again), "the drift is the same"
    assert again[-1].shift[0] == pytest.approx(2e-3, abs=5.0 * SIGMA[0])


def test_a_new_reference_is_where_drift_begins_anew():
    stream = quiet_stream(1)
    assert stream.feed(along_x(4e-3, 300))[-1].present
    stream.watch.reset(1e-4 * COVARIANCE)
    after = stream.feed(np.zeros((900, 6)))
    assert not any(motion.present or motion.stepped for motion in after)
    assert any(motion.begun for motion in stream.feed(along_x(1e-3, 10)))


def test_before_the_references_error_is_known_nothing_is_decided():
    watch = MotionWatch(DriftSettings())
    watch.reset(np.zeros((6, 6)))
    for index in range(50):
        motion = watch.add(None, COVARIANCE, index / FPS)
        assert not motion.present and not motion.begun and motion.frames == 0


@pytest.mark.parametrize("moved", [True, False])
def test_after_a_restart_it_is_still_away_and_back_when_it_is_back(moved: bool):
    stream = Stream(MotionWatch(DriftSettings()), np.random.default_rng(2))
    stream.watch.reset(np.zeros((6, 6)))
    stream.watch.resume(moved=True)
    after = stream.feed(along_x(1e-3 if moved else 0.0, 900))
    assert all(motion.present for motion in after) == moved
    assert after[-1].present == moved
    assert not any(motion.begun for motion in after), "it was told before the restart"


@pytest.mark.parametrize("noise", [white, autocorrelated])
def test_an_unmoved_camera_is_quiet_for_minutes(noise: object):
    watch = MotionWatch(DriftSettings())
    watch.reset(np.zeros((6, 6)))
    shifts = noise(np.random.default_rng(3), 12_000, 1)[:, 0]  # type: ignore[operator]
    motions = [watch.add(shift, COVARIANCE, index / FPS) for index, shift in enumerate(shifts)]
    assert not any(m.present or m.begun or m.stepped or m.vibration or m.creep for m in motions)
    assert sum(not m.quiet for m in motions) < 120, "seldom does anything speak for a motion"
