"""The page for those who write controllers: its examples run against a real monitor, its tables are complete."""

from __future__ import annotations

import re
import threading
from pathlib import Path

import msgspec
import numpy as np
import pytest
from support.loopback import WAIT_S, frame_record, free_endpoint, wait_until
from support.remote_monitor import remote_monitor

from gripmon.client import Policy, Unusable
from gripmon.model.records import Verdict

TEXT = (Path(__file__).resolve().parent.parent / "docs" / "howto" / "client.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
SERVO, REQUIRE, ITERATE, ASYNCIO, CALLBACK, ASK, FLEET = EXAMPLES


class Arm:
    """Writes down what a controller makes it do; has work until it is stopped behind a step."""

    def __init__(self) -> None:
        self.done: list[object] = []
        self.stepped, self.stopped = threading.Event(), threading.Event()

    def step(self, cam_T_grip: np.ndarray) -> None:
        assert not self.stopped.is_set(), "it moves without a monitor"
        np.testing.assert_allclose(cam_T_grip[:3, 3], frame_record().cam_T_grip.translation_m)
        self.done.append("step")
        self.stepped.set()

    def stop(self, reason: str) -> None:
        self.done.append(reason)
        if self.stepped.is_set():
            self.stopped.set()

    def has_work(self) -> bool:
        return not self.stopped.wait(0.001)

    def wait(self) -> None:
        assert self.stopped.wait(WAIT_S)


def run(example: str, arm: Arm, endpoint: str) -> None:
    assert example.count("tcp/127.0.0.1:7447") == 1
    exec(example.replace("tcp/127.0.0.1:7447", endpoint), {"arm": arm})


@pytest.mark.parametrize("example", [SERVO, ITERATE, ASYNCIO, CALLBACK], ids=["servo", "for", "async for", "callback"])
def test_a_controller_moves_by_the_monitor_and_stops_when_it_is_killed(example: str):
    arm, endpoint = Arm(), free_endpoint()

    def control() -> None:
        while not arm.stepped.is_set():  # a machine that is busy elsewhere may hold up the first reading for too long
            run(example, arm, endpoint)

    controller = threading.Thread(target=control, daemon=True)
    with remote_monitor(robot="arm1", listen=[endpoint]) as monitor:
        controller.start()
        assert arm.stepped.wait(WAIT_S)
        monitor.kill()
        controller.join(WAIT_S)
    assert not controller.is_alive()
    assert arm.done[-1] == "the monitor is gone" or re.fullmatch(
        r"the newest transform is .* s old, at most .* s is allowed", str(arm.done[-1])
    )


def test_the_servo_loop_begins_nothing_by_a_suspect_transform():
    arm, endpoint = Arm(), free_endpoint()
    controller = threading.Thread(target=run, args=(SERVO, arm, endpoint), daemon=True)
    with remote_monitor(robot="arm1", listen=[endpoint], answer={"verdict": "suspect"}):
        controller.start()
        wait_until(lambda: arm.done.count("the transform is suspect: tracking") > 20, "suspect transforms")
        assert "step" not in arm.done
        arm.stopped.set()
        controller.join(WAIT_S)
    assert not controller.is_alive()


def test_require_says_what_there_is_not(capsys: pytest.CaptureFixture[str]):
    run(REQUIRE, Arm(), free_endpoint())
    assert re.match(r"no (connection|transform)", capsys.readouterr().out)


def test_a_monitor_is_asked(capsys: pytest.CaptureFixture[str]):
    endpoint = free_endpoint()
    with remote_monitor(robot="arm1", listen=[endpoint]):
        run(ASK, Arm(), endpoint)
    told = capsys.readouterr().out
    assert "MonitorName(robot='arm1', camera='wrist')" in told and "StateRecord(robot='arm1'" in told


def test_the_fleet_is_printed(capsys: pytest.CaptureFixture[str]):
    endpoint = free_endpoint()
    with remote_monitor(robot="arm1", listen=[endpoint]):
        told = ""
        for _ in range(5):  # a slow machine may not see it in time
            run(FLEET, Arm(), endpoint)
            if told := capsys.readouterr().out:
                break
    assert told.startswith("arm1/wrist ")


def test_the_tables_are_complete():
    def first_column(head: str) -> list[str]:
        table = re.search(rf"^\| {re.escape(head)} \|.*?\n\n", TEXT, re.MULTILINE | re.DOTALL)
        assert table is not None
        return re.findall(r"^\| `(\w+)`", table[0].partition("\n")[2], re.MULTILINE)

    assert sorted(first_column("`why`")) == sorted(why.value for why in Unusable)
    assert first_column("`verdict`") == [verdict.value for verdict in Verdict]
    assert first_column("`Policy(…)`") == [field.name for field in msgspec.structs.fields(Policy)]
    defaults = {"0.2", "`False`", "`None`"}
    assert {str(Policy().max_age_s), f"`{Policy().accept_suspect}`", f"`{Policy().max_sigma_m}`"} == defaults
