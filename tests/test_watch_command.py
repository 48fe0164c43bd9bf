"""``gripmon watch`` as a process of its own, on monitors in processes of their own that are killed."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from support.loopback import WAIT_S, alert_record, free_endpoint, plain_session, wait_until
from support.published import Published
from support.remote_monitor import remote_monitor, router

from gripmon.cli import main
from gripmon.client import Condition, Fleet
from gripmon.io.wire import PublishSettings

ROOT = Path(__file__).resolve().parent.parent
FAR = {"translation_m": 0.1, "rotation_rad": 0.0, "tcp_shift_m": [0.0045, 0.0, 0.0]}


@contextmanager
def watching(*arguments: str, stdout: int = subprocess.PIPE) -> Iterator[tuple[subprocess.Popen[str], list[str]]]:
    """The process, and the lines of its output as they come."""
    process = subprocess.Popen(
        [sys.executable, "-m", "gripmon", "watch", *arguments],
        stdout=stdout, stderr=subprocess.PIPE, text=True, cwd=ROOT, bufsize=1,
    )  # fmt: skip
    lines: list[str] = []

    def read() -> None:
        for line in process.stdout or ():
            lines.append(line)  # noqa: PERF402  seen from outside while it goes on

    reader = threading.Thread(target=read)
    reader.start()
    try:
        yield process, lines
    finally:
        process.kill()
        process.wait()
        reader.join()
        for pipe in (process.stdout, process.stderr):
            if pipe is not None:
                pipe.close()


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "gripmon", "watch", *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=120.0)


def conditions(line: str) -> list[tuple[str, str]]:
    return [(monitor["robot"], monitor["condition"]) for monitor in json.loads(line)["monitors"]]


@pytest.fixture
def endpoints() -> tuple[str, str]:
    return free_endpoint(), free_endpoint()


def test_a_killed_monitor_stays_listed_as_gone_before_all_others(endpoints: tuple[str, str]):
    first, second = endpoints
    with (
        remote_monitor(robot="near", listen=[first]),
        remote_monitor(robot="far", listen=[second], answer={"drift": FAR}) as far,
        watching("--json", "--period", "0.2", "--connect", first, "--connect", second) as (process, lines),
    ):
        wait_until(lambda: lines and conditions(lines[-1]) == [("far", "valid"), ("near", "valid")], "both monitors")
        assert [m["drift_m"] for m in json.loads(lines[-1])["monitors"]] == pytest.approx([0.0045, 0.0037416573867739])
        far.send_signal(signal.SIGKILL)
        wait_until(lambda: conditions(lines[-1]) == [("far", "gone"), ("near", "valid")], "the killed one to be listed")
        gone = json.loads(lines[-1])["monitors"][0]
        assert gone["gone_since_ns"] > gone["state"]["stamp_ns"]
        with remote_monitor(robot="far", listen=[second], answer={"verdict": "suspect"}):
            wait_until(lambda: conditions(lines[-1]) == [("far", "suspect"), ("near", "valid")], "it to be back")
        process.send_signal(signal.SIGINT)
        assert process.wait(WAIT_S) == 130
        assert process.stderr is not None and process.stderr.read() == "gripmon: interrupted\n"


def test_once_prints_a_table_and_nobody_is_exit_code_3(endpoints: tuple[str, str]):
    nobody = run("--once", "--seconds", "1", "--connect", endpoints[1])
    assert (nobody.returncode, nobody.stdout) == (3, "")
    (said,) = nobody.stderr.splitlines()
    assert said == f"watch: no monitor is on the network; no connection to {endpoints[1]}, trying again"
    with remote_monitor(listen=[endpoints[0]]):
        for attempt in range(5):  # the first state may come after the table on a slow machine
            once = run("--once", "--transforms", "--seconds", str(2 + attempt), "--connect", endpoints[0])
            assert (once.returncode, once.stderr) == (0, "")
            head, row, summary = once.stdout.splitlines()
            if "valid" in row:
                break
        assert head.split()[:3] == ["monitor", "state", "verdict"]
        assert row.split()[:5] == ["arm/wrist", "tracking", "valid", "3.742", "0.122"]
        assert summary == "1 monitor: 1 valid"


def test_a_log_gets_a_line_for_each_change(endpoints: tuple[str, str]):
    with watching("--period", "0.1", "--connect", endpoints[0]) as (_, lines):
        with remote_monitor(listen=[endpoints[0]]) as monitor:
            wait_until(lambda: any(": tracking, valid, drift mm 3.742" in line for line in lines), "the line")
            monitor.terminate()
            wait_until(lambda: "arm/wrist: stopped since" in lines[-1], "the end")
        said = [line.split("  ", 1)[1] for line in lines if "arm/wrist" in line]
    assert len(said) == len(set(said))


def test_a_terminal_gets_a_table_and_its_screen_back(endpoints: tuple[str, str]):
    here, there = pty.openpty()
    seen = bytearray()

    def read() -> None:
        while True:
            try:
                data = os.read(here, 4096)
            except OSError:
                return
            seen.extend(data)

    reader = threading.Thread(target=read, daemon=True)
    with (
        remote_monitor(listen=[endpoints[0]]),
        watching("--period", "0.1", "--connect", endpoints[0], stdout=there) as (process, _),
    ):
        os.close(there)
        reader.start()
        wait_until(lambda: b"tracking" in seen and b"3.742" in seen, "the table")
        process.send_signal(signal.SIGINT)
        assert process.wait(WAIT_S) == 130
        reader.join(WAIT_S)
    os.close(here)
    assert seen.count(b"\x1b[?1049h") == seen.count(b"\x1b[?1049l") == 1  # the other screen, and back


def test_one_alert_log_through_a_router_that_is_restarted(endpoints: tuple[str, str], tmp_path: Path):
    endpoint, log = endpoints[0], tmp_path / "alerts.jsonl"
    settings = PublishSettings(mode="client", connect=(endpoint,), retry_first_s=0.02, retry_longest_s=0.1)
    monitors = [Published(settings, robot) for robot in ("one", "two")]

    def texts() -> list[tuple[str, str]]:
        told = [json.loads(line) for line in log.read_text().splitlines()]
        return [(t["robot"], t.get("text") or t["event"]) for t in told]

    try:
        for monitor, robot in zip(monitors, ("one", "two"), strict=True):
            monitor.event(said_by(robot, "before"))
        with watching("--alerts", "--json", "--out", str(log), "--connect", endpoint) as (_, lines):
            with router(endpoint):
                wait_until(lambda: log.exists() and len(texts()) >= 4, "two monitors and what they said before")
                monitors[0].event(said_by("one", "during"))
                wait_until(lambda: ("one", "during") in texts(), "the alert")
            wait_until(lambda: texts().count(("one", "vanished")) == 1, "the way to be cut")
            with router(endpoint):
                wait_until(lambda: texts().count(("two", "appeared")) == 2, "the way back")
                monitors[1].event(said_by("two", "after"))
                wait_until(lambda: ("two", "after") in texts(), "the alert")
            shown = [(t["robot"], t.get("text")) for t in map(json.loads, lines)]
        alerts = [entry for entry in texts() if entry[1] in ("before", "during", "after")]
        assert sorted(alerts) == [("one", "before"), ("one", "during"), ("two", "after"), ("two", "before")]
        assert ("two", "after") in shown
    finally:
        for monitor in monitors:
            monitor.close()


def said_by(robot: str, text: str) -> object:
    import msgspec

    return msgspec.structs.replace(alert_record(text), robot=robot)


def test_what_is_no_state_is_counted_and_harms_nobody(endpoints: tuple[str, str]):
    with (
        remote_monitor(listen=[endpoints[0]]),
        watching("--json", "--period", "0.1", "--connect", endpoints[0]) as (_, lines),
        plain_session(connect=endpoints[0]) as session,
    ):
        wait_until(lambda: lines and conditions(lines[-1]) == [("arm", "valid")], "the monitor")
        session.put("gripmon/arm/wrist/state", '{"schema": "gripmon.state/2"}')
        session.put("gripmon/arm/wrist/state", b"\xff\x00")
        wait_until(lambda: json.loads(lines[-1])["unreadable"] == 2, "both to be counted")
        assert conditions(lines[-1]) == [("arm", "valid")]


def test_a_monitor_that_hangs_is_silent_and_not_forgotten(endpoints: tuple[str, str]):
    with remote_monitor(listen=[endpoints[0]]) as monitor, Fleet(connect=[endpoints[0]]) as fleet:
        wait_until(lambda: [s.condition for s in fleet.monitors()] == [Condition.VALID], "the monitor")
        monitor.send_signal(signal.SIGSTOP)
        wait_until(lambda: [s.condition for s in fleet.monitors()] == [Condition.SILENT], "the silence")
        monitor.send_signal(signal.SIGCONT)
        wait_until(lambda: [s.condition for s in fleet.monitors()] == [Condition.VALID], "its voice")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            ["--connect", "tcp/127.0.0.1:1", "--zenoh-config", "x"],
            "watch: --connect has no effect beside --zenoh-config",
        ),
        (["--out", "x"], "watch: --out is for alerts; add --alerts"),
        (["--alerts", "--once"], "watch: --alerts prints only alerts"),
        (["--connect", "nonsense"], "watch: --connect: 'nonsense' is not an endpoint; "),
        (["--zenoh-config", "/nowhere.json5"], "watch: --zenoh-config: no file /nowhere.json5"),
        (["--alerts", "--out", "/nowhere/x"], "--out /nowhere/x: can't be written (No such file or directory)"),
    ],
)
def test_wrong_usage_is_one_line_and_exit_code_2(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
):
    assert main(["watch", "--seconds", "0.1", *arguments]) == 2
    told = capsys.readouterr()
    assert told.out == "" and told.err.startswith(said) and len(told.err.splitlines()) == 1
