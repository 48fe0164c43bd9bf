"""A driver, a router and the daemon in processes of their own: what the monitor makes of frames from the network."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from support.loopback import ask, free_endpoint, plain_session, wait_until
from support.network_daemon import ENVIRONMENT, PREFIX, ROOT, NetworkDaemon, network_config, network_daemon
from support.router_process import plain_config, running

from gripmon.cli import main

FEEDER = ROOT / "tests" / "support" / "frame_feeder.py"
FRAMES = 12
SOURCES = {"png": "{kind: zenoh, key: cell-7/camera}"}
Lines = list[dict[str, Any]]


def key_of(frame_format: str) -> str:
    """Where a driver of that format publishes."""
    return "cell-7/camera" if frame_format == "png" else f"{PREFIX}/image"


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Clutter, a camera that is knocked, a jaw that moves: whatever differs in the frames shows in the transforms."""
    folder = tmp_path_factory.mktemp("network") / "sequence"
    assert main(["simulate", "jaw_cycle", "--out", str(folder), "--seconds", str(FRAMES / 10), "--fps", "10"]) == 0
    return folder


@pytest.fixture(scope="module")
def replayed(sequence: Path) -> Lines:
    out = sequence.parent / "replayed.jsonl"
    config = network_config(sequence, "{enabled: false}", source="{kind: folder, path: .}", name="replay")
    assert main(["replay", str(sequence), "--config", str(config), "--out", str(out)]) == 0
    return lines_of(out)


def lines_of(path: Path) -> Lines:
    """Without what is allowed to differ."""
    lines = [json.loads(line) for line in path.read_bytes().splitlines()]
    own = ("latency_ns", "name", "beside")
    return [{key: value for key, value in line.items() if key not in own} for line in lines]


def fed(sequence: Path, tmp_path: Path, frame_format: str) -> tuple[Lines, NetworkDaemon]:
    """What the daemon makes of the sequence when a driver sends it."""
    endpoint = free_endpoint()
    config = network_config(
        sequence,
        f"{{listen: [{endpoint}], jaw_max_age_s: 60.0}}",
        source=SOURCES.get(frame_format, "{kind: zenoh}"),
        name=frame_format,
    )
    with network_daemon(config, tmp_path) as daemon:
        command = [sys.executable, str(FEEDER), endpoint, str(sequence), key_of(frame_format), frame_format, PREFIX]
        subprocess.run(command, env=ENVIRONMENT, check=True, timeout=300.0)
        assert daemon.stop() == 0
        assert "Traceback" not in daemon.said()
    return lines_of(tmp_path / "estimates.jsonl"), daemon


@pytest.mark.parametrize(
    "frame_format",
    [
        "raw",
        "png",
    ],
)
def test_lossless_frames_give_the_transforms_of_the_files(
    sequence: Path, replayed: Lines, tmp_path: Path, frame_format: str
):
    lines, daemon = fed(sequence, tmp_path, frame_format)
    assert len({line["jaw_opening_m"] for line in lines}) > FRAMES // 2, "the jaw's opening comes with each frame"
    assert lines == replayed
    assert "0 refused, 0 dropped" in daemon.said() and "malformed" not in daemon.said()


@contextmanager
def feeding(folder: Path, endpoint: str, *rest: str) -> Iterator[subprocess.Popen[bytes]]:
    """``gripmon feed`` for ever, as users run it."""
    command = [sys.executable, "-m", "gripmon", "feed", str(folder), "--robot", "simulated"]
    command += ["--connect", endpoint, "--loop", *rest]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, env=ENVIRONMENT)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def state_of(endpoint: str) -> dict[str, Any]:
    with plain_session(connect=endpoint) as session:
        states = ask(session, f"{PREFIX}/state")
    return states[0] if states else {}


@pytest.mark.slow("7 s; lossless frames over the network are in the default run")
def test_a_driver_that_is_killed_is_missed_and_welcome_again(sequence: Path, tmp_path: Path):
    endpoint = free_endpoint()
    config = network_config(sequence, f"{{listen: [{endpoint}]}}", name="killed")
    with network_daemon(config, tmp_path) as daemon:
        daemon.await_saying("state stale, transform unknown (no frames: nothing on gripmon/simulated/wrist/image yet)")
        assert state_of(endpoint)["camera_connected"] is False
        for count in (1, 2):
            with feeding(sequence, endpoint, "--fps", "10", "--format", "jpeg") as driver:
                wait_until(lambda: state_of(endpoint).get("camera_connected") is True, "frames")
                wait_until(lambda before=count: state_of(endpoint)["frames"] > 5 * before, "more of them")
                driver.send_signal(signal.SIGKILL)
                daemon.await_saying("no frames: gripmon/simulated/wrist/image is silent", count)
            wait_until(lambda: state_of(endpoint)["camera_connected"] is False, "the camera to be missed")
        assert daemon.stop() == 0
        assert "Traceback" not in daemon.said()


@pytest.mark.slow("15 s; that a session outlives its router is in the default run")
def test_a_router_may_restart_in_the_middle(sequence: Path, tmp_path: Path):
    """Driver and daemon are its clients.  Nobody is helped: both find it again."""
    endpoint = free_endpoint()
    config = network_config(sequence, f"{{mode: client, connect: [{endpoint}]}}", name="client")
    with running(plain_config(tmp_path, endpoint), endpoint) as router, network_daemon(config, tmp_path) as daemon:
        with feeding(sequence, endpoint, "--fps", "10") as driver:
            wait_until(lambda: state_of(endpoint).get("frames", 0) > 5, "frames through the router")
            router.kill()
            daemon.await_saying("no frames: gripmon/simulated/wrist/image is silent")
            router.start()
            wait_until(lambda: state_of(endpoint).get("camera_connected") is True, "frames again", 60.0)
            before = state_of(endpoint)["frames"]
            wait_until(lambda: state_of(endpoint).get("frames", 0) > before + 5, "more of them")
            driver.send_signal(signal.SIGINT)
            _, said = driver.communicate(timeout=120.0)
            assert driver.returncode == 130 and b"Traceback" not in said
        assert daemon.stop() == 0
        assert "Traceback" not in daemon.said() and "malformed" not in daemon.said()
