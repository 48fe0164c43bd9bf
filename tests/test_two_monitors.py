"""Two monitors of one name: everybody says so, nothing of theirs is usable, and no command reaches both."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from support.commanded import CMD, Loop, answers, reply_to
from support.daemon_bench import Bench
from support.loopback import frame_record, free_endpoint, plain_session, state_record, wait_until
from support.published import Published
from support.router_process import plain_config
from support.router_process import running as router_running
from support.timely import TimelyInbox
from test_run_on_the_network import configured, running

from gripmon.cli import main
from gripmon.client import Ambiguous, Client, Condition, Fleet, NotCarriedOut, Policy, TransformClient, Unusable
from gripmon.client.inbox import SENDS_S, Inbox
from gripmon.client.network import MonitorName, Start
from gripmon.client.reading import judge
from gripmon.daemon.neighbours import Reports
from gripmon.io.publish.presence import Presence, new_monitor_id
from gripmon.io.wire import Keys, Link, PublishSettings
from gripmon.model.records import AlertEvent, AlertKind, CommandFault, CommandName, FrameRecord, Verdict, to_json

PATIENT = Policy(max_age_s=3600.0)
WRIST = MonitorName("arm", "wrist")
FIRST, SECOND = Start(WRIST, "pc-1-aa"), Start(WRIST, "pc-2-bb")


@pytest.fixture(scope="module")
def router(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    endpoint = free_endpoint()
    with router_running(plain_config(tmp_path_factory.mktemp("router"), endpoint), endpoint):
        yield endpoint


def start(router: str, camera: str) -> Published:
    settings = PublishSettings(mode="client", connect=(router,))
    made = Published(settings, "arm", camera, identified=True)
    wait_until(lambda: made.connected, "the session")
    return made


@pytest.fixture
def two(router: str, request: pytest.FixtureRequest) -> Iterator[tuple[Published, Published]]:
    """Of one name, which is the test's own."""
    camera = f"c{abs(hash(request.node.name))}"
    with ExitStack() as stack:
        pair = [start(router, camera) for _ in range(2)]
        for each in pair:
            stack.callback(each.close)
            loop = Loop(each.commands, reply_to)
            stack.callback(loop.end)
            each.loop = loop  # type: ignore[attr-defined]
        first, second = pair
        wait_until(lambda: first.presence.others() and second.presence.others(), "them to see each other")
        yield first, second


def heard(inbox: Inbox, now_s: float) -> Unusable | None:
    return judge(inbox.heard, inbox.heard.entry, PATIENT, now_s, 0, lambda: "").why


def take(inbox: Inbox, who: Start, now_s: float) -> None:
    inbox.take(who.monitor, to_json(frame_record(alerts=(), monitor_id=who.monitor_id)), now_s)


def test_two_tokens_are_several_until_one_is_gone_and_the_other_has_sent():
    inbox = TimelyInbox()
    inbox.appeared(WRIST)
    inbox.started(FIRST)
    take(inbox, FIRST, 10.0)
    assert heard(inbox, 10.0) is None
    inbox.started(SECOND)
    reading = judge(inbox.heard, inbox.heard.entry, PATIENT, 10.0, 0, lambda: "")
    assert reading.why is Unusable.SEVERAL and reading.transform is None and reading.verdict is Verdict.UNKNOWN
    assert reading.reason == (
        "more than one monitor has the same name: arm/wrist (pc-1-aa), arm/wrist (pc-2-bb); stop all but one"
    )
    inbox.ended(FIRST)  # what it said last is nothing that the other one stands by
    assert heard(inbox, 10.0) is Unusable.RESTARTED
    take(inbox, SECOND, 10.1)
    assert heard(inbox, 10.1) is None


@pytest.mark.parametrize("id_first", [False, True])
def test_a_single_monitor_that_ends_is_gone_whichever_token_goes_first(id_first: bool):
    inbox = TimelyInbox()
    inbox.appeared(WRIST)
    inbox.started(FIRST)
    take(inbox, FIRST, 10.0)
    for step in (0, 1):
        inbox.ended(FIRST) if (step == 0) == id_first else inbox.vanished(WRIST)
        assert heard(inbox, 10.0) is Unusable.GONE


