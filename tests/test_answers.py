"""Replies to an asker that doesn't read hold up no one: neither the loop, nor Zenoh's threads, nor other replies."""

from __future__ import annotations

import contextlib
import json
import threading
from collections.abc import Iterator

import pytest
import zenoh
from support.loopback import WAIT_S, ask, frame_record, free_endpoint, plain_session, wait_until
from support.published import Published

from gripmon.io.publish.commands import PendingCommand, _reply
from gripmon.io.publish.presence import _WAITING_MOST, Answers
from gripmon.io.wire import PublishSettings
from gripmon.model.records import Command, CommandError, CommandName, CommandReply


class StalledQuery:
    """A query whose asker was stopped: a reply to it comes back only when the link is given up."""

    key_expr = "gripmon/arm/wrist/cmd/undo"

    def __init__(self) -> None:
        self.begun, self.given_up = threading.Event(), threading.Event()
        self.dropped = False
        self.parameters: dict[str, str] = {}
        self.payloads: list[bytes] = []

    def reply(self, key: str, payload: bytes, **how: object) -> None:
        self.begun.set()
        assert self.given_up.wait(WAIT_S)
        self.payloads.append(payload)

    reply_err = reply

    def drop(self) -> None:
        self.dropped = True


@pytest.fixture
def stalled() -> Iterator[StalledQuery]:
    made = StalledQuery()
    yield made
    made.given_up.set()


REPLY = CommandReply(CommandName.UNDO, True, "so be it", "plate-2", 4)


def test_the_loop_does_not_wait_for_an_asker_that_does_not_read(stalled: StalledQuery):
    """If it did, this test would end only with the link: the reply comes back when the test lets it."""
    answers = Answers("test")
    pending = PendingCommand(Command(CommandName.UNDO), 1000.0)

    def tell(answer: CommandReply | CommandError, _attachment: bytes | None) -> None:
        answers.send(stalled, _reply("a/key", answer, ""))  # type: ignore[arg-type]

    assert pending.wait(tell) and pending.take()
    pending.answer(REPLY)
    assert stalled.begun.wait(WAIT_S) and not stalled.given_up.is_set() and not stalled.payloads
    stalled.given_up.set()
    wait_until(lambda: stalled.dropped, "the end of the query")
    assert [json.loads(payload)["text"] for payload in stalled.payloads] == ["so be it"]
    answers.close()


def test_zenohs_thread_does_not_wait_for_a_late_joiner_that_does_not_read(stalled: StalledQuery):
    endpoint = free_endpoint()
    publisher = Published(PublishSettings(listen=(endpoint,)), "arm", "wrist")
    try:
        publisher.transform(frame_record(5))
        publisher._wire.puts["transform"].__self__._answer(stalled)  # type: ignore[union-attr, arg-type]
        assert stalled.begun.wait(WAIT_S) and not stalled.payloads
        with plain_session(connect=endpoint) as session:
            assert [record["seq"] for record in ask(session, "gripmon/arm/wrist/transform")] == [5]
    finally:
        stalled.given_up.set()
        publisher.close()


def test_when_too_many_wait_a_query_ends_unanswered(stalled: StalledQuery):
    answers = Answers("test")
    for _ in range(_WAITING_MOST):
        answers.send(stalled, lambda query: query.reply("", b""))  # type: ignore[arg-type]
    one_more = StalledQuery()
    answers.send(one_more, lambda query: query.reply("", b""))  # type: ignore[arg-type]
    assert one_more.dropped and not one_more.begun.is_set()
    stalled.given_up.set()
    wait_until(lambda: len(stalled.payloads) == _WAITING_MOST, "all others")
    answers.close()


def test_when_too_many_wait_the_others_are_told_so(stalled: StalledQuery):
    answers = Answers("test", lambda query: query.reply_err("", b"busy"))  # type: ignore[arg-type]
    for _ in range(_WAITING_MOST):
        answers.send(stalled, lambda query: query.reply("", b""))  # type: ignore[arg-type]
    more = [StalledQuery() for _ in range(500)]
    for query in more:
        query.given_up.set()
        answers.send(query, lambda query: query.reply("", b""))  # type: ignore[arg-type]
    wait_until(lambda: all(query.dropped for query in more), "all to be told")
    assert all(query.payloads == [b"busy"] for query in more) and not stalled.payloads
    stalled.given_up.set()
    wait_until(lambda: len(stalled.payloads) == _WAITING_MOST, "all others")
    answers.close()


def test_a_flood_of_commands_is_answered_to_the_last_one():
    """No one carries anything out: some wait until their time is over, all others hear that it is busy."""
    endpoint = free_endpoint()
    publisher = Published(PublishSettings(listen=(endpoint,)), "arm", "wrist")
    answered: list[str] = []
    try:
        with plain_session(connect=endpoint) as session:

            def take(reply: zenoh.Reply) -> None:
                assert reply.err is not None
                answered.append(json.loads(reply.err.payload.to_bytes())["error"])

            for _ in range(3000):
                session.get(
                    "gripmon/arm/wrist/cmd/undo", zenoh.handlers.Callback(take, indirect=False), timeout=2.0 * WAIT_S
                )
            wait_until(lambda: len(answered) == 3000, "an answer to each")
    finally:
        publisher.close()
    assert set(answered) == {"busy", "timeout"} and answered.count("timeout") < 100


def test_close_completes_what_is_under_way_and_ends_the_threads(stalled: StalledQuery, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("gripmon.io.publish.presence.CLOSE_WITHIN_S", WAIT_S)  # a slow machine's second is short
    before = set(threading.enumerate())
    answers = Answers("test")
    answers.send(stalled, lambda query: query.reply("", b"in time"))  # type: ignore[arg-type]
    assert stalled.begun.wait(WAIT_S)
    threading.Timer(0.1, stalled.given_up.set).start()
    answers.close()
    later = StalledQuery()
    later.given_up.set()
    answers.send(later, lambda query: query.reply("", b"after all"))  # type: ignore[arg-type]
    assert (stalled.payloads, later.payloads, later.dropped) == ([b"in time"], [b"after all"], True)
    wait_until(lambda: set(threading.enumerate()) <= before, "the threads to end")


def test_an_asker_that_is_gone_is_no_error():
    answers, query = Answers("test"), StalledQuery()

    def gone(_: object) -> None:
        raise zenoh.ZError("session closed")

    with contextlib.closing(answers):
        answers.send(query, gone)  # type: ignore[arg-type]
        wait_until(lambda: query.dropped, "the end of the query")
