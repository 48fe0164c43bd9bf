"""The same request sent again: answered again, and carried out once."""

from __future__ import annotations

import contextlib
import json
import re
import threading
from collections import Counter

import pytest
import zenoh
from support.commanded import CMD, Loop, answers, reply_to
from support.loopback import plain_session, wait_until
from support.published import Published

from gripmon.cli import main
from gripmon.client import Client, NotCarriedOut
from gripmon.io.publish.commands import ZenohCommands
from gripmon.io.wire import Keys, Link, PublishSettings
from gripmon.model.records import Command, CommandFault, CommandName, CommandReply


def asked_with(request_id: str, argument: str = "") -> bytes:
    return json.dumps({"id": request_id, "argument": argument}).encode()


def test_a_request_that_is_sent_again_gets_the_same_answer_and_is_carried_out_once(session: zenoh.Session, loop: Loop):
    first, again, later = (answers(session, f"{CMD}/undo", asked_with(i, "p-1")) for i in ("a", "a", "b"))
    assert first == again == later and first[0][0]
    assert loop.heard == [Command(CommandName.UNDO, "p-1")] * 2


@pytest.mark.parametrize("payload", [None, b'{"id": ""}'])
def test_without_an_id_every_request_is_a_new_one(session: zenoh.Session, loop: Loop, payload: bytes | None):
    for _ in range(3):
        answers(session, f"{CMD}/undo", payload)
    assert loop.heard == [Command(CommandName.UNDO)] * 3


@pytest.mark.parametrize("name", [CommandName.STATE, CommandName.SNAPSHOT])
def test_questions_are_answered_anew(session: zenoh.Session, loop: Loop, name: CommandName):
    for _ in range(2):
        answers(session, f"{CMD}/{name}", asked_with("a"))
    assert loop.heard == [Command(name)] * 2


def test_a_refusal_is_remembered_too(session: zenoh.Session, loop: Loop):
    first, again = (answers(session, f"{CMD}/undo", asked_with("a", "no")) for _ in range(2))
    assert first == again and first[0][1]["done"] is False
    assert len(loop.heard) == 1


@pytest.mark.parametrize(("name", "argument"), [("reset", ""), ("undo", "p-2")])
def test_an_id_stands_for_one_command(session: zenoh.Session, loop: Loop, name: str, argument: str):
    answers(session, f"{CMD}/undo", asked_with("a"))
    [(is_reply, error)] = answers(session, f"{CMD}/{name}", asked_with("a", argument))
    assert not is_reply and error["error"] == "id_reused" and "that of another command, undo" in str(error["text"])
    assert loop.heard == [Command(CommandName.UNDO)]


def test_who_asks_again_while_it_is_under_way_waits_for_the_same_answer(publisher: Published, session: zenoh.Session):
    go_on = threading.Event()

    def slow(command: Command) -> CommandReply:
        go_on.wait(20.0)
        return reply_to(command)

    loop = Loop(publisher.commands, slow)
    replies = [session.get(f"{CMD}/undo", payload=asked_with("a"), timeout=20.0) for _ in range(3)]
    wait_until(lambda: loop.heard, "the command to be taken")
    go_on.set()
    texts = [json.loads(reply.ok.payload.to_bytes())["text"] for waiting in replies for reply in waiting]
    loop.end()
    assert texts == ["heard ''"] * 3
    assert loop.heard == [Command(CommandName.UNDO)]


def test_those_who_ask_again_while_nobody_answers_are_bounded(publisher: Published, session: zenoh.Session):
    """Each of them costs a thread until its time is over."""
    before = threading.active_count()
    replies = [session.get(f"{CMD}/undo", payload=asked_with("a"), timeout=20.0) for _ in range(60)]
    errors = [json.loads(reply.err.payload.to_bytes()) for waiting in replies for reply in waiting]
    assert threading.active_count() < before + 30
    assert Counter(error["error"] for error in errors) == {"timeout": 16, "busy": 44}


