"""Metrics, read over HTTP by the parser of those who defined the format, beside what the daemon says elsewhere."""

from __future__ import annotations

import contextlib
import math
import random
import re
import signal
import socket
import struct
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
from prometheus_client.parser import text_string_to_metric_families
from support import sample_messages
from support.loopback import (
    WAIT_S,
    accepts,
    alert_record,
    ask,
    can_bind,
    frame_record,
    free_endpoint,
    free_port,
    plain_session,
    state_record,
    wait_until,
)
from support.stand_ins import show
from test_run_on_the_network import PREFIX, configured, refused, running

from gripmon.cli import main
from gripmon.io.metrics import LATENCY_BOUNDS_S, MetricsError, MetricsServer, MetricsSettings
from gripmon.judge.policy import PolicySettings
from gripmon.model.records import AlertEvent, Severity, State, StateRecord, ValidBy, Verdict

ROOT = Path(__file__).resolve().parent.parent


def scraped(port: int) -> dict[str, dict[tuple[tuple[str, str], ...], float]]:
    """Samples by name and labels, those of robot and camera left out."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=WAIT_S) as answer:
        text = answer.read().decode()
    found: dict[str, dict[tuple[tuple[str, str], ...], float]] = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            labels = tuple((k, v) for k, v in sorted(sample.labels.items()) if k not in ("robot", "camera"))
            found.setdefault(sample.name, {})[labels] = sample.value
    return found


def only(found: dict[str, dict[tuple[tuple[str, str], ...], float]], name: str) -> float:
    ((labels, value),) = found[name].items()
    assert labels == ()
    return value


@pytest.fixture
def server() -> Iterator[tuple[MetricsServer, int]]:
    port = free_port()
    with contextlib.closing(MetricsServer(MetricsSettings(enabled=True, port=port), "arm1", "wrist")) as server:
        yield server, port


@pytest.mark.slow("13 s: a daemon; each figure of the page is in the default run")
def test_a_daemon_tells_prometheus_what_it_tells_the_network(tmp_path: Path):
    endpoint, port = free_endpoint(), free_port()
    config = configured(tmp_path, f'{{listen: ["{endpoint}"]}}', f"metrics: {{enabled: true, port: {port}}}")
    with running(config) as process, contextlib.ExitStack() as opened:
        wait_until(lambda: accepts(endpoint) and accepts(f"tcp/127.0.0.1:{port}"), "network and server")
        session = opened.enter_context(plain_session(connect=endpoint))

        def said() -> StateRecord | None:
            answers = ask(session, f"{PREFIX}/state")
            return msgspec.convert(answers[0], StateRecord) if answers else None

        def both() -> bool:
            nonlocal state, found
            state, found = said(), scraped(port)
            return state is not None and state.frames > 20 and state == said()

        state, found = None, {}
        wait_until(both, "a scrape while no new state was said")
        assert state is not None
        for name, value in (
            ("gripmon_frames_total", state.frames),
            ("gripmon_frames_refused_total", state.frames_refused),
            ("gripmon_frames_dropped_total", state.frames_dropped),
            ("gripmon_recording_dropped_total", state.recording_dropped),
            ("gripmon_recording_images_dropped_total", state.recording_images_dropped),
            ("gripmon_reference_revision", state.revision),
            ("gripmon_frames_per_second", state.frames_per_s),
            ("gripmon_sigma_meters", state.sigma_m),
            ("gripmon_protection_meters", state.protection_m),
            ("gripmon_alert_limit_meters", PolicySettings().alert_limit_m),
            ("gripmon_camera_connected", state.camera_connected),
        ):
            assert only(found, name) == value, name
        assert only(found, "gripmon_state_timestamp_seconds") == pytest.approx(1e-9 * state.stamp_ns, abs=1e-6)
        assert found["gripmon_tcp_shift_meters"] == {
            (("axis", axis),): shift for axis, shift in zip("xyz", state.tcp_shift_m or (), strict=True)
        }
        assert {labels[0][1] for labels, value in found["gripmon_state"].items() if value} == {state.state.value}
        assert {labels[0][1] for labels, value in found["gripmon_verdict"].items() if value} == {state.verdict.value}
        assert found["gripmon_info"] == {(("reference", state.reference_id), ("version", state.version)): 1.0}
        # Counted in the loop itself, and so ahead of the state by what came since.
        counted = only(found, "gripmon_latency_seconds_count")
        assert state.frames <= counted == sum(found["gripmon_verdicts_total"].values()) < state.frames + 600
        assert 0.0 < only(found, "gripmon_latency_seconds_sum") / counted < 1.0
        process.send_signal(signal.SIGTERM)
        assert process.wait(WAIT_S) == 0
    assert can_bind(f"tcp/127.0.0.1:{port}")


def test_the_latency_is_a_histogram(server: tuple[MetricsServer, int]):
    tally, port = server
    chance = random.Random(7)
    values_ns = [round(10 ** chance.uniform(5.0, 9.5)) for _ in range(500)]
    values_ns += [round(1e9 * bound) for bound in LATENCY_BOUNDS_S]  # on a bound counts as below it
    for value in values_ns:
        show(tally, frame_record(latency_ns=value))
    found = scraped(port)
    for labels, count in found["gripmon_latency_seconds_bucket"].items():
        bound = float(dict(labels)["le"])
        assert count == sum(value <= 1e9 * bound for value in values_ns), bound
    assert len(found["gripmon_latency_seconds_bucket"]) == len(LATENCY_BOUNDS_S) + 1
    assert only(found, "gripmon_latency_seconds_sum") == pytest.approx(1e-9 * sum(values_ns))


def test_alerts_are_counted_when_they_are_new(server: tuple[MetricsServer, int]):
    tally, port = server
    raised = msgspec.structs.replace(alert_record(), event=AlertEvent.RAISED)
    others = [msgspec.structs.replace(raised, event=event) for event in (AlertEvent.UPDATED, AlertEvent.CLEARED)]
    noted = msgspec.structs.replace(raised, event=AlertEvent.NOTED, severity=Severity.INFO)
    for alert in (raised, *others, raised, noted):
        tally.event(alert)
    state = sample_messages.SAMPLES["state"]
    assert isinstance(state, StateRecord)
    tally.event(state)
    names = (("cause", "camera_mount_moved"), ("kind", "drift"))
    found = scraped(port)
    assert found["gripmon_alerts_total"] == {
        (*names, ("severity", "warning")): 2.0,
        (*names, ("severity", "info")): 1.0,
    }
    assert found["gripmon_open_alerts"] == {
        (("severity", "info"),): 0.0, (("severity", "warning"),): 1.0, (("severity", "error"),): 0.0
    }  # fmt: skip


def test_what_is_not_known_has_no_sample(server: tuple[MetricsServer, int]):
    tally, port = server
    assert "gripmon_frames_total" not in scraped(port) and "process_resident_memory_bytes" in scraped(port)
    tally.event(msgspec.structs.replace(state_record(), verdict=Verdict.UNKNOWN, state=State("napping")))
    show(tally, frame_record(verdict=Verdict.UNKNOWN, drift=None))
    found = scraped(port)
    assert (
        not {
            "gripmon_sigma_meters",
            "gripmon_protection_meters",
            "gripmon_tcp_shift_meters",
            "gripmon_rotation_radians",
        }
        & found.keys()
    )
    assert found["gripmon_state"][(("state", "napping"),)] == 1.0 and sum(found["gripmon_state"].values()) == 1.0
    show(tally, frame_record())
    assert math.isclose(only(scraped(port), "gripmon_rotation_radians"), 0.0026)


def test_the_bound_and_its_limit_are_gauges(server: tuple[MetricsServer, int]):
    tally, port = server
    by = ValidBy.REFERENCE
    tally.event(msgspec.structs.replace(state_record(), protection_m=3.5e-4, alert_limit_m=1e-3, valid_by=by))
    found = scraped(port)
    assert found["gripmon_valid_by"] == {(("valid_by", "reference"),): 1.0, (("valid_by", "absolute"),): 0.0}
    assert (only(found, "gripmon_protection_meters"), only(found, "gripmon_alert_limit_meters")) == (3.5e-4, 1e-3)


def test_a_port_that_is_taken_is_said_at_the_start(tmp_path: Path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        config = configured(tmp_path, "{enabled: false}", f"metrics: {{enabled: true, port: {port}}}")
        line = refused(config)
    assert line.startswith(f"{config}: metrics.port: can't listen at 127.0.0.1:{port} (Address already in use); a port")


def test_clients_that_hang_or_hang_up_hold_up_nobody(
    server: tuple[MetricsServer, int], capfd: pytest.CaptureFixture[str]
):
    tally, port = server
    idle = [socket.create_connection(("127.0.0.1", port)) for _ in range(5)]
    with socket.create_connection(("127.0.0.1", port)) as gone:
        gone.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # its end is a reset
        gone.sendall(b"GET /metrics HTTP/1.0\r\nX: ")
    assert "process_resident_memory_bytes" in scraped(port)
    tally.close()
    tally.close()
    assert can_bind(f"tcp/127.0.0.1:{port}")
    for each in idle:
        each.close()
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("address", ["192.0.2.1", "no such host", "a..b"])
def test_an_address_that_cannot_be_is_said(address: str):
    with pytest.raises(MetricsError, match=r"^metrics.address: can't listen at .* \(.+\); an address of this machine"):
        MetricsServer(MetricsSettings(enabled=True, address=address, port=free_port()), "arm1", "wrist")


def test_a_missing_package_is_said_by_check(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    config = configured(tmp_path, "{enabled: false}", "metrics: {enabled: true}")
    assert main(["check", str(config), "--verbose"]) == 0
    assert re.search(r"^metrics +http://127.0.0.1:9464/metrics$", capsys.readouterr().out, re.MULTILINE)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert main(["check", str(config)]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"{config}: metrics.enabled: is true, but the package prometheus-client is missing; pip ")
    assert said.count("\n") == 1


def test_without_metrics_the_package_is_not_imported():
    code = "import sys, gripmon.daemon.config, gripmon.io.metrics; print('prometheus_client' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout == "False\n"


@pytest.mark.usefixtures("tools_importable")
def test_the_page_lists_what_there_is(server: tuple[MetricsServer, int]):
    tally, port = server
    state = sample_messages.SAMPLES["state"]
    assert isinstance(state, StateRecord)
    tally.event(state)
    tally.event(alert_record())
    show(tally, frame_record())
    from pages import fields

    page = fields.page()
    assert "| `gripmon_frames_dropped_total` | counter |  | frames that came while another one was processed |" in page
    found = {name for name in scraped(port) if name.startswith("gripmon_")}
    families = {re.sub(r"(?<=_seconds)_(bucket|sum|count)$", "", name) for name in found}
    assert set(re.findall(r"^\| `(gripmon_\w+)` \|", page, re.MULTILINE)) == families
