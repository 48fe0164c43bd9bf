"""A daemon of any name in a process of its own, its camera and monitor stood in for: one argument, JSON.

``settings`` of the network, ``robot``, ``camera``; ``answer``: fields of every frame's record that are not as usual;
``fps``.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from gripmon.daemon.running import run
from gripmon.daemon.service import log_to_stderr
from gripmon.daemon.watch import DaemonSettings
from gripmon.io.wire import PublishSettings
from gripmon.model.records import FrameRecord
from gripmon.model.stopping import signals_exit
from support.published import Published
from support.stand_ins import Listener, ScriptedMonitor, TickingSource

_TESTS = Path(__file__).resolve().parents[1]
_ROUTER = """
import json, sys, threading, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"router"')
config.insert_json5("scouting/multicast/enabled", "false")
config.insert_json5("listen/endpoints", json.dumps([sys.argv[1]]))
with zenoh.open(config):
    print("open", flush=True)
    threading.Event().wait()
"""


@contextmanager
def _process(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Killed at the end if it still runs."""
    environment = os.environ | {"PYTHONPATH": f"{_TESTS}:{_TESTS.parent}"}
    with tempfile.TemporaryFile("w+") as errors:
        command = [sys.executable, *arguments]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True, env=environment)
        try:
            assert process.stdout is not None
            if process.stdout.readline() != "open\n":
                errors.seek(0)
                raise AssertionError(errors.read())
            yield process
        finally:
            process.kill()
            process.communicate()


@contextmanager
def router(endpoint: str) -> Iterator[subprocess.Popen[str]]:
    """A router in a process of its own, ready."""
    with _process("-c", _ROUTER, endpoint) as process:
        yield process


@contextmanager
def remote_monitor(
    *, robot: str = "arm", camera: str = "wrist", fps: float = 50.0, answer: object = None, **settings: object
) -> Iterator[subprocess.Popen[str]]:
    """A monitor in a process of its own, whose session is open unless it waits for a router."""
    told = {"robot": robot, "camera": camera, "fps": fps, "answer": answer or {}, "settings": settings}
    with _process(str(Path(__file__)), json.dumps(told)) as process:
        yield process


def _main() -> int:
    told = json.loads(sys.argv[1])
    kinds = {field.name: field.type for field in msgspec.structs.fields(FrameRecord)}
    answer = {name: msgspec.convert(value, kinds[name]) for name, value in told["answer"].items()}
    log_to_stderr()
    with signals_exit():
        publisher = Published(msgspec.convert(told["settings"], PublishSettings), told["robot"], told["camera"])
        print("open", flush=True)
        return run(
            ScriptedMonitor(lambda _: answer),
            source=TickingSource(told["fps"]),
            outputs=(publisher,),
            recorder=Listener(),
            settings=DaemonSettings(),
            robot=told["robot"],
            camera=told["camera"],
        )


if __name__ == "__main__":
    sys.exit(_main())
