"""``gripmon run`` in a process of its own, with a simulated sequence's camera whose frames come over the network."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from support.configurations import with_sections
from support.loopback import WAIT_S, wait_until

ROOT = Path(__file__).resolve().parents[2]
PREFIX = "gripmon/simulated/wrist"
ENVIRONMENT = os.environ | {"PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}"}


def network_config(
    folder: Path, publish: str, *, source: str = "{kind: zenoh}", jaw: str = "{source: frames}", name: str = "network"
) -> Path:
    """A sequence's configuration with other sections; ``publish`` is that section in braces."""
    own = {"recording": "{enabled: false}", "state": "{file: null}"}
    path = folder / f"{name}.yaml"
    text = (folder / "config.yaml").read_text()
    path.write_text(with_sections(text, source=source, jaw=jaw, publish=publish, **own))
    return path


class NetworkDaemon:
    """What it says on stderr, and how it ends."""

    def __init__(self, process: subprocess.Popen[bytes], log: Path, out: Path) -> None:
        self.process, self.out = process, out
        self._log = log

    def said(self) -> str:
        return self._log.read_text()

    def await_saying(self, text: str, count: int = 1) -> None:
        wait_until(
            lambda: self.said().count(text) >= count or self.process.poll() is not None, f"'{text}' in the log", 60.0
        )
        assert self.said().count(text) >= count, self.said()

    def stop(self) -> int:
        """Its exit code after SIGTERM."""
        self.process.terminate()
        return self.process.wait(WAIT_S)


@contextmanager
def network_daemon(config: Path, out: Path) -> Iterator[NetworkDaemon]:
    """It watches when the context begins, and is killed at its end if it still runs."""
    out.mkdir(parents=True, exist_ok=True)
    log = out / "stderr.txt"
    command = [sys.executable, "-m", "gripmon", "run", str(config), "--out", str(out)]
    with log.open("wb") as stderr:
        process = subprocess.Popen(command, stderr=stderr, env=ENVIRONMENT)
        daemon = NetworkDaemon(process, log, out)
        try:
            daemon.await_saying("watching simulated/wrist")
            yield daemon
        finally:
            process.kill()
            process.wait()
