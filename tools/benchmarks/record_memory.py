"""A day's frames through the recorder, as fast as it takes them: memory of the daemon's side and of its process."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from benchmarks import kit, machine, scene
from benchmarks.parts import Measured, Row
from benchmarks.switched import described
from gripmon.model.records import Frame, FrameRecord, MeasurementTrace
from gripmon.monitor import Monitor
from gripmon.record.write import ProcessRecorder

SIZE = (384, 288)
FLAT_MIB = 1.0
"""To reach: MiB that an hour adds at most."""
_WHO = {"daemon_mib": "daemon's side", "process_mib": "recording process"}
FRAMES_PER_HOUR = round(3600 * scene.FPS)
_LIGHT = {
    # Files as many as in a day, and most of them deleted again; images as seldom as makes frames light.
    "image_rate_hz": 1.0,
    "around_alert_s": 0.0,
    "max_file_bytes": 20_000_000,
    "budget_bytes": 80_000_000,
}


@dataclass(frozen=True)
class Plan:
    """Frames, in hours at 60 a second; ``look_every``: frames between two samples; ``judged`` are made by a monitor and
    repeated.
    """

    hours: float = 24.0
    look_every: int = 20_000
    judged: int = 240
    warm_up: float = 0.15


def measure(paths: tuple[Path, ...], plan: Plan) -> Measured:
    """Memory over the hours, and its slope once it has settled (after the plan's share ``warm_up``)."""
    ring = scene.Ring.load(paths[0])
    config = scene.config_for(ring.size)
    monitor = Monitor(config.camera, config.gripper, config.settings.monitor, config.reference)
    judged = [_judge(monitor, ring.frame(seq)) for seq in range(plan.judged)]
    count = round(plan.hours * FRAMES_PER_HOUR)
    with tempfile.TemporaryDirectory(prefix="gripmon-bench-") as directory:
        recorder = ProcessRecorder(described(config, Path(directory), **_LIGHT), patience_s=30.0)
        start_s = time.monotonic()
        looks = _push(recorder, judged, count, plan.look_every)
        took_s = time.monotonic() - start_s
        recorder.close(timeout_s=60.0)
        numbers = [int(file.stem.rpartition("-")[2]) for file in Path(directory).glob("*.rrd")]
    slopes = {who: slope(looks, who, plan.warm_up) for who in _WHO}
    rows = (
        Row(f"memory of the {title}", slopes[who]["mib_per_hour"], "MiB an hour", FLAT_MIB,
            note=f"± {slopes[who]['sigma_mib_per_hour']:.3f}")
        for who, title in _WHO.items()
    )  # fmt: skip
    said = (
        f"{count:,} frames, {plan.hours:g} h at 60/s, in {took_s:.0f} s; {recorder.frames_written:,} written, "
        f"{recorder.dropped} dropped; files: {max(numbers)}"
    )
    shown = looks[:: max(len(looks) // 12, 1)]
    cells = [[f"{look['hours']:.2f}", *(f"{look[who]:.1f}" for who in _WHO)] for look in shown]
    return Measured(tuple(rows), (said, kit.table(("hours", *_WHO.values()), cells)), {"looks": looks})


def _judge(monitor: Monitor, frame: Frame) -> tuple[Frame, FrameRecord, MeasurementTrace | None]:
    record = monitor.process(frame)
    trace = monitor.trace()
    monitor.learn()
    # An alert pins its file, which then stays.
    return frame, msgspec.structs.replace(record, alerts=()), trace


def _push(
    recorder: ProcessRecorder,
    judged: list[tuple[Frame, FrameRecord, MeasurementTrace | None]],
    count: int,
    look_every: int,
) -> list[dict[str, float]]:
    looks: list[dict[str, float]] = []
    # The end of the ring meets its beginning as it was once everything had settled.
    settled = judged[len(judged) // 2 :]
    for seq in range(count):
        frame, record, trace = settled[seq % len(settled)]
        stamp_ns = judged[0][0].stamp_ns + round(seq * 1e9 / scene.FPS)
        frame = Frame(seq, stamp_ns, frame.image, frame.jaw_opening_m)
        record = msgspec.structs.replace(record, seq=seq, stamp_ns=stamp_ns)
        recorder.frame(frame, record, lambda trace=trace: trace)  # type: ignore[misc]
        if (seq + 1) % look_every == 0:
            pid = recorder.process_id
            looks.append(
                {
                    "hours": (seq + 1) / FRAMES_PER_HOUR,
                    "daemon_mib": machine.rss_bytes() / 2**20,
                    "process_mib": np.nan if pid is None else machine.rss_bytes(pid) / 2**20,
                }
            )
    return looks


def slope(looks: list[dict[str, float]], who: str, warm_up: float = 0.0) -> dict[str, float]:
    """MiB an hour by least squares, with its standard error; looks next to one another are not independent, so the
    error comes from the means of ten stretches.
    """
    hours = np.array([look["hours"] for look in looks])
    mib = np.array([look[who] for look in looks])
    there = (hours >= warm_up * hours[-1]) & np.isfinite(mib)
    x, y = _stretches(hours[there]), _stretches(mib[there])
    if len(x) < 3:
        return {"mib_per_hour": float("nan"), "sigma_mib_per_hour": float("nan")}
    x0 = x - x.mean()
    rate = float(x0 @ y / (x0 @ x0))
    rest = y - y.mean() - rate * x0
    sigma = float(np.sqrt(rest @ rest / (len(x) - 2) / (x0 @ x0)))
    return {"mib_per_hour": rate, "sigma_mib_per_hour": sigma}


def _stretches(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.array([part.mean() for part in np.array_split(values, min(10, len(values)))])
