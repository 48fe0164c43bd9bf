"""How large recordings get, by what is kept of the images: the daemon's loop for some seconds, extrapolated."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import harness, scene
from benchmarks.switched import SwitchedRecorder

POLICIES: dict[str, dict[str, Any]] = {
    "default: 10 images/s, JPEG 85": {},
    "every frame, JPEG 85": {"image_every": 1},
    "every frame, PNG": {"image_every": 1, "image_format": "png"},
    "every 10th frame, JPEG 85": {"image_every": 10, "image_rate_hz": 0.0},
    "1 image/s, JPEG 85": {"image_rate_hz": 1.0},
    "no images but at alerts": {"image_rate_hz": 0.0},
}
_WRITTEN_WITHIN_S = 60.0


@dataclass(frozen=True)
class Plan:
    """Seconds of each policy that count, after some to begin with; which policies."""

    sizes: tuple[scene.Size, ...] = ((768, 576), (1920, 1080))
    ring: int = 60
    begin_s: float = 6.0
    seconds: float = 30.0
    policies: tuple[str, ...] = tuple(POLICIES)


def measure(path: Path, size: scene.Size, plan: Plan) -> dict[str, Any]:
    """Bytes an hour of every policy.  ``path`` holds rendered frames in which nothing happens."""
    return {name: _one(path, size, plan, POLICIES[name]) for name in plan.policies}


def _one(path: Path, size: scene.Size, plan: Plan, changes: dict[str, Any]) -> dict[str, Any]:
    config, ring = scene.config_for(size), scene.Ring.load(path)
    begin = round(plan.begin_s * scene.FPS)
    count = begin + round(plan.seconds * scene.FPS)
    marks: list[tuple[int, int]] = []
    # Images around an alert are a matter of how many alerts there are.
    changes = {"around_alert_s": 0.0, **changes}
    with tempfile.TemporaryDirectory(prefix="gripmon-bench-") as directory:
        recorder = SwitchedRecorder(config, Path(directory), **changes)
        recorder.on = True

        def look(seq: int) -> None:
            if seq in (begin, count):
                _wait_until_written(recorder)
                marks.append((seq, sum(file.stat().st_size for file in Path(directory).glob("*.rrd"))))

        # One more frame: the look comes before a frame.
        source = harness.RingSource(ring, count + 1, paced=True, between=look)
        with harness.published(config) as (publisher, _):
            harness.run_loop(config, source, publisher, recorder)
    if len(marks) < 2:
        raise RuntimeError(f"the loop ended early: {recorder.failure or 'the recording did not get on'}")
    (first, bytes_then), (last, bytes_now) = marks
    a_frame = (bytes_now - bytes_then) / (last - first)
    return {
        "bytes_per_frame": a_frame,
        "bytes_per_hour": a_frame * scene.FPS * 3600.0,
        "at_the_start_bytes": bytes_then - first * a_frame,
        "frames": last - first,
        "images_dropped": recorder.images_dropped,
    }


def _wait_until_written(recorder: SwitchedRecorder) -> None:
    end_s = time.monotonic() + _WRITTEN_WITHIN_S
    while recorder.waiting > 0:
        if time.monotonic() > end_s:
            raise RuntimeError(f"the recording doesn't get on: {recorder.failure or 'no word why'}")
        time.sleep(0.02)
