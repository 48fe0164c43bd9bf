"""``gripmon run`` as users start it, on a network that is wrong, not there yet, or full of nonsense."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zenoh
from support.configurations import shipped, with_sections
from support.loopback import WAIT_S, ask, free_endpoint, plain_session, wait_until

from gripmon.cli import main
from gripmon.model.records import CommandReply, FrameRecord, from_json

ROOT = Path(__file__).resolve().parent.parent
PREFIX = "gripmon/demo/wrist"


def configured(folder: Path, publish: str, *more: str) -> Path:
    """The demo's configuration, slower, with another section ``publish``."""
    path, text = folder / "here.yaml", shipped("demo.yaml", ("fps: 60.0", "fps: 10.0"))
    path.write_text("\n".join([with_sections(text, publish=publish), *more]))
    return path


@contextmanager
def running(config: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "gripmon", "run", str(config), *options]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=ROOT)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def refused(config: Path) -> str:
    """What a run that can't start says: one line, exit code 2."""
    command = [sys.executable, "-m", "gripmon", "run", str(config)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60.0, cwd=ROOT)
    assert done.returncode == 2, done.stderr
    (line,) = done.stderr.splitlines()
    return line


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


def test_a_port_in_use_is_said_in_one_line(tmp_path: Path, endpoint: str):
    config = configured(tmp_path, f"{{listen: [{endpoint}]}}")
    with plain_session(listen=endpoint, mode="peer"):
        line = refused(config)
    assert line.startswith(f"{config}: publish.listen: can't open a Zenoh session: ")
    assert endpoint in line and "Address already in use" in line


@pytest.mark.parametrize(
    ("file", "text", "said"),
    [
        ("there.json5", None, "publish.zenoh_config: no file "),
        ("there.yaml", "mode: sideways", "publish.zenoh_config: "),
    ],
)
def test_a_bad_zenoh_configuration_is_said_in_one_line(tmp_path: Path, file: str, text: str | None, said: str):
    if text is not None:
        (tmp_path / file).write_text(text)
    config = configured(tmp_path, f"{{zenoh_config: {file}}}")
    line = refused(config)
    assert line.startswith(f"{config}: {said}") and file in line and ".rs:" not in line


def test_malformed_messages_are_counted_in_the_state(tmp_path: Path, endpoint: str):
    config = configured(tmp_path, f"{{listen: [{endpoint}]}}")
    config.write_text(config.read_text().replace("source: frames", "source: zenoh"))
    with running(config) as process, opened_when_it_listens(process, endpoint) as session:
        wait_until(lambda: ask(session, f"{PREFIX}/state"), "the state", 60.0)
        for reply in session.get(f"{PREFIX}/cmd/undo", payload=b"nonsense", timeout=WAIT_S):
            assert reply.err is not None
            assert json.loads(reply.err.payload.to_bytes())["schema"] == "gripmon.error/1"
        wait_until(lambda: ask(session, f"{PREFIX}/state")[0]["malformed"] == 1, "the count")


def test_a_snapshot_of_the_real_monitor_can_be_replayed(tmp_path: Path, endpoint: str):
    """The image that came measures as the record beside it says."""
    config, out = configured(tmp_path, f"{{listen: [{endpoint}]}}"), tmp_path / "now"
    with running(config) as process, opened_when_it_listens(process, endpoint) as session:

        def valid() -> bool:
            return any(record["verdict"] == "valid" for record in ask(session, f"{PREFIX}/transform"))

        wait_until(valid, "a valid transform", 60.0)
        assert main(["send", "snapshot", "--robot", "demo", "--connect", endpoint, "--out", str(out)]) == 0
    reply = from_json((out / "snapshot-1.json").read_bytes(), CommandReply)
    assert reply.snapshot is not None and reply.snapshot.image is not None and reply.monitor is not None
    then, about = reply.snapshot.record, reply.snapshot.image
    assert (about.width_px, about.height_px) == (768, 576)
    assert then.reference_id == reply.monitor.references[-1].reference_id == reply.reference_id
    lines = tmp_path / "again.jsonl"
    assert main(["replay", str(out), "--config", str(config), "--out", str(lines)]) == 0
    (again,) = (from_json(line, FrameRecord) for line in lines.read_bytes().splitlines())
    assert again.stamp_ns == then.stamp_ns
    measured = {corner.id: corner.uv_px for corner in again.corners if corner.uv_px is not None}
    both = [corner for corner in then.corners if corner.uv_px is not None and corner.id in measured]
    assert len(both) >= 4
    for corner in both:
        assert corner.uv_px == pytest.approx(measured[corner.id], abs=0.3), "px, from two starting points"


@contextmanager
def opened_when_it_listens(process: subprocess.Popen[str], endpoint: str) -> Iterator[zenoh.Session]:
    from support.loopback import accepts

    wait_until(lambda: process.poll() is not None or accepts(endpoint), "the daemon to listen", 60.0)
    assert process.poll() is None
    with plain_session(connect=endpoint) as session:
        yield session
