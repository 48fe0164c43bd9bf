"""The page of the fleet: what it shows, what its buttons do, and a real daemon in a real browser."""

from __future__ import annotations

import base64
import dataclasses
import json
import os
import signal
import subprocess
import sys
import threading
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from support.commanded import Loop
from support.configurations import shipped
from support.loopback import WAIT_S, frame_record, free_endpoint, state_record, wait_until
from support.published import Published
from support.teach_page_browser import Visitor, browser, page

from gripmon.cli import main
from gripmon.client import Client, Condition, Fleet, MonitorName
from gripmon.daemon.fleet_page import CARDS_MOST, PICTURE_PX, FleetSite, FleetView, Order
from gripmon.daemon.overlay import overlay
from gripmon.io.wire import PublishSettings
from gripmon.model.records import (
    AlertKind,
    Command,
    CommandName,
    CommandReply,
    MonitorState,
    Severity,
    Snapshot,
    SnapshotImage,
    StandingAlert,
    Verdict,
)
from gripmon.teach.messages import BadRequest
from gripmon.teach.page_server import PageServer

ROOT = Path(__file__).resolve().parent.parent
ARM = MonitorName("arm", "wrist")
WIDTHS_PX = (375, 768, 1920)


# --- what the page is told ---


@dataclasses.dataclass
class Cell:
    """A monitor on the network, and the page's site; what the monitor was told, and what it answers."""

    site: FleetSite
    monitor: Published
    loop: Loop
    answers: dict[CommandName, CommandReply]

    def told(self) -> list[tuple[CommandName, str]]:
        return [(command.name, command.argument) for command in self.loop.heard]

    def say(self, **values: object) -> None:
        assert self.monitor.presence is not None
        record = state_record(3)
        values = {"robot": "arm", "monitor_id": self.monitor.presence.monitor_id} | values
        self.monitor.event(msgspec.structs.replace(record, **values))

    def order(self, name: str, argument: str = "", **values: Any) -> Order:
        assert self.monitor.presence is not None
        what = {"robot": "arm", "camera": "wrist", "monitor_id": self.monitor.presence.monitor_id, "revision": 3}
        return Order(**(what | {"name": name, "argument": argument} | values))  # type: ignore[arg-type]


@pytest.fixture
def cell() -> Iterator[Cell]:
    endpoint = free_endpoint()
    monitor = Published(PublishSettings(listen=(endpoint,)), identified=True)
    answers: dict[CommandName, CommandReply] = {}

    def answer(command: Command) -> CommandReply:
        return answers.get(command.name, CommandReply(command.name, True, f"{command.name} it is", "plate-2", 3))

    loop = Loop(monitor.commands, answer)
    try:
        with Fleet(connect=endpoint) as fleet:
            made = Cell(FleetSite(fleet), monitor, loop, answers)

            def seen() -> bool:
                made.say()
                return any(card.state and card.monitor_id for card in made.site.shown().cards)

            wait_until(seen, "the monitor")
            yield made
    finally:
        loop.end()
        monitor.close()


def test_a_card_says_what_the_monitor_says_and_no_more_than_fits(cell: Cell):
    alerts = tuple(StandingAlert(f"a-{k}", AlertKind.STEP, Severity.WARNING, "x" * 1000, 7, k == 3) for k in range(20))

    def told() -> bool:  # a message may be dropped
        cell.say(protection_m=0.0004, alert_limit_m=0.001, tcp_shift_m=(0.003, 0.0, 0.004), open_alerts=alerts)
        return cell.site.shown().cards[0].more_alerts == 12

    wait_until(told, "the alerts")
    shown = cell.site.shown()
    (card,) = shown.cards
    assert (card.robot, card.camera, card.condition, card.state) == ("arm", "wrist", Condition.VALID, "tracking")
    assert (card.drift_m, card.protection_m, card.alert_limit_m) == (pytest.approx(0.005), 0.0004, 0.001)
    assert len(msgspec.json.encode(shown)) < 10_000
    assert shown.counts == {Condition.VALID: 1}


