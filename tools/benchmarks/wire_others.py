"""Those at the other end of the wire, as processes: subscribers that stall, more subscribers, a router."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import zenoh

from benchmarks import kit
from benchmarks.harness import Subscriber, free_endpoint
from benchmarks.machine import ROOT
from gripmon.io.wire import DEFAULT_ENDPOINT

_SUBSCRIBER = Path(__file__).parent / "subscriber.py"
_MATCH_S = 0.3
_BALLAST_PUTS, _BALLAST_BYTES, _BALLAST_PAUSE_S = 400, 60_000, 0.002


class Staller:
    """A subscriber that takes nothing more, and a connection to it that is full to the brim.

    At a camera's rate that would take half a minute; ballast on a key of its own does it in a second.
    """

    def __init__(self, session: zenoh.Session, endpoint: str, key: str, *, stop: bool) -> None:
        ballast = f"{key}/ballast"
        command = [sys.executable, str(_SUBSCRIBER), endpoint, key, ballast, "free" if stop else "block"]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        if self._process.stdout.readline() != "ready\n":
            raise RuntimeError("the subscriber that is to stall did not start")
        time.sleep(_MATCH_S)
        if stop:
            self._process.send_signal(signal.SIGSTOP)
        weight = bytes(_BALLAST_BYTES)
        for _ in range(_BALLAST_PUTS):
            session.put(ballast, weight, priority=zenoh.Priority.DATA, congestion_control=zenoh.CongestionControl.DROP)
            time.sleep(_BALLAST_PAUSE_S)

    def close(self) -> None:
        self._process.kill()
        self._process.communicate()


class Crowd:
    """More subscribers."""

    def __init__(self, endpoint: str, key: str, count: int) -> None:
        self._subscribers = [Subscriber(endpoint, key) for _ in range(count)]

    def close(self) -> None:
        for subscriber in self._subscribers:
            subscriber.finish()


class RouterProcess:
    """``gripmon router``; ``up_ns`` is when it last reported that it listens, by the clock that all processes share."""

    def __init__(self, folder: Path) -> None:
        """The shipped configuration for one machine."""
        self.endpoint = free_endpoint()
        self.up_ns = 0
        self._file = folder / f"router-{self.endpoint.rpartition(':')[2]}.json5"
        text = (ROOT / "configs" / "zenoh" / "local.json5").read_text().replace(DEFAULT_ENDPOINT, self.endpoint)
        self._file.write_text(text)
        self._process: subprocess.Popen[str] | None = None
        self._reader: threading.Thread | None = None
        self.start()
        kit.until(lambda: self.up_ns, "the router did not start")

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def start(self) -> None:
        """Returns before it listens."""
        self._process = subprocess.Popen(
            [sys.executable, "-m", "gripmon", "router", str(self._file)], stderr=subprocess.PIPE, text=True
        )
        self._reader = threading.Thread(target=self._read, args=(self._process,), daemon=True)
        self._reader.start()

    def kill(self) -> None:
        assert self._process is not None and self._reader is not None
        self.up_ns = 0
        self._process.kill()
        self._process.wait()
        self._reader.join()

    def close(self) -> None:
        if self._process is not None and self._process.poll() is None:
            self.kill()

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stderr is not None
        for line in process.stderr:
            if "listening" in line:
                self.up_ns = time.monotonic_ns()
