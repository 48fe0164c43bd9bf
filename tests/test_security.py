"""The shipped router with mutual TLS and access rules, against real sessions with and without certificates."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pytest
import zenoh
from support.certificates import add_robot, make_certificates
from support.loopback import alert_record, ask, frame_record, free_endpoint, reference_record, state_record, wait_until
from support.published import Published
from support.router_process import ROOT, running

from gripmon.cli import main
from gripmon.client import Client, Condition, Fleet, NotCarriedOut, TransformClient, Unusable
from gripmon.daemon.fleet_page import FleetSite, Order
from gripmon.io.wire import PublishSettings
from gripmon.io.wire.session import load_file
from gripmon.model.records import CommandName, CommandReply
from gripmon.teach.messages import BadRequest

PREFIX = "gripmon/arm/wrist"


@dataclass
class Site:
    """A router's process, a monitor that is its client and answers commands, and a folder of files for everyone."""

    folder: Path
    endpoint: str
    monitor: Published | None = None
    commands: list[CommandName] = field(default_factory=list)
    closing: threading.Event = field(default_factory=threading.Event)

    def file(self, name: str) -> Path:
        return self.folder / f"{name}.json5"

    def session(self, name: str) -> zenoh.Session:
        return zenoh.open(load_file(self.file(name)))

    def answer(self) -> None:
        while not self.closing.wait(0.01):
            while (pending := self.monitor.commands.poll()) is not None:
                self.commands.append(pending.command.name)
                pending.answer(
                    CommandReply(pending.command.name, done=True, text="so be it", reference_id="a", revision=1)
                )


def own_files(folder: Path, endpoint: str) -> None:
    """The shipped files with another port, for the robot "arm", and certificates beside them."""
    for file in (ROOT / "configs" / "zenoh").glob("*.json5"):
        text = file.read_text().replace("arm1", "arm")
        folder.joinpath(file.name).write_text(text.replace("127.0.0.1:7447", endpoint.partition("/")[2]))
    make_certificates(folder, "arm")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    made = Site(tmp_path_factory.mktemp("site"), free_endpoint())
    own_files(made.folder, made.endpoint)
    for name in ("monitor", "robot"):
        shutil.copy(made.file(name), made.file(f"{name}-arm2"))
    add_robot(made.folder, "arm", "arm2")
    with running(made.file("router"), made.endpoint):
        made.monitor = Published(
            PublishSettings(zenoh_config="monitor.json5"), relative_to=made.folder, identified=True
        )
        answering = threading.Thread(target=made.answer)
        answering.start()
        try:
            wait_until(lambda: made.monitor.connected, "the monitor's connection")
            made.monitor.event(state_record(3))
            made.monitor.event(reference_record(4))
            made.monitor.event(alert_record("first"))
            made.monitor.event(alert_record("second"))
            yield made
        finally:
            made.closing.set()
            answering.join()
            made.monitor.close()


@pytest.mark.parametrize("name", ["controller", "operator"])
def test_readers_read_everything(site: Site, name: str):
    assert site.monitor is not None
    with Client("arm", "wrist", zenoh_config_file=str(site.file(name))) as client:
        wait_until(lambda: site.monitor.transform(frame_record()) or client.latest().record, "a transform")
        assert client.latest().record == frame_record(monitor_id=site.monitor.monitor_id)
        assert client.state().seq == 3 and client.reference().revision == 4
        # A sign of life comes by itself, a busy machine's after the first transform.
        wait_until(lambda: client.alive() == (("arm", "wrist"),), "the monitor's sign of life")


@pytest.mark.parametrize("name", ["controller", "operator"])
def test_controllers_and_tables_of_monitors_work_through_the_rules(site: Site, name: str):
    file = str(site.file(name))
    with TransformClient("arm", "wrist", zenoh_config_file=file) as client, Fleet(zenoh_config_file=file) as fleet:
        wait_until(lambda: site.monitor.transform(frame_record()) or client.latest().usable, "a transform")
        wait_until(
            lambda: site.monitor.event(state_record(3)) or [s.condition for s in fleet.monitors()] == [Condition.VALID],
            "the state",
        )


