"""Where the time of a frame goes: the product's functions, wrapped in stop watches for one run of its own.

A function's time counts without that of wrapped functions that it calls, so the stages add up to the whole.  Only the
thread that makes the watches is timed: what runs beside the frames belongs to no stage.
"""

from __future__ import annotations

import functools
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import gripmon.monitor.core
import gripmon.track.edges.settling
from gripmon.daemon.loop import Daemon
from gripmon.io.publish.publisher import ZenohPublisher
from gripmon.judge.drift import MotionWatch
from gripmon.judge.policy import Policy
from gripmon.judge.smoothing import PoseAverage
from gripmon.judge.stream import StreamWatch
from gripmon.monitor import Monitor, Tracker
from gripmon.monitor.analysis import CauseAnalysis, FrameAnalysis
from gripmon.monitor.trust import Integrity
from gripmon.monitor.weigher import Weigher
from gripmon.track.edges import FingertipMeter

STAGES: dict[str, tuple[tuple[Any, str], ...]] = {
    "inspect the image": ((gripmon.monitor.core, "inspect"),),
    "predict": ((FingertipMeter, "_predicted"), (FingertipMeter, "_predict"), (FingertipMeter, "_lay_out")),
    "sample profiles, find candidates": ((FingertipMeter, "_look"),),
    "joint fit": (
        (gripmon.track.edges.settling, "fit_irls"),
        (gripmon.track.edges.settling, "assess"),
        (FingertipMeter, "measure"),
    ),
    "corners": ((gripmon.track.edges.settling, "intersect_edges"),),
    "see the fingers' ends, one frame in four": ((FingertipMeter, "ends"),),
    "protection level": ((Weigher, "weigh"),),
    "look at the stream": ((StreamWatch, "add"),),
    "drift test": ((MotionWatch, "add"),),
    "causes": ((CauseAnalysis, "ask"),),
    "update and judge": (
        (Tracker, "update"),
        (Integrity, "judge"),
        (FrameAnalysis, "evidence"),
        (Monitor, "process"),
        (PoseAverage, "add"),
        (Policy, "measured"),
    ),
    "make the record": ((gripmon.monitor.core, "measured_record"),),
    "encode and publish": ((ZenohPublisher, "frame"),),
    "learn the gripper's look, after publishing": ((Integrity, "learn"),),
    "the rest of the loop": ((Daemon, "_handle"),),
}


class StopWatches:
    """Time of each stage, ns, summed over frames while ``counting``."""

    def __init__(self) -> None:
        self.counting = True
        self.total_ns = dict.fromkeys(STAGES, 0)
        self._inner_ns = [0]
        self._thread = threading.get_ident()

    def wrapped(self, function: Callable[..., Any], stage: str) -> Callable[..., Any]:
        clock, inner_ns, total_ns, thread = time.perf_counter_ns, self._inner_ns, self.total_ns, self._thread

        @functools.wraps(function)
        def timed(*args: Any, **kwargs: Any) -> Any:
            if threading.get_ident() != thread:
                return function(*args, **kwargs)
            inner_ns.append(0)
            start_ns = clock()
            try:
                return function(*args, **kwargs)
            finally:
                elapsed_ns = clock() - start_ns
                own_ns = elapsed_ns - inner_ns.pop()
                if self.counting:
                    total_ns[stage] += own_ns
                inner_ns[-1] += elapsed_ns

        return timed


@contextmanager
def stop_watches() -> Iterator[StopWatches]:
    """Every function of :data:`STAGES` timed, until the context ends.  AttributeError if one no longer exists."""
    watches = StopWatches()
    before = [(owner, name, getattr(owner, name)) for places in STAGES.values() for owner, name in places]
    try:
        for stage, places in STAGES.items():
            for owner, name in places:
                setattr(owner, name, watches.wrapped(getattr(owner, name), stage))
        yield watches
    finally:
        for owner, name, function in before:
            setattr(owner, name, function)
