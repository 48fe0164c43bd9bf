"""Commands over a real Zenoh session: a publisher in this process, plain sessions and the client as askers."""

from __future__ import annotations

import contextlib
import json
import threading

import msgspec
import pytest
import zenoh
from support.commanded import CMD, Loop, answers, reply_to
from support.loopback import WAIT_S, free_endpoint, plain_session, reference_record, wait_until
from support.published import Published

from gripmon.cli import main
from gripmon.client import Client, NotCarriedOut
from gripmon.io.publish.commands import ZenohCommands
from gripmon.io.wire import Keys, Link, PublishSettings
from gripmon.model.records import Command, CommandFault, CommandName, CommandReply, MonitorState, to_json


@pytest.mark.parametrize("name", list(CommandName))
def test_every_command_arrives_once_and_its_answer_comes_back(session: zenoh.Session, loop: Loop, name: CommandName):
    [(is_reply, reply)] = answers(session, f"{CMD}/{name.value}", b'{"argument": "p-1"}')
    told = {"name": name.value, "done": True, "text": "heard 'p-1'", "reference_id": "plate-2", "revision": 7}
    told |= {"monitor": None, "snapshot": None, "durable": True, "monitor_id": "", "mount": None}
    assert is_reply and reply == told | {"schema": "gripmon.reply/2"}
    assert loop.heard == [Command(name, "p-1")]


@pytest.mark.parametrize("payload", [None, b"", b"{}", b'{"argument": ""}'])
def test_an_argument_may_be_left_out(session: zenoh.Session, loop: Loop, payload: bytes | None):
    [(is_reply, _)] = answers(session, f"{CMD}/undo", payload)
    assert is_reply and loop.heard == [Command(CommandName.UNDO)]


@pytest.mark.parametrize(
    ("key", "payload", "fault", "said"),
    [
        (f"{CMD}/explode", None, "unknown_command", "there is no command explode; one of recalibrate, accept, reject"),
        (f"{CMD}/undo", b"reference-3", "malformed", 'a payload is {"id": "…", "argument": "…"}'),
        (f"{CMD}/undo", b'{"argument": 3}', "malformed", "Expected `str`, got `int`"),
        (f"{CMD}/undo", b'{"dry_run": true}', "malformed", "unknown field `dry_run`"),
        (f"{CMD}/undo", b'{"id": "%s"}' % (b"x" * 65), "malformed", "Expected `str` of length <= 64 - at `$.id`"),
        (f"{CMD}/undo", b'{"id": "a\\n"}', "malformed", "Expected `str` matching regex"),
        (f"{CMD}/undo", b'{"argument": "\\u001b[31m"}', "malformed", "matching regex"),
        (f"{CMD}/undo", b'{"argument": "%s"}' % (b"x" * 5000), "malformed", "5016 bytes; at most 4096"),
        (f"{CMD}/undo", b'{"schema": "gripmon.command/2"}', "malformed", "its schema is 'gripmon.command/2'"),
        (f"{CMD}/undo", b"\xff\x00", "malformed", "JSON is malformed"),
        (f"{CMD}/*", None, "several_monitors", "is a pattern; name the monitor: gripmon/arm/wrist/cmd/<name>"),
        ("gripmon/*/*/cmd/undo", None, "several_monitors", "gripmon/*/*/cmd/undo is a pattern"),
        ("gripmon/**", None, "several_monitors", "gripmon/** is a pattern"),
    ],
)
def test_what_is_no_command_is_answered_by_an_error(
    session: zenoh.Session, loop: Loop, key: str, payload: bytes | None, fault: str, said: str
):
    errors = [answer for is_reply, answer in answers(session, key, payload) if not is_reply]
    assert [error["error"] for error in errors] == [fault]
    assert said in str(errors[0]["text"])
    assert loop.heard == []


