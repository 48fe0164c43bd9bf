"""Regions below a central router: what goes up, and what stays."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh
from support.certificates import add_robot, make_certificates
from support.loopback import alert_record, ask, frame_record, free_endpoint, reference_record, state_record, wait_until
from support.published import Published
from support.router_process import ROOT, RouterProcess, running

from gripmon.client import Client, NotCarriedOut
from gripmon.io.wire import PublishSettings
from gripmon.io.wire.session import load_file, value_of
from gripmon.model.records import CommandName

PREFIX = "gripmon/arm/wrist"
UPWARD, LOCAL = ("state", "alert", "reference"), ("transform", "jaw", "image")


class Fleet:
    """A region with one monitor below a central router: two processes, and files for everyone."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.regional, self.central = free_endpoint(), free_endpoint()
        for file in (ROOT / "configs" / "zenoh").glob("*.json5"):
            text = file.read_text().replace("arm1", "arm")
            for port, endpoint in ((":7447", self.regional), (":7448", self.central)):
                text = text.replace(f"127.0.0.1{port}", endpoint.partition("/")[2])
            (folder / file.name).write_text(text)
        for name in ("controller", "operator"):  # the same person, but at the central router
            text = (folder / f"{name}.json5").read_text()
            text = text.replace(self.regional.partition("/")[2], self.central.partition("/")[2])
            (folder / f"central-{name}.json5").write_text(text)
        make_certificates(folder, "arm", "issue central serverAuth,clientAuth IP:127.0.0.1")
        shutil.copy(folder / "monitor.json5", folder / "monitor-arm2.json5")
        add_robot(folder, "arm", "arm2")

    def session(self, name: str) -> zenoh.Session:
        return zenoh.open(load_file(self.folder / f"{name}.json5"))


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Fleet:
    return Fleet(tmp_path_factory.mktemp("fleet"))


@pytest.fixture(scope="module")
def central(fleet: Fleet) -> Iterator[RouterProcess]:
    with running(fleet.folder / "central.json5", fleet.central) as started:
        yield started


@pytest.fixture(scope="module")
def monitor(fleet: Fleet, central: RouterProcess) -> Iterator[Published]:
    with running(fleet.folder / "regional.json5", fleet.regional):
        made = Published(PublishSettings(zenoh_config="monitor.json5"), relative_to=fleet.folder)
        try:
            wait_until(lambda: made.connected, "the monitor's connection")
            made.event(state_record(3))
            made.event(reference_record(4))
            made.event(alert_record("first"))
            yield made
        finally:
            made.close()


def what_goes_up(fleet: Fleet, monitor: Published) -> set[str]:
    """Names of all messages that a reader above gets, when those that shall go up and a reader below got theirs."""
    with (
        fleet.session("central-controller") as above,
        fleet.session("controller") as below,
        fleet.session("robot") as robot,
    ):
        up: list[str] = []
        here: list[zenoh.Sample] = []
        _subscribers = [
            above.declare_subscriber(key, lambda sample: up.append(str(sample.key_expr).rpartition("/")[2]))
            for key in ("gripmon/**", *(f"gripmon/*/*/{leaf}" for leaf in (*UPWARD, *LOCAL)))
        ]
        _local = below.declare_subscriber(f"{PREFIX}/transform", here.append)

        def spoken() -> bool:
            monitor.transform(frame_record())
            monitor.event(state_record(3))
            monitor.event(alert_record("again"))
            monitor.event(reference_record(4))
            robot.put(f"{PREFIX}/jaw", "0.02")
            robot.put(f"{PREFIX}/image", bytes(10_000))
            return all(up.count(leaf) >= 10 for leaf in UPWARD) and len(here) >= 10

        wait_until(spoken, "what goes up, and the transforms below")
        return set(up)


def test_state_and_alerts_go_up_and_transforms_stay(fleet: Fleet, monitor: Published):
    assert what_goes_up(fleet, monitor) == set(UPWARD)