def test_of_many_the_worst_are_shown_and_others_are_found_by_name(cell: Cell):
    class Crowd:
        unreadable = 2

        def monitors(self) -> list[Any]:
            (one,) = fleet.monitors()
            return [msgspec.structs.replace(one, name=MonitorName(f"Robot{k}", "wrist")) for k in range(500)]

        def fault(self) -> str:
            return "no connection"

    fleet = cell.site._fleet
    site = FleetSite(Crowd())  # type: ignore[arg-type]
    shown = site.shown()
    assert (len(shown.cards), shown.hidden) == (CARDS_MOST, 500 - CARDS_MOST)
    assert shown.fault == "no connection; 2 messages can't be read"
    assert [card.robot for card in site.shown("robot499/").cards] == ["Robot499"]


@pytest.mark.parametrize(
    ("name", "argument"), [("accept", "rec-4"), ("reject", "rec-4"), ("acknowledge", "a-1"), ("undo", "")]
)
def test_an_order_goes_to_the_monitor_as_it_was_seen(cell: Cell, name: str, argument: str):
    answered = cell.site.carry_out(cell.order(name, argument))
    assert (answered.done, answered.text) == (True, f"{name} it is")
    assert cell.told()[-1] == (CommandName(name), argument)


def test_undo_from_another_revision_than_was_seen_is_not_sent(cell: Cell):
    cell.answers[CommandName.STATE] = CommandReply(CommandName.STATE, True, "", "plate-3", 4, MonitorState(()))
    answered = cell.site.carry_out(cell.order("undo"))
    assert answered.text == "revision 4 is in force by now, not 3; look at it first" and not answered.done
    assert cell.told() == [(CommandName.STATE, "")]


def test_what_the_monitor_refuses_is_said_in_its_words(cell: Cell):
    cell.answers[CommandName.ACCEPT] = CommandReply(CommandName.ACCEPT, False, "there is no proposal", "plate-2", 3)
    answered = cell.site.carry_out(cell.order("accept", "rec-4"))
    assert (answered.done, answered.text) == (False, "there is no proposal")


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"robot": "other"}, "isn't there any more"),
        ({"monitor_id": "earlier-1-2"}, "isn't there any more; it may have restarted"),
        ({"monitor_id": ""}, "isn't there any more"),
        ({"argument": ""}, "accept has no argument"),
        ({"argument": "x" * 1000}, "argument"),
    ],
)
def test_an_order_that_fits_no_monitor_tells_none(cell: Cell, changed: dict[str, Any], said: str):
    with pytest.raises(BadRequest, match=said):
        cell.site.carry_out(cell.order("accept", **{"argument": "rec-4"} | changed))
    assert cell.told() == []


def test_a_monitor_that_is_gone_gets_no_order_and_keeps_its_card(cell: Cell):
    order = cell.order("accept", "rec-4")
    cell.monitor.close()
    gone = (Condition.GONE, Condition.STOPPED)
    wait_until(lambda: cell.site.shown().cards[0].condition in gone, "the monitor to be gone")
    with pytest.raises(BadRequest, match="arm/wrist is gone"):
        cell.site.carry_out(order)
    with pytest.raises(BadRequest, match="arm/wrist is gone"):
        cell.site.picture(ARM, order.monitor_id)


def test_a_picture_is_made_once_for_all_who_look(cell: Cell, monkeypatch: pytest.MonkeyPatch):
    image = np.full((480, 1280), 90, np.uint8)
    data = cv2.imencode(".png", image)[1].tobytes()
    record = frame_record(5, verdict=Verdict.VALID, corners=())
    outline = ((100.0, 50.0), (100.0, 400.0))
    snapshot = Snapshot(record, 0.1, None, SnapshotImage("png", 1280, 480, "mono8", len(data)), (outline,))
    reply = CommandReply(CommandName.SNAPSHOT, True, "", "plate-2", 3, None, snapshot)
    asked: list[CommandName] = []

    def send(name: MonitorName, command: CommandName, *_: object, **__: object) -> tuple[CommandReply, bytes]:
        asked.append(command)
        return reply, data

    monkeypatch.setattr(cell.site._fleet, "send", send)
    identity = cell.order("undo").monitor_id
    first, second = (cell.site.picture(ARM, identity) for _ in range(2))
    assert first is second and asked == [CommandName.SNAPSHOT]
    assert (first.stamp_ns, first.verdict) == (record.stamp_ns, "valid")
    picture = cv2.imdecode(np.frombuffer(first.jpeg, np.uint8), cv2.IMREAD_COLOR).astype(int)
    assert picture.shape == (240, PICTURE_PX, 3)
    green = picture[..., 1] - picture[..., 2]
    # Column 100 of 1280 is column 49.75 of 640: its centre stays where it was.
    columns = np.average(np.arange(PICTURE_PX), weights=np.clip(green[40:180].mean(axis=0), 0.0, None) ** 2)
    assert columns == pytest.approx(49.75, abs=0.3)
    assert green[40:180, 45:55].max() > 60 and green[215:].max() < 30


