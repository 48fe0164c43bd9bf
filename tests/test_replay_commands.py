"""``gripmon replay`` of a daemon's runs that took commands, a kept state and the network's openings: to the byte."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from support.configurations import shipped, with_sections
from support.loopback import WAIT_S, accepts, ask, free_endpoint, plain_session, wait_until
from support.network_daemon import ENVIRONMENT
from support.replayed import EVERY_FRAME, replayed, without_latency

from gripmon.judge.statefile import unpack

PREFIX = "gripmon/demo/wrist"


def configured(folder: Path, endpoint: str, **sections: str) -> Path:
    """The demo's configuration with other sections, each in braces."""
    sections = {
        "publish": f"{{listen: ['{endpoint}']}}",
        "recording": EVERY_FRAME,
        "source": "{kind: simulator, scenario: creep, duration_s: 6.0, fps: 30.0, realtime: false, ends: true}",
        **sections,
    }
    path = folder / "monitor.yaml"
    path.write_text(with_sections(shipped(), **sections))
    return path


@contextmanager
def running(config: Path, out: Path, *options: str) -> Iterator[Any]:
    command = [sys.executable, "-m", "gripmon", "run", str(config), "--out", str(out), *options]
    with (out.parent / f"{out.name}.txt").open("wb") as said:
        process = subprocess.Popen(command, stderr=said, env=ENVIRONMENT)
        try:
            yield process
        finally:
            process.kill()
            process.wait()


class Told:
    """Sends commands to a monitor and hears what it publishes."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session

    def newest(self) -> dict[str, Any]:
        records = ask(self._session, f"{PREFIX}/transform")
        return records[-1] if records else {"seq": -1, "revision": -1}

    def await_frames(self, more: int) -> None:
        first = self.newest()["seq"]
        wait_until(lambda: self.newest()["seq"] >= first + more, f"{more} more frames")

    def await_revision(self, revision: int) -> None:
        wait_until(lambda: self.newest()["revision"] >= revision, f"revision {revision}")

    def tell(self, name: str, argument: str = "") -> bool:
        """Whether it was done."""
        payload = json.dumps({"argument": argument}).encode()
        (reply,) = self._session.get(f"{PREFIX}/cmd/{name}", payload=payload, timeout=WAIT_S)
        assert reply.ok is not None, reply.err
        return bool(json.loads(reply.ok.payload.to_bytes())["done"])

    def await_done(self, name: str) -> bool:
        """Tell it again and again until it is done, with refusals before that."""
        wait_until(lambda: self.tell(name), f"{name} done")
        return True


@contextmanager
def jaw_on_network(session: zenoh.Session) -> Iterator[None]:
    """A robot that reports an opening a little off, at its own pace."""
    rng, over = np.random.default_rng(5), threading.Event()

    def report() -> None:
        while not over.wait(0.015):
            session.put(f"{PREFIX}/jaw", f"{0.034 + 1e-5 * rng.standard_normal()!r}".encode())

    thread = threading.Thread(target=report)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@pytest.mark.slow("24 s; a folder is replayed to the byte in the default run, without commands")
def test_a_run_with_commands_and_a_kept_state_is_decided_again_to_the_byte(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Two runs, the second from the state that the first kept; the jaw opening comes over the network in both."""
    endpoint = free_endpoint()
    source = "{kind: simulator, scenario: static, duration_s: 600.0, fps: 30.0, realtime: false}"
    config = configured(
        tmp_path, endpoint, source=source, state="{file: kept.json}", jaw="{source: zenoh}",
        daemon="{stop_within_s: 120.0}",
        monitor="{jaw_sigma_m: 0.0001, recalibration: {mode: confirm}}",
    )  # fmt: skip
    done: dict[str, list[bool]] = {}
    for name in ("first", "second"):
        with running(config, tmp_path / name) as process:
            wait_until(lambda: accepts(endpoint) or process.poll() is not None, "the monitor on the network")
            with plain_session(connect=endpoint) as session, jaw_on_network(session):
                told = Told(session)
                told.await_frames(40)
                revision = told.newest()["revision"]
                said = done.setdefault(name, [])
                said += [told.tell("accept"), told.tell("acknowledge"), told.tell("recalibrate")]
                said.append(told.await_done("accept"))
                told.await_revision(revision + 1)
                told.await_frames(10)
                said.append(told.tell("undo"))
                told.await_frames(10)
                said += [told.tell("reset"), told.tell("undo", "nothing-known"), told.tell("state")]
                told.await_frames(20)
                process.terminate()
                assert process.wait(WAIT_S) == 0
    assert {True, False} == set(done["first"]) and done["first"][-4], "some were done and some were refused"
    kept = unpack((tmp_path / "kept.json").read_bytes()).state
    assert len(kept.references) >= 5, "configured, and accepted and undone in both runs"
    for name in ("first", "second"):
        capsys.readouterr()
        again = replayed(tmp_path / name, tmp_path / f"{name}.jsonl")
        said_now = capsys.readouterr().err
        assert again == without_latency(tmp_path / name / "estimates.jsonl"), said_now
        assert "as they were recorded, every number the same" in said_now
    first_lines = [json.loads(line) for line in (tmp_path / "second" / "estimates.jsonl").read_bytes().splitlines()]
    assert first_lines[0]["revision"] >= 2, "the second run went on from the first"
    openings = {line["jaw_opening_m"] for line in first_lines} - {None}
    assert len(openings) > 30, "the network's openings differ from frame to frame"
