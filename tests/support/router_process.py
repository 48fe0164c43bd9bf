"""A router in a process of its own, as users run it: ``gripmon router FILE``; it can be stopped and started again."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from support.loopback import accepts, wait_until

ROOT = Path(__file__).resolve().parents[2]


class RouterProcess:
    """``start`` returns when it listens; ``kill`` gives it no time to say good-bye, ``stop`` does."""

    def __init__(self, config: Path, endpoint: str, cwd: Path = ROOT) -> None:
        self.endpoint = endpoint
        self._config, self._cwd = config, cwd
        self.process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        command = [sys.executable, "-m", "gripmon", "router", str(self._config)]
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment, cwd=self._cwd)
        wait_until(lambda: self.process.poll() is not None or accepts(self.endpoint), "the router to listen")
        assert self.process.poll() is None, self.process.stderr and self.process.stderr.read()

    def kill(self) -> None:
        assert self.process is not None
        self.process.kill()
        self.process.communicate()

    def stop(self) -> tuple[int, str]:
        """Exit code, and what it said."""
        assert self.process is not None
        self.process.terminate()
        _, said = self.process.communicate(timeout=120.0)
        return self.process.returncode, said


def plain_config(folder: Path, endpoint: str) -> Path:
    """A configuration without any security."""
    path = folder / "router.json5"
    path.write_text(
        json.dumps(
            {
                "mode": "router",
                "listen": {"endpoints": [endpoint]},
                "scouting": {"multicast": {"enabled": False}},
            }
        )
    )
    return path


@contextmanager
def running(config: Path, endpoint: str) -> Iterator[RouterProcess]:
    router = RouterProcess(config, endpoint, ROOT)
    router.start()
    try:
        yield router
    finally:
        if router.process is not None and router.process.poll() is None:
            router.kill()