def test_where_rules_hide_the_tokens_the_transforms_tell():
    inbox = TimelyInbox()
    inbox.appeared(WRIST)
    for step, who in enumerate((FIRST, SECOND, FIRST)):
        take(inbox, who, 10.0 + 0.1 * step)
        assert heard(inbox, 10.0 + 0.1 * step) is (Unusable.SEVERAL if step else None)
    take(inbox, FIRST, 10.2 + SENDS_S)
    assert heard(inbox, 10.2 + SENDS_S) is None  # the other one is silent: it was a restart


def test_readings_of_two_starts_are_never_of_one_revision():
    readings = []
    for who in (FIRST, SECOND, FIRST):
        inbox = TimelyInbox()
        take(inbox, who, 10.0)
        readings.append(judge(inbox.heard, inbox.heard.entry, PATIENT, 10.0, 0, lambda: ""))
    assert readings[0].same_revision_as(readings[2]) and not readings[0].same_revision_as(readings[1])
    assert [reading.monitor_id for reading in readings] == ["pc-1-aa", "pc-2-bb", "pc-1-aa"]


def test_each_start_has_its_own_id():
    ids = {new_monitor_id() for _ in range(100)}
    assert len(ids) == 100
    assert all(Keys("arm", "wrist")[f"alive/{each}"].count("/") == 4 and len(each) <= 64 for each in ids)


def test_the_client_uses_neither_until_one_is_gone(two: tuple[Published, Published], router: str):
    first, second = two
    with TransformClient("arm", first.keys.camera, connect=[router], policy=PATIENT) as client:
        both = set()

        def several() -> bool:
            for seq, each in enumerate(two):
                each.transform(frame_record(seq))
            reading = client.latest()
            both.update(name for name in (p.monitor_id for p in two) if name in reading.reason)
            return reading.why is Unusable.SEVERAL and len(both) == 2

        wait_until(several, "the client to see both")
        first.close()
        wait_until(lambda: not second.presence.others(), "the second one to know")

        def again() -> bool:
            second.transform(frame_record(9))
            return client.latest().usable

        wait_until(again, "the other one to be usable")
        assert client.latest().monitor_id == second.monitor_id


def test_a_command_reaches_the_one_that_is_named_and_no_other(two: tuple[Published, Published], router: str):
    first = two[0]
    camera = first.keys.camera
    with Client("arm", camera, connect=[router]) as client, plain_session(connect=router) as plain:
        with pytest.raises(Ambiguous, match=f"^2 monitors are arm/{camera}: .*; stop all but one, or name one$"):
            client.send(CommandName.UNDO)
        for each in two:
            reply = client.send(CommandName.UNDO, monitor_id=each.monitor_id)
            assert reply.done and reply.monitor_id == each.monitor_id
        with pytest.raises(NotCarriedOut, match=f"arm/{camera} is not nobody, but "):
            client.send(CommandName.UNDO, monitor_id="nobody")
        key = CMD.replace("wrist", camera)
        unnamed = answers(plain, f"{key}/reset")
        assert {(is_reply, told["error"]) for is_reply, told in unnamed} == {(False, CommandFault.SEVERAL)}
        assert {told["monitor_id"] for _, told in unnamed} == {each.monitor_id for each in two}
        named = answers(plain, f"{key}/reset", b'{"monitor_id": "%s"}' % first.monitor_id.encode())
        assert sorted(told.get("error", "") for _, told in named) == ["", "another_monitor"]
    assert [len(each.loop.heard) for each in two] == [2, 1]  # type: ignore[attr-defined]