def test_after_a_time_out_the_answer_can_still_be_had(endpoint: str):
    """The loop was held up for longer than an asker waits: the same id brings what became of it."""
    link = Link(PublishSettings(listen=(endpoint,)))
    commands = ZenohCommands(link, Keys("arm", "wrist"), timeout_s=0.1)
    go_on = threading.Event()

    def slow(command: Command) -> CommandReply:
        go_on.wait(20.0)
        return reply_to(command)

    with contextlib.closing(link), plain_session(connect=endpoint) as session:
        loop = Loop(commands, slow)
        wait_until(lambda: answers(session, f"{CMD}/undo", asked_with("a"))[0][1].get("error") == "timeout", "time-out")
        wait_until(lambda: loop.heard, "the command to be taken")
        assert answers(session, f"{CMD}/undo", asked_with("a"))[0][1]["error"] == "timeout"
        go_on.set()
        wait_until(lambda: answers(session, f"{CMD}/undo", asked_with("a"))[0][0], "the answer")
        loop.end()
    assert loop.heard == [Command(CommandName.UNDO)]


def test_what_was_given_up_before_it_was_carried_out_may_be_asked_for_again(endpoint: str):
    link = Link(PublishSettings(listen=(endpoint,)))
    commands = ZenohCommands(link, Keys("arm", "wrist"), timeout_s=0.1)
    with contextlib.closing(link), plain_session(connect=endpoint) as session:
        [(_, error)] = answers(session, f"{CMD}/undo", asked_with("a"))
        assert str(error["text"]).endswith("it is not carried out")
        assert commands.poll() is None
        loop = Loop(commands, reply_to)
        wait_until(lambda: answers(session, f"{CMD}/undo", asked_with("a"))[0][0], "the answer")
        loop.end()
    assert loop.heard == [Command(CommandName.UNDO)]


def test_the_memory_of_answers_is_bounded(session: zenoh.Session, loop: Loop):
    for i in range(257):
        answers(session, f"{CMD}/undo", asked_with(f"id-{i}"))
    answers(session, f"{CMD}/undo", asked_with("id-1"))
    assert len(loop.heard) == 257, "the newest 256 are remembered"
    answers(session, f"{CMD}/undo", asked_with("id-0"))
    assert len(loop.heard) == 258, "one more is not"


def test_the_client_makes_a_new_id_each_time_and_takes_an_old_one(publisher: Published, loop: Loop, endpoint: str):
    with Client("arm", connect=[endpoint]) as client:
        client.send(CommandName.UNDO)
        client.send(CommandName.UNDO)
        assert len(loop.heard) == 2
        first = client.send(CommandName.UNDO, request_id="mine")
        assert client.send(CommandName.UNDO, request_id="mine") == first
        assert len(loop.heard) == 3
        with pytest.raises(ValueError, match="length <= 64"):
            client.send(CommandName.UNDO, request_id="x" * 65)


def test_the_client_sees_that_the_time_is_over_and_can_ask_again(publisher: Published, endpoint: str):
    go_on = threading.Event()

    def slow(command: Command) -> CommandReply:
        go_on.wait(20.0)
        return reply_to(command)

    loop = Loop(publisher.commands, slow)
    with Client("arm", connect=[endpoint]) as client:
        wait_until(client.alive, "the monitor")
        with pytest.raises(NotCarriedOut, match="has not answered in time; it may still do it") as caught:
            client.send(CommandName.UNDO, timeout_s=0.2)
        assert caught.value.fault is CommandFault.TIMEOUT
        go_on.set()
        assert client.send(CommandName.UNDO, request_id=caught.value.request_id).done
    loop.end()
    assert loop.heard == [Command(CommandName.UNDO)]


def test_send_says_the_request_that_got_no_answer_and_takes_it_again(
    publisher: Published, endpoint: str, capsys: pytest.CaptureFixture[str]
):
    go_on = threading.Event()

    def slow(command: Command) -> CommandReply:
        go_on.wait(20.0)
        return reply_to(command)

    loop = Loop(publisher.commands, slow)
    undo = ["send", "undo", "p-1", "--robot", "arm", "--camera", "wrist", "--connect", endpoint]
    assert main([*undo, "--timeout", "1"]) == 3
    line = capsys.readouterr().err.strip()
    said = re.fullmatch(
        r"send: arm/wrist has not answered in time; it may still do it \(--request ([0-9a-f]{32})\)", line
    )
    assert said is not None, line
    go_on.set()
    assert main([*undo, "--request", said[1]]) == 0
    assert capsys.readouterr().out == "heard 'p-1'\n"
    assert main([*undo, "--request", "x" * 65]) == 2
    assert "length <= 64" in capsys.readouterr().err
    loop.end()
    assert loop.heard == [Command(CommandName.UNDO, "p-1")]