def test_late_joiners_history_works_through_the_rules(site: Site):
    history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
    with site.session("controller") as session:
        for leaf, count in (("state", 1), ("reference", 1), ("alert", 2)):
            subscriber = zenoh.ext.declare_advanced_subscriber(session, f"{PREFIX}/{leaf}", history=history)
            got: list[dict[str, object]] = []
            wait_until(
                lambda s=subscriber, g=got, n=count: (
                    ((x := s.try_recv()) and g.append(json.loads(x.payload.to_bytes()))) or len(g) == n
                ),
                f"the history of {leaf}",
            )
            if leaf == "alert":
                assert [alert["text"] for alert in got] == ["first", "second"]


def test_only_the_operator_commands(site: Site):
    before = len(site.commands)
    with Client("arm", "wrist", zenoh_config_file=str(site.file("controller"))) as controller:
        for name in CommandName:
            with pytest.raises(NotCarriedOut, match="may not allow you"):
                controller.send(name, timeout_s=1.0)
        with site.session("controller") as session:
            assert not list(session.get(f"{PREFIX}/cmd/undo", timeout=1.0))
            assert not list(session.get("gripmon/*/*/cmd/*", timeout=1.0))
            assert not list(session.get("gripmon/**", timeout=1.0))
    with Client("arm", "wrist", zenoh_config_file=str(site.file("operator"))) as operator:
        assert operator.send(CommandName.UNDO).text == "so be it"
    assert site.commands[before:] == [CommandName.UNDO]


def test_the_page_of_the_fleet_can_do_what_its_certificate_may(site: Site):
    before = len(site.commands)
    for name in ("controller", "operator"):
        with Fleet(zenoh_config_file=str(site.file(name))) as fleet:
            page = FleetSite(fleet)

            def shown(page: FleetSite = page) -> bool:
                site.monitor.event(state_record(3))
                return [card.condition for card in page.shown().cards] == [Condition.VALID]

            wait_until(shown, "the monitor on the page")
            (card,) = page.shown().cards
            order = Order(robot="arm", camera="wrist", monitor_id=card.monitor_id, name="accept", argument="p-1")
            if name == "controller":
                with pytest.raises(BadRequest, match="may not allow you"):
                    page.carry_out(order)
            else:
                assert page.carry_out(order).text == "so be it"
    assert site.commands[before:] == [CommandName.ACCEPT]


def test_send_says_what_may_be_wrong(site: Site, stranger: Path):
    def send(path: Path) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "gripmon", "send", "reset", "--robot", "arm", "--timeout", "3"]
        command += ["--zenoh-config", str(path)]
        return subprocess.run(command, capture_output=True, text=True, timeout=60.0, cwd=ROOT)

    stranger_file = stranger / "operator.json5"
    shutil.copy(site.file("operator"), stranger_file)
    unknown = send(stranger_file)
    assert unknown.returncode == 3 and unknown.stderr.count("\n") == 1
    place = site.endpoint.replace("tcp/", "tls/")
    assert unknown.stderr.startswith(f"send: there is no connection to what {stranger_file} names: no Zenoh")
    assert place in unknown.stderr
    refused, obeyed = send(site.file("controller")), send(site.file("operator"))
    assert refused.returncode == 3 and refused.stderr.count("\n") == 1 and "may not allow you" in refused.stderr
    assert (obeyed.returncode, obeyed.stdout) == (0, "so be it\n")