def test_without_an_answer_in_time_the_asker_is_told_and_the_command_is_dropped(endpoint: str):
    link = Link(PublishSettings(listen=(endpoint,)))
    commands = ZenohCommands(link, Keys("arm", "wrist"), timeout_s=0.1)
    with contextlib.closing(link), plain_session(connect=endpoint) as session:
        [(is_reply, error)] = answers(session, f"{CMD}/undo")
        assert not is_reply and error["error"] == "timeout"
        assert error["text"] == "the monitor has not answered within 0.1 s; it is not carried out"
        assert commands.poll() is None, "nobody may carry it out later"


def test_a_command_that_takes_too_long_may_still_be_carried_out(endpoint: str):
    errors: list[tuple[bool, dict[str, object]]] = []
    link = Link(PublishSettings(listen=(endpoint,)))
    commands = ZenohCommands(link, Keys("arm", "wrist"), timeout_s=1.0)
    with contextlib.closing(link), plain_session(connect=endpoint) as session:
        loop = Loop(commands, lambda _: None)
        # Again, if the loop was so slow that it found the command given up.
        wait_until(lambda: errors.extend(answers(session, f"{CMD}/undo")) or loop.heard, "a command to be taken")
        loop.end()
    is_reply, error = errors[-1]
    assert not is_reply and error["text"] == (
        "the monitor has not answered within 1 s; it may still be carried out, ask for the state"
    )
    assert loop.heard == [Command(CommandName.UNDO)]


def test_an_answer_that_comes_too_late_goes_nowhere(endpoint: str):
    got: list[tuple[bool, dict[str, object]]] = []
    link = Link(PublishSettings(listen=(endpoint,)))
    commands = ZenohCommands(link, Keys("arm", "wrist"), timeout_s=0.2)
    go_on = threading.Event()

    def slow(command: Command) -> CommandReply:
        assert go_on.wait(WAIT_S)
        return reply_to(command)

    with contextlib.closing(link), plain_session(connect=endpoint) as session:
        loop = Loop(commands, slow)
        wait_until(lambda: got.extend(answers(session, f"{CMD}/undo")) or loop.heard, "a command to be taken")
        go_on.set()
        loop.end()
    assert not any(is_reply for is_reply, _ in got)


def test_too_many_at_once_are_told_to_wait(publisher: Published, endpoint: str):
    """No one takes them: those that don't fit are answered at once, those that wait when the monitor stops."""
    with plain_session(connect=endpoint) as session:
        replies = [session.get(f"{CMD}/undo", timeout=20.0) for _ in range(20)]
        busy = []
        wait_until(lambda: (busy.extend(r for r in map(try_one, replies) if r), len(busy) >= 4)[1], "the first answers")
        assert {json.loads(reply.err.payload.to_bytes())["error"] for reply in busy} == {"busy"}
        publisher.commands.close()
        rest = [json.loads(reply.err.payload.to_bytes())["error"] for waiting in replies for reply in waiting]
    assert len(busy) == 4 and rest == ["stopping"] * 16


def try_one(replies: object) -> zenoh.Reply | None:
    try:
        return replies.try_recv()  # type: ignore[attr-defined,no-any-return]
    except zenoh.ZError:
        return None


def test_commands_can_be_turned_off(endpoint: str):
    deaf = Published(PublishSettings(listen=(endpoint,), commands=False), "arm", "wrist")
    try:
        with plain_session(connect=endpoint) as session:
            assert answers(session, f"{CMD}/undo") == []
        with Client("arm", connect=[endpoint]) as client, pytest.raises(NotCarriedOut, match=r"publish\.commands"):
            client.send(CommandName.UNDO)
    finally:
        deaf.close()


def test_malformed_requests_are_counted_and_said_once(
    publisher: Published, session: zenoh.Session, caplog: pytest.LogCaptureFixture
):
    with caplog.at_level("WARNING", logger="gripmon"):
        for _ in range(3):
            answers(session, f"{CMD}/undo", b"no JSON")
    assert publisher.commands.malformed == 3
    assert sum("malformed command on" in message for message in caplog.messages) == 1


# --- the client ---


def test_the_client_finds_the_camera_and_brings_the_answer(publisher: Published, loop: Loop, endpoint: str):
    with Client("arm", connect=[endpoint]) as client:
        assert client.send(CommandName.UNDO, "r-1") == reply_to(Command(CommandName.UNDO, "r-1"))
        assert not client.send(CommandName.ACCEPT, "no").done
    assert loop.heard == [Command(CommandName.UNDO, "r-1"), Command(CommandName.ACCEPT, "no")]


