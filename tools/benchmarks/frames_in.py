"""``tools/bench frames``: from an image in a driver's hands to the same image in the monitor's, in another process."""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from benchmarks import machine

if TYPE_CHECKING:
    from gripmon.io.sources import NetworkCamera

_SIZES = {"768 × 576, grey": (768, 576, 1), "1920 × 1080, colour": (1920, 1080, 3)}
_ENDPOINT = "tcp/127.0.0.1:17461"
_KEY = "bench/camera"
_LEFT_OUT = 20  # first frames, while connections warm up
_FPS = 25


class Row(NamedTuple):
    """Median and 99th percentile, ms."""

    median: float
    most: float
    frames: int
    payload_bytes: int


def add_parser(commands: Any) -> None:
    """Add the benchmark."""
    parser = commands.add_parser(
        "frames", help="frames over the network: time by format, with and without shared memory"
    )
    parser.add_argument("--frames", type=int, default=300, help="frames a row (default 300)")
    parser.set_defaults(handler=run)


def run(arguments: argparse.Namespace) -> int:
    """Print the table."""
    import cv2

    cv2.setNumThreads(1)
    print(f"{json.dumps(machine.description())}\n")
    print("| image | format | shared memory | payload, kB | median, ms | 99 %, ms | frames |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name, size in _SIZES.items():
        for frame_format in ("raw", "jpeg", "png"):
            for shared in (True, False):
                row = measure(size, frame_format, shared=shared, frames=arguments.frames + _LEFT_OUT)
                figures = f"{row.payload_bytes / 1e3:.0f} | {row.median:.2f} | {row.most:.2f}"
                print(
                    f"| {name} | {frame_format} | {'yes' if shared else 'no'} | {figures} | {row.frames} |", flush=True
                )
    return 0


def measure(size: tuple[int, int, int], frame_format: str, *, shared: bool, frames: int) -> Row:
    """One row: a driver in another process sends, the source here reads."""
    from gripmon.io.sources import NetworkCamera, NetworkSettings
    from gripmon.io.wire import Link, PublishSettings

    with tempfile.TemporaryDirectory() as folder:
        listens, connects = Path(folder) / "listens.json5", Path(folder) / "connects.json5"
        listens.write_text(_config("peer", shared, listen=_ENDPOINT))
        connects.write_text(_config("client", shared, connect=_ENDPOINT))
        link = Link(PublishSettings(zenoh_config=str(listens), listen=PublishSettings().listen))
        camera = NetworkCamera(NetworkSettings(key=_KEY), link, _KEY, size[:2])
        command = [sys.executable, "-m", "benchmarks.frame_driver", str(connects), _KEY, frame_format]
        command += [str(number) for number in (*size, frames, _FPS)]
        driver = subprocess.Popen(command)
        sizes: list[int] = []
        subscribers: list[Any] = []  # one that no one holds is undeclared
        link.attach(lambda session: subscribers.append(session.declare_subscriber(_KEY, _noting(sizes))))
        try:
            took_ms = _take(camera, driver)[_LEFT_OUT:]
        finally:
            camera.close()
            link.close()
            driver.wait()
    return Row(statistics.median(took_ms), statistics.quantiles(took_ms, n=100)[98], len(took_ms), sizes[0])


def _take(camera: NetworkCamera, driver: subprocess.Popen[bytes]) -> list[float]:
    """From stamp to decoded image, ms, until the driver ends."""
    from gripmon.model.records import Frame

    took_ms: list[float] = []
    while driver.poll() is None:
        item = camera.read()
        if isinstance(item, Frame) and item.image is not None:
            took_ms.append(1e-6 * (time.monotonic_ns() - item.stamp_ns))
    return took_ms


def _noting(sizes: list[int]) -> Any:
    """A handler that notes the size of the first payload, and costs next to nothing after it."""
    import zenoh

    return zenoh.handlers.Callback(lambda sample: sizes or sizes.append(len(sample.payload)), indirect=False)


def _config(mode: str, shared: bool, **endpoints: str) -> str:
    return json.dumps(
        {
            "mode": mode,
            "scouting": {"multicast": {"enabled": False}},
            "listen": {"endpoints": [endpoints["listen"]] if "listen" in endpoints else []},
            "connect": {"endpoints": [endpoints["connect"]] if "connect" in endpoints else []},
            "transport": {"shared_memory": {"enabled": shared}},
        }
    )
