"""Readers of the controller's client beside each other: slow ones, ended ones, and some that close it."""

from __future__ import annotations

import asyncio
import gc
import threading
from collections.abc import Callable, Iterator

import pytest
from support.loopback import WAIT_S, frame_record, free_endpoint, wait_until
from support.published import Published

from gripmon.client import Policy, Reading, TransformClient, Unusable
from gripmon.io.wire import PublishSettings
from gripmon.model.records import Verdict

PATIENT = Policy(max_age_s=3600.0)


@pytest.fixture
def publisher() -> Iterator[Published]:
    made = Published(PublishSettings(listen=(free_endpoint(),)), "arm", "wrist")
    yield made
    made.close()


@pytest.fixture
def join(publisher: Published) -> Iterator[Callable[..., TransformClient]]:
    """Makes clients that hear the publisher."""
    made: list[TransformClient] = []

    def make(**options: object) -> TransformClient:
        endpoint = publisher.link.settings.listen[0]
        made.append(TransformClient("arm", connect=[endpoint], policy=PATIENT, **options))  # type: ignore[arg-type]
        put(publisher, 0, made)
        return made[-1]

    yield make
    for client in made:
        client.close()


def put(publisher: Published, seq: int, clients: list[TransformClient]) -> None:
    """Publish until all have it; numbers below it stay below it."""

    def attempt() -> bool:
        publisher.transform(frame_record(seq))
        return all(client.latest().seq == seq for client in clients)

    wait_until(attempt, f"frame {seq}")


@pytest.mark.parametrize("depth", [1, 3])
def test_a_slow_reader_gets_the_newest_of_its_depth_in_order(
    publisher: Published, join: Callable[..., TransformClient], depth: int
):
    client = join(depth=depth)
    readings = iter(client)
    for seq in range(1, 21):
        put(publisher, seq, [client])
    seqs = [next(readings).seq]
    while seqs[-1] != 20:
        seqs.append(next(readings).seq)
    assert seqs == sorted(seqs) and len(seqs) <= depth + 1  # one more may come between the last put and the first read
    assert client.latest().seq == 20


def test_every_reader_has_a_queue_of_its_own(publisher: Published, join: Callable[..., TransformClient]):
    client = join(depth=4096)
    first, second = iter(client), iter(client)
    told: list[Reading] = []
    client.on_transform(told.append)
    for seq in range(1, 6):
        put(publisher, seq, [client])
    for readings in (first, second):
        seqs = {next(readings).seq}
        while 5 not in seqs:
            seqs.add(next(readings).seq)
        assert seqs >= {1, 2, 3, 4, 5}
    wait_until(lambda: told and told[-1].seq == 5, "the callback")
    assert {reading.seq for reading in told} >= {1, 2, 3, 4, 5}


def test_readers_that_are_let_go_or_whose_loop_has_ended_hold_nobody_up(
    publisher: Published, join: Callable[..., TransformClient]
):
    client = join()

    async def one() -> object:
        readings = aiter(client)
        publisher.transform(frame_record(1))
        await anext(readings)
        return readings

    kept = asyncio.run(one())  # its loop is closed, and it is still there
    iter(client)
    gc.collect()
    fresh = iter(client)
    put(publisher, 2, [client])
    assert next(fresh).seq == 2
    assert kept is not None


def test_a_callback_may_close_its_client(publisher: Published, join: Callable[..., TransformClient]):
    client, closed = join(), threading.Event()

    def close(_: Reading) -> None:
        client.close()
        closed.set()

    client.on_transform(close)
    wait_until(lambda: publisher.transform(frame_record(1)) or closed.is_set(), "the callback")
    assert client.closed and not client.latest().usable and client.latest().reason == "the client is closed"
    assert list(client) == []


def test_two_callbacks_that_close_do_not_wait_for_each_other(
    publisher: Published, join: Callable[..., TransformClient]
):
    client, both, closed = join(), threading.Barrier(2), []

    def close(_: Reading) -> None:
        both.wait(WAIT_S)
        client.close()
        closed.append(threading.current_thread())

    client.on_transform(close)
    client.on_transform(close)
    wait_until(lambda: publisher.transform(frame_record(1)) or len(closed) == 2, "both to have closed it")


def test_a_callback_that_fails_ends_alone(
    publisher: Published, join: Callable[..., TransformClient], monkeypatch: pytest.MonkeyPatch
):
    client = join()
    said: list[object] = []
    monkeypatch.setattr(threading, "excepthook", lambda problem: said.append(problem.exc_value))
    told: list[int] = []
    client.on_transform(lambda reading: 1 / 0)  # type: ignore[arg-type,return-value]
    client.on_transform(lambda reading: told.append(reading.seq))
    put(publisher, 1, [client])
    wait_until(lambda: said and told, "both callbacks")
    before = len(told)
    put(publisher, 2, [client])
    wait_until(lambda: told[before:] and told[-1] == 2, "the other one")
    assert [type(problem) for problem in said] == [ZeroDivisionError]


def test_closing_ends_every_wait(join: Callable[..., TransformClient]):
    client = join()
    waiting = [threading.Thread(target=list, args=(iter(client),)) for _ in range(3)]
    for thread in waiting:
        thread.start()
    client.close()
    client.close()
    for thread in waiting:
        thread.join(WAIT_S)
    assert not any(thread.is_alive() for thread in waiting)


def test_an_iterator_says_that_nobody_has_the_name_and_who_is_there(publisher: Published):
    with TransformClient("arm1", connect=publisher.link.settings.listen) as wrong:
        reading = next(iter(wrong))
        assert reading.why is Unusable.NOTHING_YET and reading.verdict is Verdict.UNKNOWN
        assert reading.reason == "no transform came yet, and no monitor of this name is seen; there are arm/wrist"
        told: list[Reading] = []
        wrong.on_transform(told.append)
        wait_until(lambda: told, "the callback")
        assert [each.why for each in told] == [Unusable.NOTHING_YET]


def test_an_asynchronous_iterator_says_it_too(publisher: Published):
    async def first() -> Reading:
        with TransformClient("arm1", connect=publisher.link.settings.listen) as wrong:
            return await anext(aiter(wrong))

    assert asyncio.run(first()).reason.endswith("; there are arm/wrist")


def test_an_iterator_says_whom_there_is_no_connection_to():
    with TransformClient("arm", connect=[free_endpoint()]) as alone:
        assert next(iter(alone)).why is Unusable.NOT_CONNECTED


def test_an_iterator_that_has_said_so_waits_on(publisher: Published):
    with TransformClient("arm", connect=publisher.link.settings.listen) as client:
        readings = iter(client)
        said = next(readings)
        assert said.why is Unusable.NOTHING_YET and said.reason == "no transform came yet"
        threading.Timer(0.5, lambda: publisher.transform(frame_record(4))).start()
        assert next(readings).seq == 4
