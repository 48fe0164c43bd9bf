"""Frames of a driver that waited on their way to the monitor."""

from __future__ import annotations

import pytest

from gripmon.io.sources.lateness import MOST_LATE_S, WINDOW_S, Lateness, lasting_fault

MS, S = 10**6, 10**9
UNIX_NS = 1_700_000_000 * S


def waited(lateness: Lateness, captured_ns: int, way_ns: int, *, ahead_ns: int = 0) -> int:
    """A frame captured at ``captured_ns`` by the monotonic clock, by a driver whose clock is ahead."""
    arrived_ns = captured_ns + way_ns
    return lateness.waited_ns(UNIX_NS + captured_ns + ahead_ns, arrived_ns, UNIX_NS + arrived_ns)


@pytest.mark.parametrize("ahead_s", [-1.5, 0.0, 1.5])
def test_what_takes_longer_than_the_fastest_has_waited(ahead_s: float):
    lateness, ahead_ns = Lateness(), round(1e9 * ahead_s)
    assert waited(lateness, 0, 5 * MS, ahead_ns=ahead_ns) == 0
    assert waited(lateness, 33 * MS, 8 * MS, ahead_ns=ahead_ns) == 3 * MS
    assert waited(lateness, 66 * MS, 10 * S, ahead_ns=ahead_ns) == 10 * S - 5 * MS
    assert waited(lateness, 10 * S, 4 * MS, ahead_ns=ahead_ns) == 0


def test_recorded_stamps_tell_nothing():
    lateness = Lateness()
    for step in range(100):  # replayed at half the speed
        assert waited(lateness, step * S, step * S, ahead_ns=-3600 * S) == 0
    assert waited(Lateness(), 0, 0, ahead_ns=round(-1.01e9 * MOST_LATE_S)) == 0


def series(way_s, ahead_s=lambda at_s: 0.0, *, seconds: int, fps: int = 10) -> tuple[list[float], Lateness]:
    """What is said of each frame of a camera, s, by its true way and by how far its clock is ahead, both over time."""
    lateness = Lateness()
    said = []
    for k in range(seconds * fps):
        at_ns = k * S // fps
        way_ns, ahead_ns = (round(1e9 * of(at_ns / S)) for of in (way_s, ahead_s))
        said.append(1e-9 * waited(lateness, at_ns, way_ns, ahead_ns=ahead_ns))
    return said, lateness


@pytest.mark.parametrize("delay_s", [0.1, 2.5, 5.0])
def test_a_delay_that_lasts_is_never_forgotten(delay_s: float):
    said, lateness = series(lambda at_s: 0.005 + (delay_s if at_s >= 20 else 0.0), seconds=1800)
    assert said[:200] == [0.0] * 200
    assert min(said[200:]) == pytest.approx(delay_s)
    assert lateness.lasting_s == pytest.approx(delay_s)
    assert "or more later than they did" in lasting_fault("a/key", lateness.lasting_s)


def test_a_delay_that_comes_and_goes_a_little_is_not_forgotten_bit_by_bit():
    """By 50 ms more in every other minute, which alone could be drift."""
    said, _ = series(lambda at_s: 0.005 + (2.5 + 0.05 * (at_s // 60 % 2) if at_s >= 20 else 0.0), seconds=7200)
    assert min(said[200:]) > 2.4


def test_it_is_over_when_the_link_is_fast_again():
    said, lateness = series(lambda at_s: 0.005 + (2.5 if 20 <= at_s < 400 else 0.0), seconds=600)
    assert said[4025:] == [0.0] * (6000 - 4025) and lateness.lasting_s == 0.0
    assert lasting_fault("a/key", lateness.lasting_s) == ""


@pytest.mark.parametrize("drift", [-1e-4, 1e-4, 0.9e-3])
def test_clocks_that_drift_apart_are_no_delay(drift: float):
    """Two quartzes differ by 100 ppm at most, clocks that NTP slews by 1000."""
    said, _ = series(lambda at_s: 0.005, lambda at_s: -drift * at_s, seconds=1800)
    assert max(said) <= 2 * WINDOW_S * abs(drift)


@pytest.mark.parametrize("step_s", [0.5, 2.0, 3600.0])
def test_a_clock_that_was_set_back_is_told_by_its_stamps(step_s: float):
    """And a delay before and after it stays what it is."""
    way_s, ahead_s = (lambda at_s: 0.005 + 0.2 * (at_s >= 20)), (lambda at_s: step_s * (at_s < 50))
    said, _ = series(way_s, ahead_s, seconds=600)
    assert said[300] == pytest.approx(0.2) or step_s > MOST_LATE_S, "of another time tells nothing"
    assert min(said[503:]) == pytest.approx(0.2) == max(said[503:])


@pytest.mark.parametrize("wrong_s", [86_400.0, 1.0, -1.0, -86_400.0])
@pytest.mark.parametrize("frame", [0, 300])
def test_one_wrong_stamp_tells_nothing_of_the_others(wrong_s: float, frame: int):
    """In a delay that lasts it doesn't make it forgotten; as the first one it costs some frames."""
    way_s, wrong = (lambda at_s: 0.005 + 2.5 * (at_s >= 20)), (lambda at_s: wrong_s * (at_s == frame / 10))
    said, _ = series(way_s, wrong, seconds=600)
    assert said[frame + 5 : 200] == pytest.approx([0.0] * len(said[frame + 5 : 200]))
    others = [each for k, each in enumerate(said[200:], 200) if k != frame]
    assert others == pytest.approx([2.5] * len(others))


def test_frames_that_overtake_each_other_set_no_clock():
    lateness = Lateness()
    for k in range(600):
        waited(lateness, k * S // 10 if k % 10 else (k - 2) * S // 10, 5 * MS)
    assert waited(lateness, 60 * S, 2 * S) >= 2 * S - 5 * MS
