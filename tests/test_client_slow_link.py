"""What a controller is told over links that are too slow, stand still, or lead through a router that hangs.

Monitor, controller and link are on one machine here, so that every transform's true age is known.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import pytest
from support import router_process
from support.loopback import frame_record, free_endpoint, wait_until
from support.published import Published

from gripmon.client import Policy, Reading, TransformClient, Unusable
from gripmon.client.inbox import Entry
from gripmon.io.wire import PublishSettings

pytestmark = pytest.mark.usefixtures("tools_importable")

RATE_PER_S = 30.0
POLICY = Policy(max_age_s=0.2)
BOUND_S = 0.05
CORNERS = frame_record().corners * 12  # 2.9 kB, as with eight corners of a real gripper


class Told(NamedTuple):
    true_age_s: float
    reading: Reading


class WatchedClient(TransformClient):
    """Notes every reading that its iterators give, with the age that the frame had just before it was judged."""

    def __init__(self, *arguments: object, **options: object) -> None:
        self.told: list[Told] = []
        super().__init__(*arguments, **options)  # type: ignore[arg-type]

    def judge(self, entry: Entry) -> Reading:
        now_ns = time.time_ns()
        reading = super().judge(entry)
        self.told.append(Told(1e-9 * (now_ns - reading.stamp_ns), reading))
        return reading


@contextmanager
def monitor(settings: PublishSettings, *, ahead_ns: int = 0) -> Iterator[Published]:
    """Sends transforms as a camera of 30 frames/s makes them, its clock being ahead."""
    publisher, done = Published(settings), threading.Event()

    def send() -> None:
        seq, start_s = 0, time.monotonic()
        while not done.wait(max(0.0, start_s + seq / RATE_PER_S - time.monotonic())):
            publisher.transform(frame_record(seq, stamp_ns=time.time_ns() + ahead_ns, corners=CORNERS))
            seq += 1

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield publisher
    finally:
        done.set()
        thread.join()
        publisher.close()


@contextmanager
def client(endpoint: str) -> Iterator[WatchedClient]:
    with WatchedClient("arm", "wrist", connect=[endpoint], policy=POLICY) as made:
        made.on_transform(lambda reading: None)
        yield made


def polled(client: TransformClient, seconds_s: float, policy: Policy | None = None) -> list[Told]:
    """What ``latest`` said, with the age that the newest frame had just before."""
    rows, end_s = [], time.monotonic() + seconds_s
    while time.monotonic() < end_s:
        now_ns = time.time_ns()
        reading = client.latest(policy)
        rows.append(Told(1e-9 * (now_ns - reading.stamp_ns), reading))
        time.sleep(0.002)
    return rows


def none_is_old(rows: list[Told]) -> None:
    """The bound that docs/howto/client.md states, and more: no usable reading claims to be younger than it is."""
    usable = [row for row in rows if row.reading.usable]
    assert max((row.true_age_s for row in usable), default=0.0) <= POLICY.max_age_s + BOUND_S
    assert max((row.true_age_s - row.reading.age_s for row in usable), default=0.0) < 0.5 * BOUND_S


def some_usable(client: TransformClient) -> Callable[[], bool]:
    return lambda: client.latest().usable


@pytest.mark.parametrize("bytes_per_s", [30e3, 100e3])
def test_a_link_that_is_too_slow_makes_nothing_old_usable(bytes_per_s: float):
    from benchmarks.slow_link import SlowLink

    endpoint = free_endpoint()
    with monitor(PublishSettings(listen=(endpoint,))):
        link = SlowLink(endpoint)
        with client(link.endpoint) as hears:
            wait_until(some_usable(hears), "a transform")
            link.bytes_per_s = bytes_per_s
            rows = polled(hears, 6.0)
            none_is_old(rows)
            oldest_s = max(row.true_age_s for row in rows)
            assert (oldest_s > 1.0) == (bytes_per_s < RATE_PER_S * 2900)  # the link did hold them up
            assert any(row.reading.why is Unusable.STALE for row in rows) == (oldest_s > 1.0)
            link.bytes_per_s = None
            wait_until(some_usable(hears), "the link's recovery", 10.0)
        none_is_old(hears.told)
        link.close()


def test_a_client_that_begins_on_a_slow_link_trusts_no_first_message():
    """None that it ever saw was fast: the smallest time from stamp to arrival is one of a message that waited."""
    from benchmarks.slow_link import SlowLink

    endpoint = free_endpoint()
    with monitor(PublishSettings(listen=(endpoint,)), ahead_ns=-7200 * 10**9):
        link = SlowLink(endpoint)
        link.bytes_per_s = 30e3
        with client(link.endpoint) as hears:
            rows = [row._replace(true_age_s=row.true_age_s - 7200.0) for row in polled(hears, 6.0)]
            assert max(row.true_age_s for row in rows if row.reading.seq >= 0) > 1.0
            none_is_old([row for row in rows if row.reading.seq >= 0])
        link.close()


@pytest.mark.parametrize("ahead_s", [-36_000, 36_000, 315_360_000])
def test_clocks_that_are_hours_or_years_apart_change_nothing(ahead_s: int):
    endpoint = free_endpoint()
    with monitor(PublishSettings(listen=(endpoint,)), ahead_ns=ahead_s * 10**9), client(endpoint) as hears:
        wait_until(some_usable(hears), "a transform")
        rows = [row._replace(true_age_s=row.true_age_s + ahead_s) for row in polled(hears, 1.0)]
        none_is_old(rows)
        assert sum(row.reading.usable for row in rows) > 0.5 * len(rows)
        why = Unusable.STALE if ahead_s < 0 else Unusable.CLOCKS
        agreed = polled(hears, 0.2, Policy(clocks_agree=True))
        assert {row.reading.why for row in agreed} == {why}


def test_a_router_that_hangs_and_goes_on_makes_nothing_old_usable(tmp_path: Path):
    endpoint = free_endpoint()
    config = router_process.plain_config(tmp_path, endpoint)
    settings = PublishSettings(mode="client", connect=(endpoint,))
    with router_process.running(config, endpoint) as router, monitor(settings), client(endpoint) as hears:
        wait_until(some_usable(hears), "a transform")
        assert router.process is not None
        for stopped_s in (0.5, 5.0):
            os.kill(router.process.pid, signal.SIGSTOP)
            try:
                rows = polled(hears, stopped_s)
            finally:
                with suppress(ProcessLookupError):
                    os.kill(router.process.pid, signal.SIGCONT)
            rows += polled(hears, 2.5)
            none_is_old(rows)
            assert max(row.true_age_s for row in rows) > stopped_s - 0.2  # it did hang
            wait_until(some_usable(hears), "the router's recovery", 10.0)
        none_is_old(hears.told)
        assert sum(told.reading.usable for told in hears.told) > RATE_PER_S
