"""The session of a process: whom it misses, and that it outlives its router."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from support.loopback import free_endpoint, plain_session, wait_until
from support.router_process import RouterProcess, plain_config, running

from gripmon.io.wire import Link, PublishSettings
from gripmon.io.wire.link import is_at


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def router(tmp_path: Path, endpoint: str) -> Iterator[RouterProcess]:
    with running(plain_config(tmp_path, endpoint), endpoint) as started:
        yield started


@pytest.mark.parametrize("mode", ["peer", "client"])
def test_whom_it_misses_is_said_at_the_start_and_later(router: RouterProcess, endpoint: str, mode: str):
    router.kill()
    link = Link(PublishSettings(mode=mode, listen=(), connect=(endpoint,)))  # type: ignore[arg-type]
    try:
        wait_until(lambda: "trying again" in link.fault(), "the fault at the start")
        router.start()
        wait_until(lambda: link.fault() == "", "the connection")
        router.kill()
        wait_until(lambda: link.fault() == f"no connection to {endpoint}, trying again", "the fault later")
        router.start()
        wait_until(lambda: link.fault() == "", "the new connection")
    finally:
        link.close()
    assert link.fault() == ""


def test_a_peer_misses_each_endpoint_by_itself(router: RouterProcess, endpoint: str):
    nobody, own = free_endpoint(), free_endpoint()
    link = Link(PublishSettings(listen=(own,), connect=(endpoint, nobody)))
    try:
        with plain_session(connect=own):  # someone who comes in is no one of those who are called
            wait_until(lambda: link.fault() == f"no connection to {nobody}, trying again", "the one that is missing")
    finally:
        link.close()


def test_a_peer_that_is_to_connect_to_nobody_misses_nobody(endpoint: str):
    link = Link(PublishSettings(listen=(endpoint,)))
    try:
        assert link.fault() == ""
    finally:
        link.close()


@pytest.mark.parametrize(
    ("locator", "endpoint", "expected"),
    [
        ("tcp/127.0.0.1:7447", "tcp/127.0.0.1:7447", True),
        ("tcp/127.0.0.1:7447", "tcp/127.0.0.1:7447#iface=lo", True),
        ("tcp/127.0.0.1:7447", "tcp/localhost:7447", True),
        ("tcp/127.0.0.1:7447", "tls/localhost:7447", False),
        ("tcp/127.0.0.1:7447", "tcp/127.0.0.2:7447", False),
        ("tcp/127.0.0.1:57447", "tcp/localhost:7447", False),
        ("tcp/[::1]:7447", "tcp/[::1]:7447", True),
        ("tcp/[::1]:7447", "tcp/[::2]:7447", False),
        ("unixsock-stream/tmp/a", "unixsock-stream/tmp/a", True),
        ("unixsock-stream/tmp/a", "unixsock-stream/tmp/b", False),
    ],
)
def test_which_far_end_is_which_endpoint(locator: str, endpoint: str, expected: bool):
    assert is_at(locator, endpoint) is expected
