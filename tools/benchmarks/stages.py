"""Where the time of a frame goes: the product's functions, wrapped in stop watches for one run of its own.

A function's time counts without that of wrapped functions that it calls, so the stages add up to the whole.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import gripmon.monitor.core
import gripmon.track.edges.settling
from gripmon.io.publish import ZenohPublisher
from gripmon.judge.drift import MotionWatch
from gripmon.judge.policy import Policy
from gripmon.judge.smoothing import PoseAverage
from gripmon.judge.stream import StreamWatch
from gripmon.monitor import Monitor, Tracker
from gripmon.monitor.analysis import CauseAnalysis
from gripmon.track.edges import FingertipMeter

STAGES: dict[str, tuple[tuple[Any, str], ...]] = {
    "inspect the image": ((gripmon.monitor.core, "inspect"),),
    "predict": ((FingertipMeter, "_predicted"),),
    "sample profiles, find candidates": ((FingertipMeter, "_look"),),
    "joint fit": (
        (gripmon.track.edges.settling, "agree"),
        (gripmon.track.edges.settling, "assess"),
        (FingertipMeter, "measure"),
    ),
    "corners": ((gripmon.track.edges.settling, "intersect_edges"),),
    "look at the stream": ((StreamWatch, "add"),),
    "drift test": ((MotionWatch, "add"),),
    "causes": ((CauseAnalysis, "ask"),),
    "update and judge": (
        (Tracker, "update"),
        (Monitor, "_evidence"),
        (Monitor, "process"),
        (PoseAverage, "add"),
        (Policy, "measured"),
    ),
    "make the record": ((Monitor, "_record"),),
    "encode and publish": ((ZenohPublisher, "transform"),),
}


class StopWatches:
    """Time of each stage, ns, summed over frames."""

    def __init__(self) -> None:
        self.total_ns = dict.fromkeys(STAGES, 0)
        self._inner_ns = [0]

    def wrapped(self, function: Callable[..., Any], stage: str) -> Callable[..., Any]:
        clock, inner_ns, total_ns = time.perf_counter_ns, self._inner_ns, self.total_ns

        @functools.wraps(function)
        def timed(*args: Any, **kwargs: Any) -> Any:
            inner_ns.append(0)
            start_ns = clock()
            try:
                return function(*args, **kwargs)
            finally:
                elapsed_ns = clock() - start_ns
                total_ns[stage] += elapsed_ns - inner_ns.pop()
                inner_ns[-1] += elapsed_ns

        return timed

    def reset(self) -> None:
        for stage in self.total_ns:
            self.total_ns[stage] = 0


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
