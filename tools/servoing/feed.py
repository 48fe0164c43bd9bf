"""The monitor in a process of its own, on the scenario's camera, and what its client reads over Zenoh."""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import yaml

from gripmon.client import Policy, Reading, TransformClient
from gripmon.daemon.config import Config, load_config
from gripmon.model.geometry import from_record
from gripmon.model.records import Array
from gripmon.simulate import Scenario

ROOT = Path(__file__).resolve().parents[2]
_DEMO = ROOT / "configs" / "demo.yaml"
_SILENCE_S = 90.0  # a monitor that says nothing for so long won't any more, on however slow a machine
_UNDER_WAY_S = 3.0  # what a monitor sent before it ended is here by then
_LOOK_S = 0.2
_DEPTH = 4096


class FeedError(RuntimeError):
    """The monitor did not do its part; one line says what."""


def reference_cam_T_grip() -> Array:
    """(4, 4): the demo's calibration, which is exact until the mount is knocked."""
    return from_record(load_config(_DEMO, check_source=False).reference.cam_T_grip)


def write_config(folder: Path, scenario: Scenario, seed: int, endpoint: str, *, realtime: bool) -> Config:
    """The demo's camera, gripper and reference with this scenario; the monitor joins the network at ``endpoint``.

    Without ``realtime`` it takes every frame in order, as fast as it can: the same on every machine.
    """
    (folder / "scenario.yaml").write_bytes(msgspec.yaml.encode(scenario))
    settings: dict[str, Any] = yaml.safe_load(_DEMO.read_text(encoding="utf-8"))
    settings["robot"] = "servo"
    settings["gripper"] = str(ROOT / "configs" / settings["gripper"])
    settings["source"] = {
        "kind": "simulator", "scenario": "scenario.yaml", "seed": seed, "realtime": realtime, "ends": True
    }  # fmt: skip
    settings["publish"] |= {"mode": "peer", "listen": [], "connect": [endpoint]}
    settings["recording"]["enabled"] = False
    path = folder / "monitor.yaml"
    path.write_text(yaml.safe_dump(settings), encoding="utf-8")
    return load_config(path)


class Feed:
    """Readings of one run, in order.  ``seq`` counts frames; numbers that are missing were dropped or lost."""

    def __init__(self, process: subprocess.Popen[bytes], arrived: queue.SimpleQueue[Reading], log: Path) -> None:
        self._process, self._arrived, self._log = process, arrived, log

    def readings(self, last_seq: int) -> Iterator[Reading]:
        """Up to that of frame ``last_seq``, or until the monitor's camera ends (a live one may drop the last frame).

        Raises :class:`FeedError` if the monitor fails or falls silent.
        """
        heard_s, newest = time.monotonic(), -1
        while True:
            ended = self._process.poll() is not None
            try:
                reading = self._arrived.get(timeout=_LOOK_S)
            except queue.Empty:
                silent_s = time.monotonic() - heard_s
                if ended and silent_s > _UNDER_WAY_S:
                    break
                if silent_s > _SILENCE_S:
                    raise FeedError(f"the monitor has sent nothing for {_SILENCE_S:g} s") from None
                continue
            heard_s = time.monotonic()
            if reading.seq <= newest:
                continue  # says only that the last one holds no longer; the next frame, if there is one, says more
            newest = reading.seq
            yield reading
            if newest >= last_seq:
                return
        if (code := self._process.returncode) != 0:
            last = self._log.read_text(encoding="utf-8", errors="replace").splitlines()[-1:]
            raise FeedError(f"gripmon run ended with exit code {code}: {''.join(last)}")


@contextmanager
def feed(folder: Path, config: Config, policy: Policy) -> Iterator[Feed]:
    """``gripmon run`` on a configuration of :func:`write_config`, its transforms received over Zenoh in this process.

    This process listens and the monitor connects, so that no frame is lost however soon the first one comes.
    """
    zenoh_file = folder / "client.json5"
    endpoints = {"listen": {"endpoints": list(config.settings.publish.connect)}}
    quiet = {"scouting": {"multicast": {"enabled": False}}}
    zenoh_file.write_text(json.dumps({"mode": "peer", **endpoints, **quiet}), encoding="utf-8")
    arrived: queue.SimpleQueue[Reading] = queue.SimpleQueue()
    settings, log = config.settings, folder / "monitor.log"
    environment = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}
    command = [sys.executable, "-m", "gripmon", "run", str(config.path)]
    client = TransformClient(
        settings.robot, settings.camera_name, zenoh_config_file=str(zenoh_file), policy=policy, depth=_DEPTH
    )
    with client, log.open("wb") as messages:
        client.on_transform(arrived.put)
        process = subprocess.Popen(command, stderr=messages, env=environment, cwd=folder)
        try:
            yield Feed(process, arrived, log)
        finally:
            process.terminate()
            process.wait()
