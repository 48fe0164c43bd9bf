"""Daemon and subscriber in two processes on loopback, as users run them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import zenoh
from scipy.spatial.transform import Rotation
from support.configurations import shipped
from support.daemon_process import ROTATION, TRANSLATION_M
from support.loopback import WAIT_S, accepts, ask, can_bind, free_endpoint, plain_session, wait_until

HERE = Path(__file__).resolve().parent
PREFIX = "gripmon/arm/wrist"


@contextmanager
def daemon(endpoint: str, kind: str = "ticking", *rest: str) -> Iterator[subprocess.Popen[str]]:
    """A daemon process that listens; it is killed at the end if it still runs."""
    command = [sys.executable, str(HERE / "support" / "daemon_process.py"), endpoint, kind, *rest]
    environment = os.environ | {"PYTHONPATH": f"{HERE.parent}:{HERE}"}
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment)
    try:
        wait_until(lambda: process.poll() is not None or accepts(endpoint), "the daemon to listen")
        assert process.poll() is None, process.stderr and process.stderr.read()
        yield process
    finally:
        process.kill()
        process.communicate()


def subscribe(endpoint: str, key: str, count: int) -> list[dict[str, object]]:
    """So many messages as a subscriber in another process gets them."""
    command = [sys.executable, str(HERE / "support" / "plain_subscriber.py"), endpoint, key, str(count)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60.0)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


def test_transform_and_stamp_arrive_as_they_were_meant(endpoint: str):
    before_ns = time.time_ns()
    with daemon(endpoint):
        messages = subscribe(endpoint, f"{PREFIX}/transform", 3)
        after_ns = time.time_ns()
        (reference,) = ask_in_another_session(endpoint, f"{PREFIX}/reference")
    for message in messages:
        transform = message["cam_T_grip"]
        np.testing.assert_allclose(Rotation.from_quat(transform["rotation_xyzw"]).as_matrix(), ROTATION, atol=1e-12)
        assert tuple(transform["translation_m"]) == TRANSLATION_M
        assert isinstance(message["stamp_ns"], int) and before_ns < message["stamp_ns"] < after_ns
        assert 0 < message["latency_ns"] < after_ns - before_ns
    seqs = [message["seq"] for message in messages]
    assert seqs == sorted(set(seqs)), "each once and in order; a busy machine leaves some out"
    assert reference["revision"] == 3 and reference["reference_id"] == "plate-2"


def ask_in_another_session(endpoint: str, key: str) -> list[dict[str, object]]:
    with plain_session(connect=endpoint) as session:
        return ask(session, key)


def test_at_60_frames_a_second_a_subscriber_gets_at_least_58(endpoint: str):
    """Counted by sequence numbers, which the camera gives at 60 a second whatever the machine does besides."""
    with daemon(endpoint):
        seqs = [message["seq"] for message in subscribe(endpoint, f"{PREFIX}/transform", 300)]
    span_s = (seqs[-1] - seqs[0]) / 60.0
    assert seqs == sorted(set(seqs))
    assert (len(seqs) - 1) / span_s >= 58.0


def test_a_killed_daemon_is_seen_to_be_gone(endpoint: str):
    with daemon(endpoint) as process, plain_session(connect=endpoint) as session:
        tokens = session.liveliness().declare_subscriber(f"{PREFIX}/alive", history=True)
        assert tokens.recv().kind == zenoh.SampleKind.PUT
        process.send_signal(signal.SIGKILL)
        gone: list[zenoh.Sample] = []
        wait_until(lambda: (sample := tokens.try_recv()) is not None and not gone.append(sample), "the token to vanish")
        assert [(sample.kind, str(sample.key_expr)) for sample in gone] == [
            (zenoh.SampleKind.DELETE, f"{PREFIX}/alive")
        ]
    wait_until(lambda: can_bind(endpoint), "the port to be free")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 0)])
def test_a_signal_ends_it_with_everything_closed(
    endpoint: str, tmp_path: Path, number: signal.Signals, code: int
):
    estimates = tmp_path / "estimates.jsonl"
    with daemon(endpoint, "ticking", str(estimates)) as process:
        with plain_session(connect=endpoint) as session:
            tokens = session.liveliness().declare_subscriber(f"{PREFIX}/alive", history=True)
            assert tokens.recv().kind == zenoh.SampleKind.PUT
            wait_until(lambda: any(state["frames"] for state in ask(session, f"{PREFIX}/state")), "the loop to run")
            process.send_signal(number)
            assert process.wait(WAIT_S) == code
            assert tokens.recv().kind == zenoh.SampleKind.DELETE
        assert process.stderr is not None
        last = process.stderr.read().splitlines()[-1]
    frames = [json.loads(line) for line in estimates.read_text().splitlines()]
    assert f"stopped after {len(frames)} frames" in last
    assert [frame["seq"] for frame in frames] == list(range(len(frames)))
    wait_until(lambda: can_bind(endpoint), "the port to be free")


def test_sigterm_before_the_loop_runs_ends_it_too(endpoint: str):
    with daemon(endpoint, "starting") as process:
        wait_until(lambda: ask_in_another_session(endpoint, f"{PREFIX}/state"), "the start-up to be under way")
        process.send_signal(signal.SIGTERM)
        assert process.wait(WAIT_S) == 0


def test_a_process_that_forgets_to_close_its_publisher_ends(endpoint: str):
    command = [sys.executable, str(HERE / "support" / "daemon_process.py"), endpoint, "forgetful"]
    environment = os.environ | {"PYTHONPATH": f"{HERE.parent}:{HERE}"}
    assert subprocess.run(command, timeout=WAIT_S, env=environment).returncode == 5


def test_the_whole_daemon_from_camera_to_subscriber(endpoint: str, tmp_path: Path):
    """``gripmon run`` as shipped, slower for slow machines: what a subscriber got, in order, is what was written down.

    A busy machine leaves out messages: the newest counts, and none waits for a subscriber.
    """
    from rerun.chunk import RrdReader

    changes = ("tcp/127.0.0.1:7447", endpoint), ("fps: 60.0", "fps: 15.0")
    (tmp_path / "demo.yaml").write_text(shipped("demo.yaml", *changes))
    command = [sys.executable, "-m", "gripmon", "run", str(tmp_path / "demo.yaml"), "--out", str(tmp_path / "out")]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=HERE.parent, start_new_session=True)
    try:
        wait_until(lambda: process.poll() is not None or accepts(endpoint), "the daemon to listen", 60.0)
        messages = subscribe(endpoint, "gripmon/demo/wrist/transform", 45)
        os.killpg(process.pid, signal.SIGINT)  # as Ctrl-C reaches every process of the group
        assert process.wait(WAIT_S) == 130
    finally:
        process.kill()
        _, errors = process.communicate()
    assert "Traceback" not in errors and "internal error" not in errors
    lines = [json.loads(line) for line in (tmp_path / "out" / "estimates.jsonl").read_text().splitlines()]
    written = {line.pop("seq"): line for line in lines}
    seqs = [message.pop("seq") for message in messages]
    assert len(seqs) == 45 and seqs == sorted(set(seqs)) and len(written) == len(lines)
    ids = {message.pop("monitor_id") for message in messages}  # who says it belongs to the wire alone
    assert len(ids) == 1 and f"-{process.pid}-" in str(ids)
    for seq, message in zip(seqs, messages, strict=True):
        assert message == {name: value for name, value in written[seq].items() if name != "monitor_id"}
    assert {"valid"} <= {message["verdict"] for message in messages}
    (recording,) = (tmp_path / "out").glob("*.rrd")
    assert RrdReader(recording).store() is not None  # fails for a file that was not finished
