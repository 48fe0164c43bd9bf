"""Rubbish over real sessions, from another process, to a daemon that works: it is counted, said once, and survived."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from support.loopback import ask, free_endpoint, plain_session, wait_until
from support.network_daemon import ENVIRONMENT, PREFIX, ROOT, network_config, network_daemon

from gripmon.cli import main

FRAMES, COUNT = 16, 1_000
MOST_GROWTH_BYTES = 48 << 20


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fuzz") / "sequence"
    assert main(["simulate", "static", "--out", str(folder), "--seconds", str(FRAMES / 10), "--fps", "10"]) == 0
    return folder


def in_another_process(script: str, *arguments: object) -> str:
    command = [sys.executable, str(ROOT / "tests" / "support" / script), *map(str, arguments)]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, timeout=300.0)
    assert done.returncode == 0, done.stderr
    return done.stdout


def state_of(endpoint: str) -> dict[str, Any]:
    with plain_session(connect=endpoint) as session:
        return ask(session, f"{PREFIX}/state")[0]


def _counted(state: dict[str, Any]) -> int:
    return state["malformed"] + state["frames_dropped"]


def test_a_daemon_outlives_4000_malformed_payloads_and_goes_on(sequence: Path, tmp_path: Path):
    endpoint = free_endpoint()
    config = network_config(sequence, f"{{listen: [{endpoint}]}}", jaw="{source: zenoh}")
    feed = ("frame_feeder.py", endpoint, sequence, f"{PREFIX}/image", "raw", PREFIX)
    with network_daemon(config, tmp_path) as daemon:
        in_another_process(*feed, 0, FRAMES // 2)
        in_another_process("rubbish_sender.py", endpoint, PREFIX, 1, COUNT)
        resident = psutil.Process(daemon.process.pid).memory_info().rss
        in_another_process("rubbish_sender.py", endpoint, PREFIX, 2, COUNT)
        assert psutil.Process(daemon.process.pid).memory_info().rss - resident < MOST_GROWTH_BYTES
        # One frame and one jaw message each time; every tenth time a command, some of them of a wrong name instead.
        wait_until(lambda: _counted(state_of(endpoint)) >= 4 * COUNT, "everything to be counted")
        state = state_of(endpoint)
        assert _counted(state) <= 4.2 * COUNT
        message = state["message"]
        assert f"malformed frames on {PREFIX}/image: " in message
        assert f"over 1,000 malformed jaw messages on {PREFIX}/jaw: " in message
        with plain_session(connect=endpoint) as session:
            publisher = session.declare_publisher(f"{PREFIX}/jaw")
            wait_until(lambda: publisher.matching_status.matching, "the daemon")
            publisher.put("0.034")
            wait_until(
                lambda: "no jaw opening" not in state_of(endpoint)["message"] or publisher.put("0.034"), "the jaw"
            )
        in_another_process(*feed, FRAMES // 2, FRAMES)
        assert daemon.stop() == 0
        said = daemon.said()
    assert "Traceback" not in said and "internal" not in said and len(said.splitlines()) < 60, said
    for what in ("frame", "jaw message"):
        lines = re.findall(rf"WARNING malformed ({what} on .*) \(logged once\)", said)
        assert 0 < len(lines) == len(set(lines)), "each kind once"
    lines = [json.loads(line) for line in (tmp_path / "estimates.jsonl").read_bytes().splitlines()]
    given = [line for line in lines if line["name"] and line["cam_T_grip"] and line["source"] == "update"]
    assert len(given) == FRAMES, "every good frame is measured"
    truth = [json.loads(line) for line in (sequence / "truth.jsonl").read_text().splitlines()]
    for line, true in zip(given, truth, strict=True):
        error_m = np.subtract(line["cam_T_grip"]["translation_m"], np.array(true["cam_T_grip"])[:3, 3])
        assert np.linalg.norm(error_m) < 1e-3
    assert given[-1]["verdict"] == "valid"