@pytest.mark.parametrize(
    ("size_px", "stated_px"),
    [((8000, 8000), (64, 48)), ((8000, 8000), (8000, 8000)), ((4, 9000), (4, 9000)), ((64, 48), None)],
    ids=["another size", "too large", "too thin", "none stated"],
)
def test_a_picture_of_another_size_than_the_monitors_is_not_decoded(
    cell: Cell, monkeypatch: pytest.MonkeyPatch, size_px: tuple[int, int], stated_px: tuple[int, int] | None
):
    """A few kB may be gigabytes of pixels."""
    data = cv2.imencode(".png", np.zeros(size_px[::-1], np.uint8))[1].tobytes()
    image = None if stated_px is None else SnapshotImage("png", *stated_px, "mono8", len(data))
    reply = CommandReply(CommandName.SNAPSHOT, True, "", "a", 3, None, Snapshot(frame_record(5), 0.1, None, image))
    monkeypatch.setattr(cell.site._fleet, "send", lambda *_, **__: (reply, data))
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    with pytest.raises(BadRequest, match=r"its image: .* pixels; |its newest frame has no image"):
        cell.site.picture(ARM, cell.order("undo").monitor_id)


def test_why_there_is_no_picture_is_said_and_not_asked_again_at_once(cell: Cell):
    cell.answers[CommandName.SNAPSHOT] = CommandReply(CommandName.SNAPSHOT, False, "no frame has come yet", "a", 3)
    identity = cell.order("undo").monitor_id
    for _ in range(3):
        with pytest.raises(BadRequest, match="no frame has come yet"):
            cell.site.picture(ARM, identity)
    assert cell.told() == [(CommandName.SNAPSHOT, "")]