def test_watch_doubts_the_file_that_was_given(site: Site, capsys: pytest.CaptureFixture[str]):
    file = str(site.file("robot"))
    doubt = f"is {file} for the right router, and may its certificate read there?"

    def doubted() -> bool:  # on a slow machine there is no session yet
        assert main(["watch", "--once", "--seconds", "1", "--zenoh-config", file]) == 3
        return capsys.readouterr().err == f"watch: no monitor is on the network; {doubt}\n"

    wait_until(doubted, "a table without monitors")


def test_a_camera_is_fed_through_the_rules(site: Site, tmp_path: Path):
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((8, 8), np.uint8))
    with site.session("monitor") as monitor:
        images: list[zenoh.Sample] = []
        _images = monitor.declare_subscriber(f"{PREFIX}/image", images.append)
        command = ["feed", str(tmp_path), "--robot", "arm", "--zenoh-config", str(site.file("robot"))]
        wait_until(lambda: main(command) == 0 and images, "the image")


def test_a_controller_can_neither_speak_for_a_monitor_nor_for_the_jaw(site: Site):
    heard: list[float] = []
    read: list[bytes] = []
    leaves = ("jaw", "image", "state", "transform", "alert", "reference")
    with (
        site.session("monitor") as listener,
        site.session("operator") as operator,
        site.session("controller") as controller,
        site.session("robot") as robot,
    ):
        _jaw = listener.declare_subscriber(
            f"{PREFIX}/jaw", lambda sample: heard.append(float(sample.payload.to_string()))
        )
        _readers = [
            operator.declare_subscriber(f"{PREFIX}/{leaf}", lambda sample: read.append(sample.payload.to_bytes()))
            for leaf in leaves
        ]
        for leaf in leaves:
            controller.put(f"{PREFIX}/{leaf}", "666")
        _token = controller.liveliness().declare_token("gripmon/fake/wrist/alive")
        assert ask(controller, f"{PREFIX}/state")[0]["seq"] == 3  # so that the router has had what came before
        wait_until(lambda: robot.put(f"{PREFIX}/jaw", "0.02") or heard, "the robot's opening")
        wait_until(lambda: site.monitor.event(state_record(3)) or read, "a state")
        assert set(heard) == {0.02} and b"666" not in read
        alive = operator.liveliness().get("gripmon/*/*/alive", timeout=2.0)
        assert [str(reply.ok.key_expr) for reply in alive] == [f"{PREFIX}/alive"]


def test_a_robot_reads_nothing(site: Site):
    with site.session("robot") as robot, site.session("controller") as controller:
        stolen: list[zenoh.Sample] = []
        read: list[zenoh.Sample] = []
        _robots = robot.declare_subscriber("gripmon/**", stolen.append)
        _robots_too = robot.declare_subscriber(f"{PREFIX}/transform", stolen.append)
        _controllers = controller.declare_subscriber(f"{PREFIX}/transform", read.append)
        wait_until(lambda: site.monitor.transform(frame_record()) or len(read) > 5, "transforms")
        assert not list(robot.get(f"{PREFIX}/state", timeout=1.0))
        assert not stolen


@pytest.fixture
def stranger(site: Site, tmp_path: Path) -> Path:
    """The controller's file beside certificates that someone else has made."""
    shutil.copy(site.file("controller"), tmp_path)
    make_certificates(tmp_path, "arm")
    return tmp_path


def refused(path: Path) -> None:
    with pytest.raises(zenoh.ZError):
        zenoh.open(load_file(path)).close()


def test_a_certificate_of_another_authority_is_refused(site: Site, stranger: Path):
    shutil.copy(site.folder / "certificates" / "ca.pem", stranger / "certificates")  # it trusts the router
    refused(stranger / "controller.json5")


def test_a_router_of_another_authority_is_refused(stranger: Path):
    refused(stranger / "controller.json5")


def test_no_certificate_is_refused(site: Site, stranger: Path):
    shutil.copy(site.folder / "certificates" / "ca.pem", stranger / "certificates")
    text = (stranger / "controller.json5").read_text()
    (stranger / "bare.json5").write_text(
        re.sub(r"(connect_certificate|connect_private_key|enable_mtls): .*\n", "", text)
    )
    refused(stranger / "bare.json5")


