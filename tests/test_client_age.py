"""How old a transform is at most: the reckoning, without a network."""

from __future__ import annotations

import math
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.loopback import frame_record
from support.timely import clock

from gripmon.client import MonitorName, Policy, Reading, Unusable
from gripmon.client.age import NO_LEADS, Leads, Sent, steady_s, waited_s, with_answer, without_contradicted
from gripmon.client.inbox import HELD_BACK_S, Entry, Inbox
from gripmon.client.reading import judge
from gripmon.io.wire import MOST_DRIFT, steady_ns
from gripmon.model.records import ClockReading, to_json

WRIST = MonitorName("arm", "wrist")
MS = 10**6
S = 10**9


def after(asked_ns: int, forth_ns: int, back_ns: int, leads: Leads = NO_LEADS) -> Leads:
    """What is known when a question took ``forth_ns`` to get there, and its answer ``back_ns`` to come."""
    read_ns = asked_ns + forth_ns
    return with_answer(leads, clock(read_ns), asked_ns, read_ns + back_ns)


def sent(sent_ns: int, arrived_ns: int) -> Sent:
    return Sent(clock(sent_ns), arrived_ns)


def test_only_the_way_of_the_question_widens_the_bound():
    """An answer may wait as long as it likes: what it says was read when the question came."""
    assert waited_s(after(0, 1 * MS, 0), sent(5 * MS, 25 * MS)) == pytest.approx(0.021, abs=1e-4)
    late = waited_s(after(0, 1 * MS, 9 * S), sent(5 * MS, 25 * MS))
    assert late == pytest.approx(0.021 + MOST_DRIFT * 9, abs=1e-4)  # but the clocks may drift meanwhile


def test_a_first_message_that_waited_is_known_to_have_waited():
    assert waited_s(after(14 * S, 2 * MS, 2 * MS), sent(0, 14 * S)) == pytest.approx(14.002, abs=0.001)


def test_the_best_answer_counts_until_the_drift_makes_another_one_better():
    leads = after(0, 1 * MS, 1 * MS)
    leads = after(10 * S, 30 * MS, 1 * MS, leads)  # 10 s of drift are 10 ms
    assert waited_s(leads, sent(11 * S, 11 * S)) == pytest.approx(0.012, abs=1e-4)
    leads = after(40 * S, 30 * MS, 1 * MS, leads)
    assert waited_s(leads, sent(41 * S, 41 * S)) == pytest.approx(0.031, abs=1e-4)


def test_another_clock_is_not_known():
    assert waited_s(after(0, MS, MS), Sent(clock(5, "another"), 5)) is None
    assert waited_s(after(0, MS, MS), None) is None


def test_clocks_that_a_stranger_makes_up_fill_no_memory():
    leads = NO_LEADS
    for number in range(100):
        leads = with_answer(leads, clock(0, str(number)), 0, MS)
    assert len(leads) == 16 and "99" in leads


def test_what_a_jump_contradicts_is_forgotten():
    """The controller slept for 5 s: the monitor's clock has gained as much."""
    leads = after(0, 1 * MS, 1 * MS)
    leaped = Sent(ClockReading("its", clock(10 * S).now_ns + 5 * S), 10 * S + 20 * MS)
    assert waited_s(leads, leaped) is not None and without_contradicted(leads, leaped) == {}
    leads = with_answer(leads, leaped.reading, 10 * S - MS, 10 * S + MS)  # and an answer says so, too
    assert waited_s(leads, leaped) == pytest.approx(0.021, abs=1e-4)


@given(
    drift=st.floats(-MOST_DRIFT, MOST_DRIFT),
    start_ns=st.integers(-(10**15), 10**15),
    trips=st.lists(st.tuples(st.integers(1, 60 * S), st.integers(0, 9 * S), st.integers(0, 9 * S)), max_size=8),
    message=st.tuples(st.integers(0, 600 * S), st.integers(0, 20 * S)),
)
def test_nothing_is_ever_older_than_the_bound(
    drift: float, start_ns: int, trips: list[tuple[int, int, int]], message: tuple[int, int]
):
    def its(now_ns: int) -> ClockReading:
        return ClockReading("its", 10**16 + start_ns + now_ns + math.floor(0.999 * drift * now_ns))

    leads, now_ns = NO_LEADS, 0
    for pause_ns, forth_ns, back_ns in trips:
        now_ns += pause_ns
        leads = with_answer(leads, its(now_ns + forth_ns), now_ns, now_ns + forth_ns + back_ns)
    sent_ns, on_its_way_ns = message
    on_way = Sent(its(sent_ns), sent_ns + on_its_way_ns)
    bound_s = waited_s(leads, on_way)
    assert (bound_s is None) == (not trips)
    # (What it lost or gained on the way itself is one part in a thousand of that.)
    assert bound_s is None or bound_s >= 1e-9 * on_its_way_ns * (1 - 2 * MOST_DRIFT) - 1e-6
    assert not trips or without_contradicted(leads, on_way) == leads