def test_the_region_keeps_them_whatever_the_central_router_would_take(tmp_path: Path):
    lax = Fleet(tmp_path)
    path = tmp_path / "central.json5"
    path.write_text(path.read_text().replace('default_permission: "deny"', 'default_permission: "allow"'))
    with running(path, lax.central), running(tmp_path / "regional.json5", lax.regional):
        monitor = Published(PublishSettings(zenoh_config="monitor.json5"), relative_to=tmp_path)
        try:
            assert what_goes_up(lax, monitor) == set(UPWARD)
        finally:
            monitor.close()


def test_late_joiners_above_get_the_last_ones(fleet: Fleet, monitor: Published):
    history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
    with fleet.session("central-operator") as above:
        wait_until(lambda: ask(above, f"{PREFIX}/state"), "the state")
        assert ask(above, "gripmon/*/*/state")[0]["seq"] == 3
        assert ask(above, "gripmon/*/*/reference")[0]["revision"] == 4
        alerts = zenoh.ext.declare_advanced_subscriber(above, "gripmon/*/*/alert", history=history)
        assert json.loads(alerts.recv().payload.to_bytes())["text"] == "first"
        wait_until(
            lambda: [str(r.ok.key_expr) for r in above.liveliness().get("gripmon/*/*/alive")] == [f"{PREFIX}/alive"],
            "the monitor's token",
        )


def test_nobody_commands_from_above(fleet: Fleet, monitor: Published):
    file = str(fleet.folder / "central-operator.json5")
    with (
        Client("arm", "wrist", zenoh_config_file=file) as above,
        pytest.raises(NotCarriedOut, match="may not allow you"),
    ):
        above.send(CommandName.STATE, timeout_s=1.5)
    assert monitor.commands.poll() is None


def test_a_monitor_that_dies_is_seen_above(fleet: Fleet, monitor: Published):
    with fleet.session("central-controller") as above:
        seen: list[tuple[zenoh.SampleKind, str]] = []
        _tokens = above.liveliness().declare_subscriber(
            "gripmon/*/*/alive", lambda sample: seen.append((sample.kind, str(sample.key_expr))), history=True
        )
        second = Published(PublishSettings(zenoh_config="monitor-arm2.json5"), "arm2", relative_to=fleet.folder)
        key = "gripmon/arm2/wrist/alive"
        try:
            wait_until(lambda: (zenoh.SampleKind.PUT, key) in seen, "its token")
        finally:
            second.close()
        wait_until(lambda: (zenoh.SampleKind.DELETE, key) in seen, "its token to vanish")


def test_a_region_goes_on_without_the_central_router_and_finds_it_again(
    fleet: Fleet, central: RouterProcess, monitor: Published
):
    central.kill()
    with fleet.session("controller") as below:
        here: list[zenoh.Sample] = []
        _local = below.declare_subscriber(f"{PREFIX}/transform", here.append)
        wait_until(lambda: monitor.transform(frame_record()) or len(here) >= 5, "transforms in the region")
    central.start()
    with fleet.session("central-controller") as above:
        wait_until(lambda: ask(above, f"{PREFIX}/state"), "the state above")


def test_a_region_has_all_rules_of_a_single_router():
    rules = {}
    for name in ("router", "regional"):
        config = zenoh.Config.from_file(ROOT / "configs" / "zenoh" / f"{name}.json5")
        rules[name] = {part: value_of(config, f"access_control/{part}") for part in ("rules", "subjects", "policies")}
        rules[name]["filter"] = value_of(config, "low_pass_filter")
    for part, values in rules["router"].items():
        assert [value for value in values if value not in rules["regional"][part]] == []
    extra = [rule["id"] for rule in rules["regional"]["rules"] if rule not in rules["router"]["rules"]]
    assert extra == ["central asks", "central hears"]