def test_no_tls_is_refused(site: Site, tmp_path: Path):
    path = tmp_path / "plain.json5"
    path.write_text(json.dumps({"mode": "client", "connect": {"endpoints": [site.endpoint]}}))
    refused(path)


def test_a_name_that_no_rule_knows_gets_nothing(site: Site):
    """The right authority, so the connection stands; and that is all."""
    make_certificates(site.folder, "arm", "issue visitor clientAuth DNS:visitor.invalid")
    site.file("visitor").write_text(site.file("controller").read_text().replace("controller", "visitor"))
    with site.session("visitor") as visitor, site.session("controller") as controller:
        stolen: list[zenoh.Sample] = []
        read: list[zenoh.Sample] = []
        _visitors = visitor.declare_subscriber(f"{PREFIX}/transform", stolen.append)
        _controllers = controller.declare_subscriber(f"{PREFIX}/transform", read.append)
        wait_until(lambda: site.monitor.transform(frame_record()) or len(read) > 5, "transforms")
        assert visitor.info.routers_zid()
        assert not list(visitor.get(f"{PREFIX}/state", timeout=1.0))
        assert not list(visitor.liveliness().get("gripmon/*/*/alive", timeout=1.0))
        assert not stolen


def test_a_robots_keys_speak_for_no_other_robot(site: Site):
    """All that could fool a controller: transforms, alerts, states, who is there, answers, the jaw's opening."""
    leaves = ("transform", "alert", "state", "reference", "spot", "jaw", "image")
    read: list[tuple[str, bytes]] = []
    with (
        site.session("controller") as controller,
        site.session("monitor") as own,
        site.session("monitor-arm2") as stranger,
        site.session("robot-arm2") as driver,
    ):

        def take(sample: zenoh.Sample) -> None:
            read.append((str(sample.key_expr), sample.payload.to_bytes()))

        _reader = [controller.declare_subscriber(f"gripmon/*/*/{leaf}", take) for leaf in leaves[:5]]
        _inputs = [own.declare_subscriber(f"{PREFIX}/{leaf}", take) for leaf in leaves[5:]]
        for leaf in leaves:
            for each in (stranger, driver):
                each.put(f"{PREFIX}/{leaf}", b"666")
        _tokens = [stranger.liveliness().declare_token(f"{PREFIX}/alive/{name}") for name in ("a", "b")]
        _answers = stranger.declare_queryable(f"{PREFIX}/state", lambda query: query.reply(query.key_expr, b"666"))
        wait_until(
            lambda: stranger.put("gripmon/arm2/wrist/state", b"1") or ("gripmon/arm2/wrist/state", b"1") in read,
            "what it may say of its own robot",
        )
        assert [key for key, said in read if said == b"666"] == []
        assert ask(controller, f"{PREFIX}/state")[0]["seq"] == 3
        alive = controller.liveliness().get("gripmon/arm/*/alive/*", timeout=2.0)
        tokens = [str(reply.ok.key_expr) for reply in alive]
        assert tokens == [f"{PREFIX}/alive/{site.monitor.monitor_id}"]
        assert site.monitor.presence.others() == ()


def test_two_monitors_are_seen_through_the_rules(site: Site):
    second = Published(PublishSettings(zenoh_config="monitor.json5"), relative_to=site.folder, identified=True)
    try:
        with TransformClient("arm", "wrist", zenoh_config_file=str(site.file("controller"))) as client:
            wait_until(lambda: client.latest().why is Unusable.SEVERAL, "the client to see both")
        wait_until(lambda: second.presence.others() and site.monitor.presence.others(), "each to see the other")
        assert second.presence.wait_alone(0.0), "also by asking"
    finally:
        second.close()
    wait_until(lambda: not site.monitor.presence.others(), "the first one to be alone again")