@pytest.mark.parametrize("shape", [(60, 80), (60, 80, 3)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_any_image_of_a_snapshot_becomes_a_picture(shape: tuple[int, ...], dtype: type):
    jpeg = overlay(np.zeros(shape, dtype), frame_record(1), ((),), 640)
    assert cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR).shape == (480, 640, 3)


def asked(server: PageServer, path: str, host: str | None = None, body: object = None) -> tuple[int, dict[str, Any]]:
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(server.url + path, data, {"Content-Type": "application/json"})
    if host is not None:
        request.add_header("Host", host)
    try:
        with urllib.request.urlopen(request, timeout=WAIT_S) as answer:
            return answer.status, json.loads(answer.read())
    except urllib.error.HTTPError as error:
        return error.code, json.loads(error.read())


def test_over_http(cell: Cell):
    """Another address of this machine's, as --address has it: the requests have to name it."""
    server = PageServer(cell.site, address="127.0.0.2")
    try:
        assert server.url.startswith("http://127.0.0.2:")
        status, shown = asked(server, "fleet?find=arm")
        assert status == 200 and msgspec.convert(shown, FleetView).cards[0].robot == "arm"
        for host in (f"127.0.0.1:{server.port}", f"localhost:{server.port}", "evil.example"):
            assert asked(server, "fleet", host)[0] == 403
        order = msgspec.to_builtins(cell.order("reject", "rec-4"))
        assert asked(server, "order", body=order) == (200, {"done": True, "text": "reject it is"})
        for changed in (
            {"name": "reset"},
            {"name": "snapshot"},
            {"robot": "x" * 2000},
            {"more": 1},
            {"revision": None},
        ):
            assert asked(server, "order", body=order | changed)[0] == 400
        status, failure = asked(server, f"picture?{urllib.parse.urlencode({'robot': '<script>', 'id': '%%'})}")
        assert status == 400 and failure["error"].startswith("<script>/")
        assert asked(server, "order")[0] == 404 and asked(server, "../fleet")[0] == 404
    finally:
        server.close()
    assert cell.told() == [(CommandName.REJECT, "rec-4")]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--web", "--once"], "--once: has no effect beside --web; leave it out"),
        (["--web", "--seconds", "3"], "--seconds: has no effect beside --web; leave it out"),
        (["--address", "127.0.0.1"], "--address: applies only to the page; add --web"),
        (["--web", "--address", "0.0.0.0"], "--address 0.0.0.0: isn't a machine's address; the one at which"),
        (["--web", "--no-browser", "--address", "192.0.2.1"], "--address 192.0.2.1: can't be listened on"),
    ],
)
def test_wrong_use(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]):
    assert main(["watch", "--connect", free_endpoint(), *arguments]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1


# --- a daemon, a browser ---


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """The demo's camera, which is knocked after some seconds; the new reference has to be accepted by a person."""
    endpoint = free_endpoint()
    changes = (
        ("tcp/127.0.0.1:7447", endpoint),
        ("fps: 60.0", "fps: 12.0"),
        ("duration_s: 20.0", "duration_s: 6.0"),
        ("sure_sigma_m: 5.0e-5", "sure_sigma_m: 1.0e-6"),
        ("  enabled: true          #", "  enabled: false #"),
    )
    (tmp_path / "c.yaml").write_text(shipped("demo.yaml", *changes))
    command = [sys.executable, "-m", "gripmon", "run", str(tmp_path / "c.yaml")]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    with subprocess.Popen(command, cwd=tmp_path, env=environment, stderr=subprocess.DEVNULL) as process:
        try:
            yield endpoint, process
        finally:
            process.kill()


@pytest.fixture
def hostile() -> Iterator[str]:
    """A monitor whose name and texts are a page's."""
    endpoint, name = free_endpoint(), "<script>document.title=1<"
    monitor = Published(PublishSettings(listen=(endpoint,)), name, "<img", identified=True)
    assert monitor.presence is not None
    alert = StandingAlert("a-1", AlertKind.STEP, Severity.ERROR, "<img src=x onerror=document.title=2>", 7, False)
    state = msgspec.structs.replace(state_record(3), robot=name, open_alerts=(alert,), message="<b>bold</b>")
    state = msgspec.structs.replace(state, monitor_id=monitor.presence.monitor_id)
    ends = threading.Event()

    def speak() -> None:
        while not ends.wait(0.5):
            monitor.event(state)

    speaker = threading.Thread(target=speak)
    speaker.start()
    try:
        yield endpoint
    finally:
        ends.set()
        speaker.join()
        monitor.close()


@pytest.fixture(scope="module")
def driver() -> Iterator[Any]:
    opened = browser()
    yield opened
    opened.quit()


def send(endpoint: str, *arguments: str) -> int:
    return main(["send", *arguments, "--robot", "demo", "--connect", endpoint])


def test_an_operators_way(
    daemon: tuple[str, subprocess.Popen[bytes]], hostile: str, driver: Any, capsys: pytest.CaptureFixture[str]
):
    endpoint, process = daemon
    with page("--web", "--connect", endpoint, "--connect", hostile, command=("watch",)) as running:
        visitor = Visitor(driver, running.url)

        def card() -> str:
            return f"article:nth-child({1 + names().index('demo/wrist')})"

        def names() -> list[str]:
            return [each.text for each in driver.find_elements("css selector", "article h2")]

        def wait_for(text: str, where: Callable[[], str]) -> None:
            visitor.wait(lambda: text in visitor.text(where()), f"{text} in {visitor.text('main')}")

        visitor.wait(lambda: len(names()) == 2, "two cards")
        wait_for("A new reference waits: recalibration-1", card)
        visitor.wait(lambda: visitor.find(f"{card()} img").is_displayed(), "a picture")

        looks_right_at_every_width(visitor, card)
        assert "<script>document.title=1</<img" in names()
        assert "<img src=x onerror=document.title=2>" in visitor.text("main") and "<b>bold</b>" in visitor.text("main")
        assert driver.title == "gripmon fleet"

        outlines_lie_on_measured_corners(endpoint)

        visitor.click(f"{card()} .by-hand")
        wait_for("To stand as at demo-calibration (revision 0)", lambda: f"{card()} .mount")
        wait_for(" first", lambda: f"{card()} .mount .first")  # the camera was knocked
        assert visitor.script("return document.querySelectorAll(arguments[0]).length", f"{card()} .move") == 6
        looks_right_at_every_width(visitor, card)
        right = "return document.querySelector(arguments[0]).getBoundingClientRect().right"
        left = "return document.querySelector(arguments[0]).getBoundingClientRect().left"
        assert visitor.script(right, f"{card()} img") < visitor.script(left, f"{card()} .mount"), "seen from the robot"
        visitor.click(f"{card()} .by-hand")
        visitor.wait(lambda: not visitor.find(f"{card()} .mount").is_displayed(), "the mount to be put away")

        visitor.click(f"{card()} [data-order=accept]")  # asked, and someone else is faster
        wait_for("as reference of demo/wrist?", lambda: f"{card()} .asked")
        assert send(endpoint, "accept") == 0
        visitor.click(f"{card()} .yes")
        wait_for("refused: ", lambda: f"{card()} .answer")
        visitor.wait(lambda: "1 recalibration-1" in visitor.text(f"{card()} dl"), "the new reference")
        visitor.click(f"{card()} [data-order=undo]")
        visitor.click(f"{card()} .no")
        visitor.click(f"{card()} [data-order=undo]")
        visitor.click(f"{card()} .yes")
        wait_for("it restores demo-calibration", lambda: f"{card()} .answer")
        wait_for("A new reference waits: recalibration-3", card)
        visitor.click(f"{card()} [data-order=accept]")
        visitor.click(f"{card()} .yes")
        wait_for("is in force, revision 3", lambda: f"{card()} .answer")
        visitor.wait(lambda: "3 recalibration-3" in visitor.text(f"{card()} dl"), "the new reference")
        visitor.click(f"{card()} [data-order=undo]")
        visitor.click(f"{card()} .yes")
        wait_for("A new reference waits: recalibration-5", card)  # by now its alerts are those of this reference
        visitor.click(f"{card()} li:first-child [data-order=acknowledge]")
        wait_for("done: acknowledged", lambda: f"{card()} .answer")

        enabled = "return [...document.querySelectorAll(arguments[0])].filter(each => !each.disabled).length"
        process.send_signal(signal.SIGKILL)
        wait_for("gone since", card)
        wait_for("not live: of ", lambda: f"{card()} figcaption")
        assert visitor.script(enabled, f"{card()} button") == 0
        assert "old" in visitor.find(card()).get_attribute("class")

        running.process.send_signal(signal.SIGINT)
        wait_for("gripmon doesn't answer: it has ended; shown: state of ", lambda: "#status")
        assert visitor.script(enabled, "article button") == 0
        assert running.ended()[0] == 130
    capsys.readouterr()


def outlines_lie_on_measured_corners(endpoint: str) -> None:
    """What the snapshot says of the predicted edges, against what was measured in the image."""
    with Client("demo", connect=endpoint) as client:
        reply, _ = client.snapshot(WAIT_S)
    assert reply.snapshot is not None and len(reply.snapshot.outlines_px) >= 6
    ends = np.array([line[k] for line in reply.snapshot.outlines_px for k in (0, -1)])
    used = [corner.uv_px for corner in reply.snapshot.record.corners if corner.used]
    assert len(used) >= 4
    for uv_px in used:
        assert np.linalg.norm(ends - np.array(uv_px), axis=1).min() < 1.0


def looks_right_at_every_width(visitor: Visitor, card: Callable[[], str]) -> None:
    """Nothing lies outside the window or over anything else, and the fingers in the picture have their outline."""
    for width_px in WIDTHS_PX:
        metrics = {"width": width_px, "height": 900, "deviceScaleFactor": 1, "mobile": width_px < 500}
        visitor.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        visitor.settle()
        assert visitor.script("return document.documentElement.scrollWidth") <= width_px
        outside = (
            "return [...document.querySelectorAll('article *')].filter(e => e.offsetParent && "
            "(e.getBoundingClientRect().right > e.closest('article').getBoundingClientRect().right + 1 || "
            "e.scrollWidth > e.clientWidth + 1 && getComputedStyle(e).display !== 'inline')).map(e => e.outerHTML)"
        )
        assert visitor.script(outside) == []
    read = (
        "const image = document.querySelector(arguments[0] + ' img'), canvas = document.createElement('canvas');"
        "canvas.width = image.naturalWidth; canvas.height = image.naturalHeight;"
        "canvas.getContext('2d').drawImage(image, 0, 0); return canvas.toDataURL('image/png')"
    )
    data = base64.b64decode(visitor.script(read, card()).partition(",")[2])
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).astype(int)
    assert picture.shape[1] == PICTURE_PX
    assert np.count_nonzero(picture[..., 1] - picture[..., 0] > 60) > 500  # grey but for what is drawn
