"""Commands over a real Zenoh session: a publisher in this process, plain sessions and the client as askers."""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Callable, Iterator

import pytest
import zenoh
from loopback import free_endpoint, plain_session, wait_until
from published import Published

from gripmon.client import Client, NotCarriedOut
from gripmon.publish.commands import ZenohCommands
from gripmon.records import Command, CommandFault, CommandName, CommandReply
from gripmon.wire import Keys, Link, PublishSettings

CMD = "gripmon/arm/wrist/cmd"


def reply_to(command: Command) -> CommandReply:
    return CommandReply(command.name, command.argument != "no", f"heard {command.argument!r}", "plate-2", 7)


class Loop:
    """Takes commands as the daemon's loop does; ``None`` as answer: never answers."""

    def __init__(self, commands: ZenohCommands, answer: Callable[[Command], CommandReply | None]) -> None:
        self.commands, self._answer = commands, answer
        self.heard: list[Command] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(0.002):
            pending = self.commands.poll()
            if pending is not None:
                self.heard.append(pending.command)
                answer = self._answer(pending.command)
                if answer is not None:
                    pending.answer(answer)

    def end(self) -> None:
        self._stop.set()
        self._thread.join()


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def publisher(endpoint: str) -> Iterator[Published]:
    made = Published(PublishSettings(listen=(endpoint,)), "arm", "wrist")
    yield made
    made.close()


@pytest.fixture
def loop(publisher: Published) -> Iterator[Loop]:
    made = Loop(publisher.commands, reply_to)
    yield made
    made.end()


@pytest.fixture
def session(publisher: Published, endpoint: str) -> Iterator[zenoh.Session]:
    with plain_session(connect=endpoint) as made:
        yield made


def answers(session: zenoh.Session, key: str, payload: bytes | None = None) -> list[tuple[bool, dict[str, object]]]:
    """All answers, each with whether it is a reply or an error."""
    got = []
    for reply in session.get(key, payload=payload, timeout=20.0, target=zenoh.QueryTarget.ALL):
        content = reply.ok if reply.ok is not None else reply.err
        assert content is not None
        if content.encoding == zenoh.Encoding.TEXT_PLAIN:  # another queryable that matches, without a value yet
            continue
        assert content.encoding == zenoh.Encoding.APPLICATION_JSON
        got.append((reply.ok is not None, json.loads(content.payload.to_bytes())))
    return got


@pytest.mark.parametrize("name", list(CommandName))
def test_every_command_arrives_once_and_its_answer_comes_back(session: zenoh.Session, loop: Loop, name: CommandName):
    [(is_reply, reply)] = answers(session, f"{CMD}/{name.value}", b'{"argument": "p-1"}')
    told = {"name": name.value, "done": True, "text": "heard 'p-1'", "reference_id": "plate-2", "revision": 7}
    assert is_reply and reply == told | {"monitor": None, "snapshot": None, "schema": "gripmon.reply/1"}
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
    link = Link(PublishSettings(listen=(endpoint,)))
    commands = ZenohCommands(link, Keys("arm", "wrist"), timeout_s=0.3)
    with contextlib.closing(link), plain_session(connect=endpoint) as session:
        loop = Loop(commands, lambda _: None)
        [(is_reply, error)] = answers(session, f"{CMD}/undo")
        loop.end()
    assert not is_reply and error["text"] == (
        "the monitor has not answered within 0.3 s; it may still be carried out, ask for the state"
    )
    assert loop.heard == [Command(CommandName.UNDO)]


def test_an_answer_that_comes_too_late_goes_nowhere(endpoint: str):
    link = Link(PublishSettings(listen=(endpoint,)))
    commands = ZenohCommands(link, Keys("arm", "wrist"), timeout_s=0.05)
    with contextlib.closing(link), plain_session(connect=endpoint) as session:

        def slow(command: Command) -> CommandReply:
            time.sleep(0.3)
            return reply_to(command)

        loop = Loop(commands, slow)
        got = answers(session, f"{CMD}/undo")
        loop.end()
    assert [is_reply for is_reply, _ in got] == [False]


def test_too_many_at_once_are_told_to_wait(publisher: Published, endpoint: str):
    """Nobody takes them: those that don't fit are answered at once, those that wait when the monitor stops."""
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


# --- the same id again ---


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


def test_malformed_requests_are_counted_and_said_once(
    publisher: Published, session: zenoh.Session, caplog: pytest.LogCaptureFixture
):
    with caplog.at_level("WARNING", logger="gripmon"):
        for _ in range(3):
            answers(session, f"{CMD}/undo", b"no JSON")
    assert publisher.commands.malformed == 3
    assert [m for m in caplog.messages if "malformed command on" in m] == caplog.messages and len(caplog.messages) == 1


# --- the client ---


def test_the_client_finds_the_camera_and_brings_the_answer(publisher: Published, loop: Loop, endpoint: str):
    with Client("arm", connect=[endpoint]) as client:
        assert client.send(CommandName.UNDO, "r-1") == reply_to(Command(CommandName.UNDO, "r-1"))
        assert not client.send(CommandName.ACCEPT, "no").done
    assert loop.heard == [Command(CommandName.UNDO, "r-1"), Command(CommandName.ACCEPT, "no")]


def test_the_client_says_who_is_missing(endpoint: str):
    with (
        Client("arm", "wrist", connect=[endpoint]) as client,
        pytest.raises(NotCarriedOut, match="no monitor arm/wrist is on the network"),
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


@pytest.mark.parametrize("answer", ["reply", "reply_err"])
def test_the_client_refuses_an_answer_of_another_major_version(endpoint: str, answer: str):
    with plain_session(listen=endpoint, mode="peer") as session:
        token = session.liveliness().declare_token("gripmon/arm/wrist/alive")
        key, payload = f"{CMD}/undo", b'{"schema": "gripmon.reply/2", "error": "gone"}'

        def tell(query: zenoh.Query) -> None:
            first = (key,) if answer == "reply" else ()
            getattr(query, answer)(*first, payload, encoding=zenoh.Encoding.APPLICATION_JSON)

        queryable = session.declare_queryable(key, tell)
        with Client("arm", connect=[endpoint]) as client, pytest.raises(NotCarriedOut) as caught:
            client.send(CommandName.UNDO)
        queryable.undeclare()
        token.undeclare()
    assert "arm/wrist has answered, but that can't be read: its schema is 'gripmon.reply/2'" in str(caught.value)
