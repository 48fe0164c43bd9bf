"""The product's own loop with a stop watch at both ends: where frames are handed over, and where transforms leave."""

from __future__ import annotations

import json
import math
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.scene import FPS, Ring
from gripmon.daemon.config import Config
from gripmon.daemon.running import run
from gripmon.io.publish.publisher import ZenohPublisher
from gripmon.io.wire import Link, PublishSettings
from gripmon.model.outputs import Event, Notes, Output, Trace
from gripmon.model.records import Frame, FrameRecord, State, Verdict
from gripmon.monitor import Monitor, warm_up
from gripmon.record.recorder import Recorder

_SUBSCRIBER = Path(__file__).parent / "subscriber.py"
_CORES = os.sched_getaffinity(0)
_TRACKING = (State.TRACKING, State.DRIFTING)
_MATCH_S = 0.5  # until the publisher knows of its subscriber


class RingSource:
    """Hands frames over and notes when, and when the loop came back; ``paced``: at the camera's rate, else at once;
    ``opening``: with the jaw's.  Of what was published it notes when, and whether it was ``measured``, ``valid``, and
    ``tracking``, or drifting.

    ``between`` is called before each frame, outside of what is timed.
    """

    connected = True
    dropped = 0

    def __init__(
        self,
        ring: Ring,
        count: int,
        *,
        paced: bool = False,
        opening: bool = True,
        between: Callable[[int], None] = lambda seq: None,
    ) -> None:
        # Filled, not just reserved: memory that is first touched later would look like a leak of the product's.
        self.handed_ns, self.published_ns, self.back_ns = (np.full(count, -1, np.int64) for _ in range(3))
        self.measured, self.tracking, self.valid = (np.full(count, False) for _ in range(3))
        self._ring, self._count, self._paced, self._between = ring, count, paced, between
        self.live = paced  # of a camera, no frame of which waits for a search
        self._opening = opening
        self._seq = 0
        self._due_s = time.monotonic()

    def read(self) -> Frame | None:
        seq = self._seq
        if seq > 0:
            self.back_ns[seq - 1] = time.monotonic_ns()
        if seq >= self._count:
            return None
        self._between(seq)
        frame = self._ring.frame(seq)
        if not self._opening:
            frame = replace(frame, jaw_opening_m=None)
        self._seq = seq + 1
        if self._paced:
            self._due_s = max(self._due_s + 1.0 / FPS, time.monotonic())
            time.sleep(max(self._due_s - time.monotonic(), 0.0))
        self.handed_ns[seq] = time.monotonic_ns()
        return frame

    def close(self) -> None:
        self._count = self._seq

    def latency_us(self) -> NDArray[np.float64]:
        """From handed over to published, per frame."""
        return 1e-3 * (self.published_ns - self.handed_ns)

    def loop_us(self) -> NDArray[np.float64]:
        """From handed over until the loop wants the next frame."""
        return 1e-3 * (self.back_ns - self.handed_ns)


class _TimedPublisher(Output):
    """Notes when a transform has left.  Its session outlives the loop, until the subscriber has been asked."""

    def __init__(self, inner: Output, source: RingSource) -> None:
        self._inner, self._source = inner, source

    def frame(self, frame: Frame, record: FrameRecord, trace: Trace, notes: Notes | None = None) -> None:
        self._inner.frame(frame, record, trace, notes)
        self._source.published_ns[record.seq] = time.monotonic_ns()
        self._source.measured[record.seq] = record.measured
        self._source.tracking[record.seq] = record.measured and record.state in _TRACKING
        self._source.valid[record.seq] = record.verdict is Verdict.VALID

    def event(self, event: Event) -> None:
        self._inner.event(event)

    def close(self) -> None: ...


class Subscriber:
    """The process that receives; ``received`` after the context: frame numbers and arrival times, ns."""

    def __init__(self, endpoint: str, key: str) -> None:
        self.seqs = np.zeros(0, np.int64)
        self.arrivals_ns = np.zeros(0, np.int64)
        pinned_to = os.sched_getaffinity(0)
        os.sched_setaffinity(0, (_CORES - pinned_to) or _CORES)  # for the new process, which takes it over
        command = [sys.executable, str(_SUBSCRIBER), endpoint, key, "note"]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        os.sched_setaffinity(0, pinned_to)
        assert self._process.stdout is not None
        if self._process.stdout.readline() != "ready\n":
            raise RuntimeError("the subscriber did not start")
        time.sleep(_MATCH_S)

    def finish(self) -> None:
        answer, _ = self._process.communicate(timeout=60)
        received: dict[str, Any] = json.loads(answer)
        self.seqs, self.arrivals_ns = (np.array(received[k], np.int64) for k in ("seqs", "arrivals_ns"))


def free_endpoint() -> str:
    """A Zenoh endpoint on a loopback port that is free now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@contextmanager
def published(config: Config) -> Iterator[tuple[ZenohPublisher, Subscriber]]:
    """A publisher on a free loopback port with a subscriber in another process."""
    endpoint = free_endpoint()
    link = Link(PublishSettings(listen=(endpoint,)))
    publisher = ZenohPublisher(link, config.settings.robot, config.settings.camera_name)
    try:
        subscriber = Subscriber(endpoint, publisher.keys["transform"])
        try:
            yield publisher, subscriber
        finally:
            subscriber.finish()
    finally:
        publisher.close()


def run_loop(config: Config, source: RingSource, publisher: Output, recorder: Recorder | None = None) -> None:
    """The daemon's loop, as ``gripmon run`` runs it, until the source ends.  Closes the recorder, not the publisher."""
    settings = config.settings
    warm_up()
    run(
        Monitor(config.camera, config.gripper, settings.monitor, config.reference),
        source=source,
        outputs=(_TimedPublisher(publisher, source),),
        recorder=Recorder() if recorder is None else recorder,
        settings=settings.daemon,
        robot=settings.robot,
        camera=settings.camera_name,
    )


@contextmanager
def on_one_core() -> Iterator[None]:
    """This thread, and all threads that it starts meanwhile (Zenoh's), on one core; the subscriber goes elsewhere."""
    os.sched_setaffinity(0, {max(_CORES)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, _CORES)


def summary(values_us: NDArray[np.float64]) -> dict[str, float]:
    """Median, 99th percentile, maximum and number of those that are there; NaN where none is."""
    there = values_us[np.isfinite(values_us)]
    if not len(there):
        return {"median": math.nan, "p99": math.nan, "max": math.nan, "count": 0}
    median, high = np.percentile(there, [50.0, 99.0])
    return {"median": float(median), "p99": float(high), "max": float(there.max()), "count": len(there)}
