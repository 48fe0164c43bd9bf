"""One monitor's messages as they come, and who is there: a real publisher in this process, and a plain session."""

from __future__ import annotations

import json
import os
import signal
import threading
from collections.abc import Callable, Iterator
from functools import partial

import pytest
from support.loopback import frame_record, free_endpoint, plain_session, reference_record, state_record, wait_until
from support.published import Published

from gripmon.client import Fleet, MonitorName, NotCarriedOut, Policy, TransformClient, Unusable
from gripmon.io.wire import PublishError, PublishSettings
from gripmon.model.records import CommandName, FrameRecord

PATIENT = Policy(max_age_s=3600.0)


@pytest.fixture
def client(publisher: Published, endpoint: str) -> Iterator[TransformClient]:
    with TransformClient("arm", connect=[endpoint], policy=PATIENT) as made:
        wait_until(made.alive, "the client to find the monitor")
        yield made


def put_until(publisher: Published, record: FrameRecord, arrived: Callable[[], object]) -> None:
    """Publish again and again until the subscription works."""

    def attempt() -> object:
        publisher.transform(record)
        return arrived()

    wait_until(attempt, "a transform")


def test_the_newest_record_is_there_as_it_came_and_stays(publisher: Published, client: TransformClient):
    assert client.latest().record is None
    for seq in range(100):
        publisher.transform(frame_record(seq))
    put_until(publisher, frame_record(99), lambda: client.latest().seq == 99)  # again: a burst may lose some
    assert client.latest().record == frame_record(99)


def test_callbacks_get_every_record_and_end_with_the_client(publisher: Published, endpoint: str):
    seqs: list[int] = []
    with TransformClient("arm", connect=[endpoint], depth=64, policy=PATIENT) as client:
        client.on_transform(lambda reading: seqs.append(reading.seq))
        put_until(publisher, frame_record(0), lambda: seqs and seqs[-1] == 0)
        for seq in range(1, 20):
            put_until(publisher, frame_record(seq), lambda seq=seq: seqs[-1] == seq)
    assert sorted(set(seqs) - {-1}) == list(range(20)) and seqs == sorted(seqs)
    assert [thread for thread in threading.enumerate() if thread.name == "gripmon-client"] == []


def test_state_and_reference(publisher: Published, client: TransformClient):
    assert client.state() is None and client.reference() is None
    publisher.event(state_record(3))
    publisher.event(reference_record(2))
    assert client.state() == state_record(3)
    assert client.reference() == reference_record(2)


def test_a_client_may_come_before_its_monitor_and_outlive_it(endpoint: str):
    with TransformClient("arm", connect=[endpoint]) as client:
        for seq in (1, 2):
            assert client.alive(0.2) == ()
            publisher = Published(PublishSettings(listen=(endpoint,)), "arm", "wrist")
            try:
                put_until(
                    publisher, frame_record(seq), lambda seq=seq: client.latest().seq == seq
                )
                assert client.alive() == (MonitorName("arm", "wrist"),)
            finally:
                publisher.close()
            wait_until(lambda: not client.alive(0.2), "the token to vanish")


def test_a_second_camera_must_be_told_apart(publisher: Published, endpoint: str):
    second_endpoint = free_endpoint()
    second = Published(PublishSettings(listen=(second_endpoint,)), "arm", "elbow")
    try:
        with TransformClient("arm", connect=[endpoint, second_endpoint]) as client:
            wait_until(lambda: len(client.alive()) == 2, "both monitors")
            assert client.alive() == (MonitorName("arm", "elbow"), MonitorName("arm", "wrist"))
            second.event(state_record())
            publisher.event(state_record())
            with pytest.raises(LookupError, match=r"^arm/\* is more than one monitor: arm/\w+, arm/\w+; name the one$"):
                client.state()
        with TransformClient("arm", "wrist", connect=[endpoint, second_endpoint]) as named:
            wait_until(named.alive, "the named one")
            second.transform(frame_record(100))
            put_until(publisher, frame_record(2), lambda: named.latest().seq >= 0)
            assert named.latest().seq == 2
            assert named.alive() == (MonitorName("arm", "wrist"),)
    finally:
        second.close()


def test_in_a_forked_process_everything_says_so_and_nothing_hangs(
    publisher: Published, client: TransformClient, endpoint: str
):
    """``multiprocessing`` forks by default on Python 3.11; Zenoh's threads don't come along."""
    put_until(publisher, frame_record(1), lambda: client.latest().usable)
    with Fleet(connect=[endpoint]) as fleet:
        reads, writes = os.pipe()
        child = os.fork()
        if child == 0:
            signal.alarm(20)
            reading = client.latest()
            said = [reading.why, reading.reason, len(list(client)), client.closed, fleet.fault()]
            undo = partial(fleet.send, MonitorName("arm", "wrist"), CommandName.UNDO)
            for call in (client.state, client.alive, undo, fleet.monitors):
                try:
                    call()
                except NotCarriedOut as error:
                    said.append(str(error))
            client.close()
            fleet.close()
            os.write(writes, json.dumps(said).encode())
            os._exit(0)
        os.close(writes)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        with os.fdopen(reads) as pipe:
            said = json.load(pipe)
    why = "this process was forked from the one that opened the client; open another one here"
    assert said == [Unusable.CLOSED, why, 0, True, why, why, why, why, why]
    put_until(publisher, frame_record(2), lambda: client.latest().seq == 2 and client.latest().usable)


@pytest.mark.parametrize("names", [("a/b", None), ("arm", "a b"), ("", None)])
def test_bad_names_are_refused(names: tuple[str, str | None]):
    with pytest.raises(ValueError, match="can't be part of a Zenoh key"):
        TransformClient(*names)


def test_a_bad_endpoint_is_refused():
    with pytest.raises(PublishError, match=r"^connect: 'nonsense' is not an endpoint; protocol/host:port, e.g. tcp/"):
        TransformClient("arm", connect=["nonsense"])


def test_a_text_is_one_endpoint():
    endpoint = free_endpoint()
    with plain_session(listen=endpoint, mode="peer") as other, TransformClient("arm", "wrist", connect=endpoint):
        wait_until(lambda: list(other.info.peers_zid()), "the connection")
    with pytest.raises(PublishError, match=r"^connect: 'tcp/127.0.0.1:70000' is not an endpoint; "):
        TransformClient("arm", connect="tcp/127.0.0.1:70000")