def heard(sent: Sent | None, leads: Leads = NO_LEADS) -> Inbox:
    inbox = Inbox()
    inbox._set(leads=leads)
    inbox.take(WRIST, to_json(frame_record(latency_ns=10 * MS)), 100.0, sent)
    return inbox


def reading(inbox: Inbox, policy: Policy | None = None, now_s: float = 100.0, wall_ns: int = 0) -> Reading:
    return judge(inbox.heard, inbox.heard.entry, policy or Policy(), now_s, wall_ns, lambda: "")


def test_the_age_is_what_the_monitor_needed_the_way_and_the_time_since():
    got = reading(heard(sent(99_900 * MS, 100 * S), after(99 * S, 0, 0)), now_s=100.05)
    assert got.usable and got.age_s == pytest.approx(0.01 + 0.1 + 0.05, abs=0.002)
    got = reading(heard(sent(98 * S, 100 * S), after(99 * S, 0, 0)))
    assert got.why is Unusable.STALE and got.transform is None
    assert got.reason == "the newest transform is 2.01 s old, at most 0.2 s is allowed"


@pytest.mark.parametrize("came", [True, False])
def test_what_came_before_the_machine_was_suspended_or_waited_meanwhile_is_old(
    came: bool, monkeypatch: pytest.MonkeyPatch
):
    """Of Linux's clocks only ``CLOCK_BOOTTIME`` goes on, and the wall clock."""
    shown, asleep_ns = time.clock_gettime_ns, [0]
    monkeypatch.setattr(
        time, "clock_gettime_ns", lambda clock: shown(clock) + (clock == time.CLOCK_BOOTTIME) * asleep_ns[0]
    )
    message, inbox = to_json(frame_record(latency_ns=0)), Inbox()
    now_ns = steady_ns()
    inbox.answered(clock(now_ns), now_ns, now_ns)
    if came:  # otherwise it waits in the socket
        inbox.take(WRIST, message, steady_s(), Sent(clock(now_ns), steady_ns()))
        assert reading(inbox, Policy(max_age_s=60.0), steady_s()).usable
    asleep_ns[0] = 3600 * S
    if not came:
        inbox.take(WRIST, message, steady_s(), Sent(clock(now_ns), steady_ns()))
    got = reading(inbox, Policy(max_age_s=60.0), steady_s())
    assert got.why is Unusable.STALE and 3600.0 <= got.age_s < 3700.0


def test_of_unknown_age_is_not_usable_until_the_monitor_answers():
    inbox = heard(sent(99_999 * MS, 100 * S))
    got = reading(inbox)
    assert got.why is Unusable.AGE_UNKNOWN and got.transform is None and got.age_s == math.inf
    assert got.reason.endswith("is not known: the monitor has not sent its clock yet")
    assert not inbox.age_known
    inbox.answered(clock(100_001 * MS), 100 * S, 100_002 * MS)
    assert inbox.age_known and reading(inbox).usable


def test_an_older_monitor_that_does_not_tell_needs_clocks_that_agree():
    inbox, stamp_ns = heard(None), frame_record().stamp_ns
    got = reading(inbox)
    assert got.why is Unusable.AGE_UNKNOWN and "of an older version" in got.reason
    agree = Policy(clocks_agree=True)
    assert reading(inbox, agree, wall_ns=stamp_ns + 150 * MS).usable
    assert reading(inbox, agree, wall_ns=stamp_ns + 250 * MS).why is Unusable.STALE


class _Waiter:
    def __init__(self) -> None:
        self.got: list[Entry] = []

    def put(self, entry: Entry) -> None:
        self.got.append(entry)

    def wake(self) -> None: ...


def test_who_waits_for_a_transform_hears_when_its_age_is_known():
    inbox, waiter = Inbox(), _Waiter()
    inbox.join(waiter)
    message = to_json(frame_record())
    for step in range(3):
        inbox.take(WRIST, message, 100.0 + 0.1 * step, sent(100 * S + step, 100 * S + step))
    assert waiter.got == []
    inbox.answered(clock(100 * S), 100 * S, 100 * S + MS)
    assert [entry.arrival_s for entry in waiter.got] == [pytest.approx(100.2)]  # the newest alone
    inbox.take(WRIST, message, 100.3, sent(100 * S, 100 * S))
    assert len(waiter.got) == 2
    for late_s in (0.0, 0.9 * HELD_BACK_S, 1.1 * HELD_BACK_S):  # of another clock, that no one answers for
        inbox.take(WRIST, message, 101.0 + late_s, Sent(clock(0, "another"), 0))
    assert len(waiter.got) == 3 and reading(inbox).why is Unusable.AGE_UNKNOWN
