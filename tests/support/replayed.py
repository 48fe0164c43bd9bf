"""``gripmon replay`` of recordings with every frame in them, and what of its lines is the same in every run."""

from __future__ import annotations

import re
from pathlib import Path

from gripmon.cli import main

EVERY_FRAME = "{image_format: png, image_rate_hz: 1000, queue_images: 256, queue_frames: 10000, min_free_bytes: 0}"


def without_latency(path: Path) -> list[bytes]:
    return re.sub(rb'"latency_ns":\d+', b'"latency_ns":0', path.read_bytes()).splitlines()


def replayed(inputs: Path | list[Path], out: Path, *options: str, code: int = 0) -> list[bytes]:
    """The lines of a replay, without latencies."""
    names = [str(path) for path in (inputs if isinstance(inputs, list) else [inputs])]
    assert main(["replay", *names, "--out", str(out), *options]) == code
    return without_latency(out)
