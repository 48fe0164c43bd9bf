"""The client for controllers, against a real publisher in this process and raw messages from a plain session."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

import pytest
from support.loopback import frame_record, free_endpoint, plain_session, reference_record, state_record, wait_until
from support.published import Published

from gripmon.client import Client, MonitorName, TransformClient
from gripmon.io.wire import PublishError, PublishSettings
from gripmon.model.records import FrameRecord, MessageRefused


@pytest.fixture
def client(publisher: Published, endpoint: str) -> Iterator[Client]:
    with Client("arm", connect=[endpoint]) as made:
        wait_until(made.alive, "the client to find the monitor")
        yield made


def put_until(publisher: Published, record: FrameRecord, arrived: Callable[[], object]) -> None:
    """Publish again and again until the subscription works."""

    def attempt() -> object:
        publisher.transform(record)
        return arrived()

    wait_until(attempt, "a transform")


def test_latest_is_the_newest_record_and_stays(publisher: Published, client: Client):
    assert client.latest() is None
    put_until(publisher, frame_record(0), client.latest)
    for seq in range(1, 100):
        publisher.transform(frame_record(seq))
    put_until(publisher, frame_record(99), lambda: client.latest().seq == 99)  # again: a burst may lose some
    assert client.latest() == frame_record(99)


def test_iteration_ends_when_the_client_is_closed(publisher: Published, endpoint: str):
    client = Client("arm", connect=[endpoint])
    seqs: list[int] = []

    def read() -> None:
        for record in client:
            seqs.append(record.seq)  # noqa: PERF401  seen from outside while it goes on

    reader = threading.Thread(target=read)
    reader.start()
    put_until(publisher, frame_record(5), lambda: seqs)
    client.close()
    reader.join(60.0)
    assert not reader.is_alive()
    assert set(seqs) <= {5}


def test_callbacks_get_every_record_and_end_with_the_client(publisher: Published, endpoint: str):
    before = set(threading.enumerate())
    seqs: list[int] = []
    with Client("arm", connect=[endpoint], depth=64) as client:
        client.on_transform(lambda record: seqs.append(record.seq))
        put_until(publisher, frame_record(0), lambda: seqs)
        for seq in range(1, 20):
            put_until(publisher, frame_record(seq), lambda seq=seq: seqs[-1] == seq)
    assert sorted(set(seqs)) == list(range(20)) and seqs == sorted(seqs)
    assert set(threading.enumerate()) == before


def test_state_and_reference(publisher: Published, client: Client):
    assert client.state() is None and client.reference() is None
    publisher.event(state_record(3))
    publisher.event(reference_record(2))
    assert client.state() == state_record(3)
    assert client.reference() == reference_record(2)


def test_a_client_may_come_before_its_monitor_and_outlive_it(endpoint: str):
    with Client("arm", connect=[endpoint]) as client:
        for seq in (1, 2):
            assert client.alive(0.2) == ()
            publisher = Published(PublishSettings(listen=(endpoint,)), "arm", "wrist")
            try:
                put_until(
                    publisher, frame_record(seq), lambda seq=seq: (r := client.latest()) is not None and r.seq == seq
                )
                assert client.alive() == (MonitorName("arm", "wrist"),)
            finally:
                publisher.close()
            wait_until(lambda: not client.alive(0.2), "the token to vanish")


def test_a_second_camera_must_be_told_apart(publisher: Published, endpoint: str):
    second_endpoint = free_endpoint()
    second = Published(PublishSettings(listen=(second_endpoint,)), "arm", "elbow")
    try:
        with Client("arm", connect=[endpoint, second_endpoint]) as client:
            wait_until(lambda: len(client.alive()) == 2, "both monitors")
            assert client.alive() == (MonitorName("arm", "elbow"), MonitorName("arm", "wrist"))
            second.event(state_record())
            publisher.event(state_record())
            with pytest.raises(LookupError, match=r"^arm/\* is more than one monitor: arm/\w+, arm/\w+; name the one$"):
                client.state()
        with Client("arm", "wrist", connect=[endpoint, second_endpoint]) as named:
            wait_until(named.alive, "the named one")
            second.transform(frame_record(100))
            put_until(publisher, frame_record(2), named.latest)
            assert named.latest().seq == 2
            assert named.alive() == (MonitorName("arm", "wrist"),)
    finally:
        second.close()


def test_a_message_that_is_no_record_is_an_error(publisher: Published, client: Client, endpoint: str):
    put_until(publisher, frame_record(1), client.latest)
    with plain_session(connect=endpoint) as session:
        session.put("gripmon/arm/wrist/transform", '{"seq": "one"}')

        def broken() -> bool:
            try:
                client.latest()
            except MessageRefused:
                return True
            return False

        wait_until(broken, "the malformed message")
        assert client.latest() == frame_record(1)  # said once; what was there stays


@pytest.mark.parametrize("names", [("a/b", None), ("arm", "a b"), ("", None)])
def test_bad_names_are_refused(names: tuple[str, str | None]):
    with pytest.raises(ValueError, match="can't be part of a Zenoh key"):
        Client(*names)


def test_a_bad_endpoint_is_refused():
    with pytest.raises(PublishError, match=r"^connect: 'nonsense' is not an endpoint; protocol/address, e.g. tcp/"):
        Client("arm", connect=["nonsense"])


@pytest.mark.parametrize("kind", [Client, TransformClient])
def test_a_text_is_one_endpoint(kind: type[Client] | type[TransformClient]):
    endpoint = free_endpoint()
    with plain_session(listen=endpoint, mode="peer") as other, kind("arm", "wrist", connect=endpoint):
        wait_until(lambda: list(other.info.peers_zid()), "the connection")
    with pytest.raises(PublishError, match=r"^connect: tcp/127.0.0.1:70000: 70000 can't be a port; a whole"):
        kind("arm", connect="tcp/127.0.0.1:70000")