def test_the_client_says_who_is_missing(endpoint: str):
    with (
        Client("arm", "wrist", connect=[endpoint]) as client,
        pytest.raises(NotCarriedOut, match=r"no monitor arm/wrist is seen; there is no connection to tcp/127"),
    ):
        client.send(CommandName.UNDO, timeout_s=0.2)


def test_the_client_says_who_is_there_instead(publisher: Published, endpoint: str):
    with (
        Client("leg", connect=[endpoint]) as client,
        pytest.raises(NotCarriedOut, match=r"no monitor leg/\* is seen; there are arm/wrist"),
    ):
        client.send(CommandName.UNDO, timeout_s=0.2)


def test_the_client_does_not_choose_between_two_cameras(publisher: Published, loop: Loop, endpoint: str):
    second = free_endpoint()
    other = Published(PublishSettings(listen=(second,)), "arm", "elbow")
    try:
        with Client("arm", connect=[endpoint, second]) as client:
            wait_until(lambda: len(client.alive()) == 2, "both monitors")
            with pytest.raises(LookupError, match="more than one monitor: arm/elbow, arm/wrist; name the camera"):
                client.send(CommandName.UNDO)
        with Client("arm", "wrist", connect=[endpoint, second]) as client:
            assert client.send(CommandName.UNDO).done
    finally:
        other.close()
    assert loop.heard == [Command(CommandName.UNDO)]


def test_the_client_tells_a_stopping_monitor_from_a_refusal(publisher: Published, endpoint: str):
    publisher.commands.close()
    with Client("arm", connect=[endpoint]) as client, pytest.raises(NotCarriedOut, match="the monitor stops") as caught:
        client.send(CommandName.UNDO)
    assert caught.value.fault is CommandFault.STOPPING


@pytest.mark.parametrize("answer", ["reply", "reply_err"])
def test_the_client_refuses_an_answer_of_another_major_version(endpoint: str, answer: str):
    with plain_session(listen=endpoint, mode="peer") as session:
        token = session.liveliness().declare_token("gripmon/arm/wrist/alive")
        key, payload = f"{CMD}/undo", b'{"schema": "gripmon.reply/3", "error": "gone"}'

        def tell(query: zenoh.Query) -> None:
            first = (key,) if answer == "reply" else ()
            getattr(query, answer)(*first, payload, encoding=zenoh.Encoding.APPLICATION_JSON)

        queryable = session.declare_queryable(key, tell)
        with Client("arm", connect=[endpoint]) as client, pytest.raises(NotCarriedOut) as caught:
            client.send(CommandName.UNDO)
        queryable.undeclare()
        token.undeclare()
    assert "arm/wrist has answered, but that can't be read: its schema is 'gripmon.reply/3'" in str(caught.value)


@pytest.mark.parametrize("stamp_ns", [10**30, -(10**30)])
def test_what_a_stranger_answers_does_nothing_to_the_terminal(
    endpoint: str, stamp_ns: int, capsys: pytest.CaptureFixture[str]
):
    hostile = msgspec.structs.replace(reference_record(), reference_id="\x1b[2Jplate", stamp_ns=stamp_ns)
    answer = CommandReply(CommandName.STATE, True, "so be it\x1b]0;mine\x07", "plate", 1, MonitorState((hostile,)))
    with plain_session(listen=endpoint, mode="peer") as session:
        token = session.liveliness().declare_token("gripmon/arm/wrist/alive")
        queryable = session.declare_queryable(
            f"{CMD}/state", lambda query: query.reply(f"{CMD}/state", to_json(answer))
        )
        assert main(["send", "state", "--robot", "arm", "--connect", endpoint]) == 0
        queryable.undeclare()
        token.undeclare()
    said = capsys.readouterr().out
    assert "so be it" in said and "at no time" in said and "plate" in said
    assert said.replace("\n", "").isprintable()
