"""Frames of a driver that waited on their way to the monitor."""

from __future__ import annotations

import pytest

from gripmon.io.sources.network import MOST_LATE_S, WINDOW_S, Lateness

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


def test_a_clock_that_was_set_is_lived_with():
    lateness = Lateness()
    assert waited(lateness, 0, 5 * MS) == 0
    behind_ns = -S
    windows = [waited(lateness, round(k * 0.1 * WINDOW_S * S), 5 * MS, ahead_ns=behind_ns) for k in range(1, 25)]
    assert windows[0] == S and windows[-1] == 0
    assert sum(late > 0 for late in windows) * 0.1 <= 2.0