def test_send_asks_for_the_name_of_one(
    two: tuple[Published, Published], router: str, capsys: pytest.CaptureFixture[str]
):
    command = ["send", "undo", "--robot", "arm", "--camera", two[0].keys.camera, "--connect", router]
    assert main(command) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith("; stop all but one, or name one (--monitor ID)")
    assert all(each.monitor_id in line for each in two)
    assert main([*command, "--monitor", two[1].monitor_id]) == 0


def test_watch_shows_both(two: tuple[Published, Published], router: str, capsys: pytest.CaptureFixture[str]):
    with Fleet(connect=[router]) as fleet:

        def listed() -> list[tuple[str, Condition]]:
            for each in two:
                each.event(state_record())
            mine = [each for each in fleet.monitors() if each.name.camera == two[0].keys.camera]
            return sorted((each.monitor_id, each.condition) for each in mine if each.state is not None)

        both = sorted((each.monitor_id, Condition.SEVERAL) for each in two)
        wait_until(lambda: listed() == both, "both to be listed")
        assert main(["watch", "--once", "--seconds", "1", "--connect", router]) == 0
        table = capsys.readouterr().out
        assert "2 several" in table and all(each.monitor_id in table for each in two)
        two[0].close()
        last = [(two[1].monitor_id, Condition.VALID)]
        wait_until(lambda: listed() == last, "the one that is left")


def test_the_daemon_says_it_and_publishes_nothing_to_move_by_meanwhile():
    others: list[str] = []
    bench = Bench([0, lambda _: others.append("pc-2-bb"), 1, lambda _: others.clear(), 2])
    bench.run(reports=Reports(others=lambda: tuple(others)))
    assert [each.verdict for each in bench.network.transforms] == [Verdict.VALID, Verdict.UNKNOWN, Verdict.VALID]
    withheld = bench.network.transforms[1]
    assert withheld.cam_T_grip is withheld.covariance is withheld.smoothed is withheld.protection is None
    assert withheld.reason is not None and "another monitor of this robot and camera" in withheld.reason
    told = [(alert.kind, alert.event) for alert in bench.network.alerts]
    assert told == [(AlertKind.SEVERAL, AlertEvent.RAISED), (AlertKind.SEVERAL, AlertEvent.CLEARED)]
    assert (Verdict.UNKNOWN, True) in [(s.verdict, "pc-2-bb" in s.message) for s in bench.network.states]
    kept = [record for _, record in bench.recording.offered]
    assert all(isinstance(record, FrameRecord) and record.verdict is Verdict.VALID for record in kept)


def test_a_start_waits_for_a_predecessor_to_vanish(router: str):
    predecessor = start(router, "vanishing")
    link = Link(PublishSettings(mode="client", connect=(router,)))
    presence = Presence(link, predecessor.keys)
    try:
        assert presence.wait_alone(0.0) == (predecessor.monitor_id,)
        predecessor.close()
        assert presence.wait_alone(60.0) == ()
    finally:
        link.close()
        predecessor.close()


def test_a_start_without_a_router_does_not_wait_for_ever():
    link = Link(PublishSettings(mode="client", connect=(free_endpoint(),)))
    try:
        begun_s = time.monotonic()
        assert Presence(link, Keys("arm", "wrist")).wait_alone(60.0) == ()
        assert time.monotonic() - begun_s < 30.0
    finally:
        link.close()


def test_run_refuses_a_name_that_is_taken_unless_it_is_to_take_over(tmp_path: Path, router: str):
    config = configured(tmp_path, f"{{mode: client, connect: [{router}]}}")
    settings = PublishSettings(mode="client", connect=(router,))
    other = Published(settings, "demo", "wrist", identified=True)
    try:
        wait_until(lambda: other.connected, "the session")
        with running(config) as refused:
            said = refused.communicate(timeout=120.0)[1]
        assert refused.returncode == 4, said
        last = said.splitlines()[-1]
        assert other.monitor_id in last and last.endswith("start it with --take-over and stop the other one then")
        assert not other.presence.others()
        with running(config, "--take-over"):
            wait_until(lambda: other.presence.others(), "the newcomer")
    finally:
        other.close()
