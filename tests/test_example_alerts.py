"""``docs/examples/alerts_to_mqtt_and_webhook.py`` with a broker and a web server; what Alertmanager does alone."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest
import yaml
from support import sample_messages
from support.loopback import WAIT_S, accepts, alert_record, free_endpoint, wait_until
from support.published import Published

from gripmon.io.metrics import MetricsServer, MetricsSettings
from gripmon.io.wire import PublishSettings
from gripmon.model.records import StateRecord

ROOT = Path(__file__).resolve().parent.parent
EXAMPLE = ROOT / "docs" / "examples" / "alerts_to_mqtt_and_webhook.py"


class Hook:
    """A web server that answers with one status after the other, 200 in the end, and keeps what it accepted."""

    def __init__(self, *statuses: int) -> None:
        self.accepted: list[bytes] = []
        left = list(statuses)

        class Handler(BaseHTTPRequestHandler):
            def do_POST(handler) -> None:  # noqa: N805  self is the hook's
                body = handler.rfile.read(int(handler.headers["Content-Length"]))
                status = left.pop(0) if left else 200
                if status == 200:
                    self.accepted.append(body)
                handler.send_response(status)
                handler.end_headers()

            def log_message(handler, *_: object) -> None: ...  # noqa: N805

        self._server = HTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self._server.server_port}/"
        self._thread = threading.Thread(target=self._server.serve_forever)
        self._thread.start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def texts(self) -> list[str]:
        return [json.loads(body)["text"] for body in self.accepted]


@contextlib.contextmanager
def ended(process: subprocess.Popen[str]) -> Iterator[subprocess.Popen[str]]:
    try:
        yield process
    finally:
        process.terminate()
        process.communicate(timeout=WAIT_S)


@pytest.fixture
def monitor() -> Iterator[tuple[Published, str]]:
    endpoint = free_endpoint()
    published = Published(PublishSettings(listen=(endpoint,)), identified=True)
    yield published, endpoint
    published.close()


def passing_on(endpoint: str, *places: str) -> contextlib.AbstractContextManager[subprocess.Popen[str]]:
    command = [sys.executable, str(EXAMPLE), "--connect", endpoint, *places]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return ended(subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True))


def test_a_webhook_gets_every_alert_in_order_though_it_fails_at_times(monitor: tuple[Published, str]):
    published, endpoint = monitor
    hook = Hook(503, 400)  # tried again; left out, the second time
    slow = Hook()
    published.event(alert_record("from before"))
    try:
        with passing_on(endpoint, "--webhook", hook.url, "--webhook", slow.url):
            wait_until(lambda: slow.texts() == ["from before"], "the last one from before")
            published.event(alert_record("second"))
            published.event(alert_record("third"))
            wait_until(lambda: len(hook.accepted) == 2, "the others")
    finally:
        hook.close()
        slow.close()
    assert hook.texts() == ["second", "third"]
    assert slow.texts() == ["from before", "second", "third"]
    assert json.loads(slow.accepted[0])["schema"] == "gripmon.alert/1"


@pytest.mark.skipif(shutil.which("mosquitto") is None, reason="mosquitto (Debian) isn't installed")
def test_a_broker_gets_what_came_while_it_was_away(monitor: tuple[Published, str], tmp_path: Path):
    mqtt = pytest.importorskip("paho.mqtt.client", reason="paho-mqtt isn't installed")
    published, endpoint = monitor
    host, _, port = free_endpoint().removeprefix("tcp/").partition(":")
    (tmp_path / "m.conf").write_text(f"listener {port} {host}\nallow_anonymous true\n")
    heard: list[tuple[str, str]] = []
    published.event(alert_record("while it was away"))
    with passing_on(endpoint, "--mqtt", f"{host}:{port}") as process:
        assert process.stderr is not None
        said = iter(process.stderr.readline, "")
        assert any(f"no connection to {host}:{port}; trying again" in line for line in said)
        command = ["mosquitto", "-c", str(tmp_path / "m.conf")]
        with ended(subprocess.Popen(command, stderr=subprocess.DEVNULL, text=True)):
            wait_until(lambda: accepts(f"tcp/{host}:{port}"), "the broker")
            client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
            client.on_connect = lambda *_: client.subscribe("gripmon/+/+/alert", qos=1)
            client.on_message = lambda _, __, each: heard.append((each.topic, json.loads(each.payload)["text"]))
            client.connect(host, int(port))
            client.loop_start()
            wait_until(lambda: heard, "the first")
            assert any(f"{host}:{port}: Success" in line for line in said), "an operator is told that it is connected"
            published.event(alert_record("now"))
            wait_until(lambda: len(heard) == 2, "the second")
            client.loop_stop()
    assert heard == [("gripmon/arm/wrist/alert", "while it was away"), ("gripmon/arm/wrist/alert", "now")]


MANAGER = shutil.which("prometheus-alertmanager") or shutil.which("alertmanager")


@pytest.mark.skipif(
    MANAGER is None or shutil.which("prometheus") is None, reason="prometheus and its Alertmanager aren't installed"
)
def test_alertmanager_alone_does_webhooks(tmp_path: Path):
    """What the runbook says of it: from the shipped rules to a webhook, without any program of ours."""
    hook = Hook()
    ours, manager, prometheus = (free_endpoint().removeprefix("tcp/") for _ in range(3))
    receivers = [{"name": "hook", "webhook_configs": [{"url": hook.url}]}]
    route = {"receiver": "hook", "group_wait": "0s", "group_by": ["robot", "camera"]}
    (tmp_path / "a.yml").write_text(yaml.safe_dump({"route": route, "receivers": receivers}))
    shutil.copy(ROOT / "configs" / "operations" / "alerts.yml", tmp_path)
    told = {
        "global": {"scrape_interval": "1s", "evaluation_interval": "1s"},
        "rule_files": ["alerts.yml"],
        "alerting": {"alertmanagers": [{"static_configs": [{"targets": [manager]}]}]},
        "scrape_configs": [{"job_name": "gripmon", "static_configs": [{"targets": [ours]}]}],
    }
    (tmp_path / "p.yml").write_text(yaml.safe_dump(told))
    state = sample_messages.SAMPLES["state"]
    assert isinstance(state, StateRecord) and state.open_alerts
    commands = [
        [str(MANAGER), f"--config.file={tmp_path}/a.yml", f"--storage.path={tmp_path}/am", "--cluster.listen-address=",
         f"--web.listen-address={manager}"],
        ["prometheus", f"--config.file={tmp_path}/p.yml", f"--storage.tsdb.path={tmp_path}/p",
         f"--web.listen-address={prometheus}"],
    ]  # fmt: skip
    with contextlib.ExitStack() as opened:
        opened.callback(hook.close)
        settings = MetricsSettings(enabled=True, port=int(ours.partition(":")[2]))
        server = opened.enter_context(contextlib.closing(MetricsServer(settings, "arm1", "wrist")))
        server.event(state)
        for command in commands:
            opened.enter_context(ended(subprocess.Popen(command, stderr=subprocess.DEVNULL, text=True)))
        wait_until(lambda: hook.accepted, "the webhook to be called")
    alerts = json.loads(hook.accepted[0])["alerts"]
    labels = next(alert["labels"] for alert in alerts if alert["labels"]["alertname"] == "MonitorAlert")
    severity = state.open_alerts[0].severity.value
    assert (labels["robot"], labels["camera"], labels["severity"]) == ("arm1", "wrist", severity)
