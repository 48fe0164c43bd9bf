"""What the network tests share: free ports, a plain Zenoh session, records with telling values, bounded waiting."""

from __future__ import annotations

import contextlib
import fcntl
import json
import random
import socket
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import pytest
import zenoh

from gripmon.model.records import (
    Alert,
    AlertKind,
    AlertRecord,
    Cause,
    CornerRecord,
    Drift,
    FrameRecord,
    Origin,
    Protection,
    ReferenceRecord,
    Severity,
    Smoothed,
    State,
    StateRecord,
    Transform,
    Verdict,
)

WAIT_S = 60.0


def free_endpoint() -> str:
    """A Zenoh endpoint on a loopback port that is free now, and that no connection of others is given meanwhile: those
    come from a range above it.
    """
    while True:
        endpoint = f"tcp/127.0.0.1:{random.SystemRandom().randrange(10_000, 32_000)}"
        if can_bind(endpoint):
            return endpoint


def free_port() -> int:
    """Its number alone."""
    return int(free_endpoint().rpartition(":")[2])


def can_bind(endpoint: str) -> bool:
    """Could another program listen there?"""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", int(endpoint.rsplit(":", 1)[1])))
        except OSError:
            return False
        return True


def accepts(endpoint: str) -> bool:
    """Does a program listen there?"""
    with socket.socket() as probe:
        probe.settimeout(1.0)
        return probe.connect_ex(("127.0.0.1", int(endpoint.rsplit(":", 1)[1]))) == 0


def wait_until(condition: Callable[[], object], what: str, timeout_s: float = WAIT_S) -> None:
    """Return when the condition holds; fail with ``what`` when it takes too long."""
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s, f"not within {timeout_s:g} s: {what}"
        time.sleep(0.005)


@contextmanager
def plain_session(
    *, connect: str | None = None, listen: str | None = None, mode: str = "client"
) -> Iterator[zenoh.Session]:
    """A Zenoh session that knows nothing of gripmon."""
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps(mode))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("connect/endpoints", json.dumps([connect] if connect else []))
    config.insert_json5("listen/endpoints", json.dumps([listen] if listen else []))
    session = zenoh.open(config)
    try:
        yield session
    finally:
        session.close()


def ask(session: zenoh.Session, key: str) -> list[dict[str, object]]:
    """All replies to a plain ``get``, decoded by the standard library."""
    replies = [reply for reply in session.get(key, timeout=20.0) if reply.ok is not None]
    return [json.loads(reply.ok.payload.to_bytes()) for reply in replies]


def frame_record(seq: int = 7, **changes: object) -> FrameRecord:
    """A record in which no two numbers are alike."""
    values: dict[str, object] = {
        "seq": seq,
        "stamp_ns": 1_700_000_000_123_456_789 + seq,
        "verdict": Verdict.VALID,
        "state": State.TRACKING,
        "source": Origin.UPDATE,
        "cam_T_grip": Transform((0.011, -0.022, 0.133), (0.1, -0.2, 0.3, 0.9273618495495703)),
        "covariance": tuple(1e-9 * (i + 1) for i in range(36)),
        "smoothed": Smoothed(
            (0.012, -0.023, 0.134), (0.11, -0.21, 0.31, 0.92), tuple(2e-9 * (i + 1) for i in range(36))
        ),
        "drift": Drift(0.0015, 0.0026, (0.001, -0.002, 0.003)),
        "reference_id": "plate-2",
        "revision": 3,
        "rms_px": 0.0625,
        "jaw_opening_m": 0.034,
        "corners": (CornerRecord("L_in_near", (12.5, 34.25), 0.05, used=True),),
        "alerts": (Alert(AlertKind.DRIFT, Cause.CAMERA_MOUNT, Severity.WARNING, "moved 1.5 mm"),),
        "name": "frame",
        "protection": Protection(0.00045, 0.0055, 1e-5, "an edge belongs to something else"),
    }
    return FrameRecord(**(values | changes))  # type: ignore[arg-type]


def state_record(seq: int = 7) -> StateRecord:
    return StateRecord(
        robot="arm",
        camera="wrist",
        state=State.TRACKING,
        verdict=Verdict.VALID,
        stamp_ns=5,
        seq=seq,
        reference_id="plate-2",
        revision=3,
        frames=seq,
        frames_refused=0,
        frames_dropped=0,
        frames_per_s=30.0,
        uptime_s=1.0,
        camera_connected=True,
        recording_dropped=0,
        message="",
        version="0",
    )


def reference_record(revision: int = 0) -> ReferenceRecord:
    transform = Transform((0.01, 0.02, 0.13), (0.0, 0.0, 0.0, 1.0))
    return ReferenceRecord("plate-2", revision, 99, "configuration", transform, tuple(float(i) for i in range(36)))


def alert_record(text: str = "moved 1.5 mm") -> AlertRecord:
    return AlertRecord(
        robot="arm", camera="wrist", seq=7, stamp_ns=5, state=State.DRIFTING, reference_id="plate-2", revision=3,
        kind=AlertKind.DRIFT, cause=Cause.CAMERA_MOUNT, severity=Severity.WARNING, text=text,
    )  # fmt: skip


DEFAULT_PORT = 7447
"""Where a configuration that no one has edited listens."""


_held_port: list[IO[str]] = []


def wait_for_default_port() -> None:
    """Until no other program listens where a configuration that no one has edited will, and no other test is about to:
    it is this process's until :func:`give_default_port_back`.  Skips the test if it doesn't become free.
    """
    deadline = time.monotonic() + 600.0
    if not _held_port:
        lock = (Path(tempfile.gettempdir()) / f"gripmon-tests-{DEFAULT_PORT}.lock").open("w")
        while not _locked(lock):
            _wait_or_skip(deadline)
        _held_port.append(lock)
    while True:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            with contextlib.suppress(OSError):
                probe.bind(("127.0.0.1", DEFAULT_PORT))
                return
        _wait_or_skip(deadline)


def give_default_port_back() -> None:
    """Other tests may have it; nothing if it isn't this process's."""
    while _held_port:
        _held_port.pop().close()


def _locked(lock: IO[str]) -> bool:
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _wait_or_skip(deadline: float) -> None:
    if time.monotonic() > deadline:
        pytest.skip(f"another program listens on port {DEFAULT_PORT}")
    time.sleep(0.2)
