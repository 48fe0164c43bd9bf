"""Running for years: signs of life for a service manager, logs for collectors, alarms, files of earlier versions."""

from __future__ import annotations

import contextlib
import json
import logging
import lzma
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
import yaml
from support import sample_messages
from support.configurations import shipped, with_sections
from support.loopback import WAIT_S, accepts, alert_record, frame_record, free_endpoint, wait_until
from support.stand_ins import show

from gripmon.daemon.service import ServiceManager, log_to_stderr
from gripmon.io.metrics import MetricsServer, MetricsSettings
from gripmon.judge.statefile import unpack
from gripmon.model.records import AlertKind, Cause, StateRecord, Verdict
from gripmon.record.read import open_recordings

ROOT = Path(__file__).resolve().parent.parent
OPERATIONS = ROOT / "configs" / "operations"
KEPT = ROOT / "tests" / "kept"


# --- the service manager ---


@contextlib.contextmanager
def manager(folder: Path) -> Iterator[socket.socket]:
    """What systemd is to a service: a socket that datagrams come to."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as heard:
        heard.bind(str(folder / "notify"))
        heard.settimeout(WAIT_S)
        yield heard


def next_of(heard: socket.socket, kind: str) -> str:
    """The next message that begins so; others are passed over."""
    while not (message := heard.recv(4096).decode()).startswith(kind):
        pass
    return message


def test_systemd_is_told_when_it_is_ready_that_it_lives_and_that_it_ends(tmp_path: Path):
    with manager(tmp_path) as heard:
        asked = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "400000"}
        asked["PYTHONPATH"] = f"{ROOT}:{ROOT / 'tests'}"
        command = [sys.executable, str(ROOT / "tests" / "support" / "daemon_process.py"), free_endpoint(), "ticking"]
        process = subprocess.Popen(command, env=os.environ | asked, stderr=subprocess.DEVNULL)
        try:
            assert next_of(heard, "STATUS=").startswith("STATUS=state acquiring, transform unknown")
            next_of(heard, "READY=1")
            assert next_of(heard, "STATUS=") == "STATUS=state tracking, transform valid"
            for _ in range(3):
                next_of(heard, "WATCHDOG=1")
            process.send_signal(signal.SIGSTOP)  # what hangs says nothing, so that systemd restarts it
            time.sleep(0.2)
            heard.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                while heard.recv(4096):
                    pass
            heard.settimeout(1.0)
            with pytest.raises(TimeoutError):
                heard.recv(4096)
            process.send_signal(signal.SIGCONT)
            heard.settimeout(WAIT_S)
            next_of(heard, "WATCHDOG=1")
            process.send_signal(signal.SIGTERM)
            next_of(heard, "STOPPING=1")
            assert process.wait(WAIT_S) == 0
        finally:
            process.kill()
            process.wait()


def test_who_asks_for_no_sign_of_life_gets_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with manager(tmp_path) as heard:
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", "400000")
        monkeypatch.setenv("WATCHDOG_PID", "1")  # of another process
        service = ServiceManager()
        service.alive(0.0)
        service.ready()
        assert heard.recv(4096) == b"READY=1"


def test_a_manager_that_is_gone_is_said_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "nobody"))
    service = ServiceManager()
    with caplog.at_level(logging.WARNING, "gripmon"):
        service.ready()
        service.stopping()
    assert [record.getMessage() for record in caplog.records] == [
        f"NOTIFY_SOCKET {tmp_path / 'nobody'}: No such file or directory"
    ]


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze isn't installed")
def test_systemd_takes_the_unit(tmp_path: Path):
    text = (OPERATIONS / "gripmon@.service").read_text()
    unit = tmp_path / "gripmon@.service"
    unit.write_text(text.replace("/opt/gripmon/bin/gripmon ", f"{shutil.which('true')} "))
    done = subprocess.run(["systemd-analyze", "verify", str(unit)], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


# --- logs ---


def test_json_lines_for_collectors(capsys: pytest.CaptureFixture[str]):
    logger = logging.getLogger("gripmon")
    before = (logger.handlers, logger.level, logger.propagate)
    try:
        log_to_stderr(as_json=True)
        began_s = time.time()
        logging.getLogger("gripmon.daemon").warning('a "quoted"\nline of %d', 2)
        try:
            raise ValueError("wrong")
        except ValueError as error:
            logger.error("it failed", exc_info=error)
        first, second = map(json.loads, capsys.readouterr().err.splitlines())
    finally:
        logger.handlers, logger.level, logger.propagate = before
    assert abs(first.pop("time") - began_s) < 10.0
    assert first == {"level": "warning", "logger": "gripmon.daemon", "text": 'a "quoted"\nline of 2'}
    assert second["trace"].startswith("Traceback") and second["trace"].endswith("ValueError: wrong")


def test_run_writes_them(tmp_path: Path):
    config = tmp_path / "c.yaml"
    off = "{enabled: false}"
    config.write_text(with_sections(shipped(), publish=off, recording=off))
    command = [sys.executable, "-m", "gripmon", "run", str(config), "--duration", "1", "--log-json"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=WAIT_S * 4)
    texts = [json.loads(line)["text"] for line in done.stderr.splitlines()]
    assert texts[-1].startswith("stopped after ")


# --- alarms ---


def used_metrics(text: str) -> set[str]:
    return set(re.findall(r"gripmon_\w+", text))


@pytest.fixture
def metrics() -> Iterator[int]:
    """The port of a server of metrics that has something of each kind to say."""
    port = int(free_endpoint().rsplit(":", 1)[1])
    with contextlib.closing(MetricsServer(MetricsSettings(enabled=True, port=port), "arm1", "wrist")) as server:
        state = sample_messages.SAMPLES["state"]
        assert isinstance(state, StateRecord)
        server.event(state)
        server.event(alert_record())
        show(server, frame_record(verdict=Verdict.VALID))
        yield port


def queries() -> list[str]:
    """Of the dashboard, with its variables filled in."""
    panels = json.loads((OPERATIONS / "dashboard.json").read_text())["panels"]
    return [
        target["expr"].replace("$robot", ".*").replace("$camera", ".*")
        for panel in panels
        for target in panel["targets"]
    ]


def test_rules_and_dashboard_ask_for_what_there_is(metrics: int):
    with urllib.request.urlopen(f"http://127.0.0.1:{metrics}/metrics", timeout=WAIT_S) as answer:
        found = used_metrics(answer.read().decode())
    used = used_metrics((OPERATIONS / "alerts.yml").read_text()) | used_metrics(" ".join(queries()))
    assert len(used) > 12 and used <= found


@pytest.mark.skipif(shutil.which("promtool") is None, reason="promtool (Debian's prometheus) isn't installed")
def test_the_rules_fire_when_they_should(tmp_path: Path):
    shutil.copy(OPERATIONS / "alerts.yml", tmp_path)
    labels = 'job="gripmon",instance="cell:9464",robot="arm1",camera="wrist"'
    series = [
        (f"up{{{labels}}}", "1+0x20 0x20"),
        (f"gripmon_state_timestamp_seconds{{{labels}}}", "0+15x40"),
        (f'gripmon_tcp_shift_meters{{{labels},axis="x"}}', "0x20 -0.0021x20"),
        (f'gripmon_verdict{{{labels},verdict="valid"}}', "1x40"),
    ]
    names = {"instance": "cell:9464", "robot": "arm1", "camera": "wrist"}
    shifted = {"severity": "error", "robot": "arm1", "camera": "wrist"}
    moment = [
        ("4m", "TcpShifted", []),
        ("6m", "TcpShifted", [(shifted, "arm1/wrist: the TCP is 0.0021 m beside its reference")]),
        ("4m", "MonitorGone", []),
        (
            "6m",
            "MonitorGone",
            [(names | {"severity": "error", "job": "gripmon"}, "cell:9464: no monitor answers, or its loop hangs")],
        ),
        ("6m", "TransformUnusable", []),
    ]
    test = {
        "rule_files": ["alerts.yml"],
        "evaluation_interval": "15s",
        "tests": [
            {
                "interval": "15s",
                "input_series": [{"series": name, "values": values} for name, values in series],
                "alert_rule_test": [
                    {
                        "eval_time": at,
                        "alertname": name,
                        "exp_alerts": [
                            {"exp_labels": labels, "exp_annotations": {"summary": text}} for labels, text in alerts
                        ],
                    }
                    for at, name, alerts in moment
                ],
            }
        ],
    }
    (tmp_path / "test.yml").write_text(yaml.safe_dump(test))
    done = subprocess.run(["promtool", "test", "rules", "test.yml"], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.skipif(shutil.which("prometheus") is None, reason="prometheus isn't installed")
def test_a_prometheus_answers_every_query_of_the_dashboard(metrics: int, tmp_path: Path):
    address = free_endpoint().removeprefix("tcp/")
    scrape = {"job_name": "gripmon", "scrape_interval": "1s", "static_configs": [{"targets": [f"127.0.0.1:{metrics}"]}]}
    (tmp_path / "p.yml").write_text(yaml.safe_dump({"scrape_configs": [scrape]}))
    command = ["prometheus", f"--config.file={tmp_path / 'p.yml'}", f"--storage.tsdb.path={tmp_path / 'data'}"]
    process = subprocess.Popen([*command, f"--web.listen-address={address}"], stderr=subprocess.DEVNULL)

    def asked(query: str) -> list[object]:
        url = f"http://{address}/api/v1/query?{urllib.parse.urlencode({'query': query})}"
        with urllib.request.urlopen(url, timeout=WAIT_S) as answer:
            return list(json.load(answer)["data"]["result"])

    try:
        wait_until(lambda: accepts(f"tcp/{address}"), "Prometheus")

        def scraped_twice() -> bool:
            with contextlib.suppress(urllib.error.URLError):
                return bool(asked("count_over_time(gripmon_info[1m]) > 2"))
            return False

        wait_until(scraped_twice, "three scrapes")
        empty = [query for query in queries() if not asked(query)]
        assert empty == []
    finally:
        process.terminate()
        process.wait(WAIT_S)


def test_the_runbook_has_every_alert_and_cause():
    page = (ROOT / "docs" / "howto" / "operate.md").read_text()
    rows = {
        name
        for line in page.splitlines()
        if line.startswith("| `")
        for name in re.findall(r"`(\w+)`", line.split("|")[1])
    }
    assert rows == {kind.value for kind in AlertKind if kind.value} | {cause.value for cause in Cause if cause.value}


# --- files of earlier versions ---


def test_a_state_file_of_an_earlier_version_is_read():
    state = unpack((KEPT / "state.json").read_bytes()).state
    assert [(reference.reference_id, reference.revision) for reference in state.references] == [("demo-calibration", 0)]
    assert [(each.topic, each.alert.kind, each.alert.cause) for each in state.alerts] == [
        ("motion", AlertKind.DRIFT, Cause.UNKNOWN)
    ]
    assert state.cam_T_grip is not None
    assert state.cam_T_grip.translation_m == (0.000597295714525558, 0.005899351611529782, 0.11938553681998723)


def test_of_a_state_that_still_holds_a_learnt_look_all_but_that_is_kept():
    """Of a monitor whose look was a measurement; the strips were in it."""
    data = lzma.decompress((KEPT / "state_look.json.xz").read_bytes())
    written = json.loads(data)["content"]["state"]
    assert {"finer", "strips"} <= written["look"].keys()
    again = json.loads(msgspec.json.encode(unpack(data).state))
    look = written.pop("look")
    references = [each | {"with_gripper": False} for each in written["references"]]  # which it said nothing of
    assert again == written | {"strips": look["strips"], "references": references}


def test_a_recording_of_an_earlier_version_is_read(tmp_path: Path):
    file = tmp_path / "kept.rrd"
    file.write_bytes(lzma.decompress((KEPT / "recording.rrd.xz").read_bytes()))
    collection = open_recordings([file])
    assert collection.faults == ()
    (recording,) = collection.recordings
    assert (recording.robot, recording.camera) == ("demo", "wrist")
    assert recording.frames.seq.tolist() == list(range(24))
    assert [(alert.kind, alert.cause) for alert in recording.alerts] == [(AlertKind.DRIFT, Cause.UNKNOWN)]
    done = subprocess.run(
        [sys.executable, "-m", "gripmon", "report", str(file), "--json", "-"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    (reported,) = json.loads(done.stdout)["recordings"]
    # The alert of then said a drift: the frames show the TCP 4.5 mm aside from one to the next.
    (event,) = reported["events"]
    assert event["kind"] == "step" and event["moved"]["size_m"] == pytest.approx(4.54e-3, abs=2e-5)
