"""How large recordings get, by what is kept of the images: the daemon's loop for some seconds, extrapolated."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import harness, kit, scene
from benchmarks.parts import Measured, Row
from benchmarks.switched import SwitchedRecorder

POLICIES: dict[str, dict[str, Any]] = {
    "default: 10 images/s, JPEG 85": {},
    "every frame, JPEG 85": {"image_every": 1},
    "every frame, PNG": {"image_every": 1, "image_format": "png"},
    "every 10th frame, JPEG 85": {"image_every": 10, "image_rate_hz": 0.0},
    "1 image/s, JPEG 85": {"image_rate_hz": 1.0},
    "no images but at alerts": {"image_rate_hz": 0.0},
}


@dataclass(frozen=True)
class Plan:
    """Seconds of each policy that count, after some to begin with; which policies."""

    begin_s: float = 6.0
    seconds: float = 30.0
    policies: tuple[str, ...] = tuple(POLICIES)


def measure(paths: tuple[Path, ...], plan: Plan) -> Measured:
    """Bytes an hour of every policy, of frames in which nothing happens."""
    rows, notes, values = [], [], {}
    for path in paths:
        ring = scene.Ring.load(path)
        size = f"{ring.size[0]}x{ring.size[1]}"
        found = values[size] = {name: _one(ring, plan, POLICIES[name]) for name in plan.policies}
        default = found[plan.policies[0]]["bytes_per_hour"]
        rows.append(Row(f"{size}: on the disk, {plan.policies[0]}", 1e-9 * default, "GB an hour"))
        notes += [f"{size}, extrapolated to an hour at 60 frames/s from {plan.seconds:.0f} s each", _table(found)]
    return Measured(tuple(rows), tuple(notes), values)


def _table(found: dict[str, dict[str, Any]]) -> str:
    lines = []
    for name, row in found.items():
        gigabytes, hours = 1e-9 * row["bytes_per_hour"], 50e9 / row["bytes_per_hour"]
        lasts = f"{hours:.0f} h" if hours < 72.0 else f"{hours / 24.0:.0f} days"
        lines.append([name, f"{gigabytes:.2f}", f"{1e-3 * row['bytes_per_frame']:.2f}", lasts, row["images_dropped"]])
    return kit.table(("", "GB an hour", "kB a frame", "50 GB last", "images dropped"), lines)


def _one(ring: scene.Ring, plan: Plan, changes: dict[str, Any]) -> dict[str, Any]:
    config = scene.config_for(ring.size)
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
                kit.until(lambda: recorder.waiting <= 0, "the recording doesn't get on")
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
