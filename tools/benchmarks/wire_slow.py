"""A controller's client over links that can't carry the rate: true age of what it calls usable against claimed age."""

from __future__ import annotations

import os
import signal
import tempfile
import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from benchmarks import kit
from benchmarks.harness import free_endpoint
from benchmarks.parts import Measured, Row
from benchmarks.slow_link import SlowLink
from benchmarks.wire_others import RouterProcess
from gripmon.client import Policy, TransformClient
from gripmon.io.publish.publisher import ZenohPublisher
from gripmon.io.wire import Link, PublishSettings
from gripmon.model.records import CornerRecord, Drift, Frame, FrameRecord, Origin, Smoothed, State, Transform, Verdict

RATES_BYTES_PER_S = (100e3, 70e3, 30e3)
MAX_AGE_S = 0.2
AGE_BOUND_S = MAX_AGE_S + 0.05
"""Nothing older is usable, whatever the link does: what docs/howto/client.md promises with ``max_age_s`` 0.2."""
_FPS = 30.0
_POLL_S = 0.002
_CORNERS = 8
_POSE = Transform((0.0116, -0.0021, 0.1327), (0.5, -0.5, 0.5, 0.5))
_COVARIANCE = tuple(1.23456789e-9 * (i + 1) for i in range(36))
_RECORD = FrameRecord(
    0, 0, Verdict.VALID, State.TRACKING, Origin.UPDATE, _POSE, _COVARIANCE,
    Smoothed(_POSE.translation_m, _POSE.rotation_xyzw, _COVARIANCE), Drift(0.0015, 0.0026, (0.001, -0.002, 0.003)),
    "recalibration-3-1f0c9a2b", 3, 0.06, 0.034,
    tuple(CornerRecord(f"L_in_{i}", (412.3456789 + i, 310.987654), 0.0423456789, True) for i in range(_CORNERS)), (),
)  # fmt: skip
"""2.6 kB, as one of the demo's."""


@dataclass(frozen=True)
class Plan:
    """Seconds with a slow link, and after it; with a router that stands still."""

    slow_s: float = 20.0
    after_s: float = 4.0
    stopped_s: float = 5.0


class _Camera:
    """Transforms of about the size of real ones, 30 a second, stamped as they are sent; one thread."""

    def __init__(self, publisher: ZenohPublisher) -> None:
        self._publisher, self._done = publisher, threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._done.set()
        self._thread.join()

    def _run(self) -> None:
        seq, start_s = 0, time.monotonic()
        while not self._done.wait(max(0.0, start_s + seq / _FPS - time.monotonic())):
            record = msgspec.structs.replace(_RECORD, seq=seq, stamp_ns=time.time_ns())
            self._publisher.frame(Frame(seq, record.stamp_ns, None), record, lambda: None)
            seq += 1


class _Seen:
    """What a client says, polled for some time, beside the age that the frame had just before."""

    def __init__(self) -> None:
        self.true_s: list[float] = []
        self.claimed_s: list[float] = []
        self.newest_s: list[float] = []

    def poll(self, client: TransformClient, seconds_s: float) -> None:
        end_s = time.monotonic() + seconds_s
        while time.monotonic() < end_s:
            now_ns, reading = time.time_ns(), client.latest()
            if reading.seq >= 0:
                self.newest_s.append(1e-9 * (now_ns - reading.stamp_ns))
            if reading.usable:
                self.true_s.append(self.newest_s[-1])
                self.claimed_s.append(reading.age_s)
            time.sleep(_POLL_S)

    def summary(self) -> dict[str, Any]:
        true_s, claimed_s = np.array(self.true_s or [0.0]), np.array(self.claimed_s or [0.0])
        return {
            "polls": len(self.newest_s),
            "usable": len(self.true_s),
            "true_p999_s": float(np.quantile(true_s, 0.999)),
            "true_max_s": float(true_s.max()),
            "claimed_p999_s": float(np.quantile(claimed_s, 0.999)),
            "understated_max_s": float(max((true_s - claimed_s).max(), 0.0)),
            "newest_max_s": max(self.newest_s, default=0.0),
        }


def slow_links(_: tuple[Path, ...], plan: Plan) -> Measured:
    """By condition: the link's rate, a link that was slow from the start, a router that stands still."""
    results: dict[str, Any] = {}
    policy = Policy(max_age_s=MAX_AGE_S)
    with tempfile.TemporaryDirectory(prefix="gripmon-bench-") as scratch, ExitStack() as opened:
        endpoint, router = free_endpoint(), RouterProcess(Path(scratch))
        opened.callback(router.close)
        relay = SlowLink(endpoint)
        opened.callback(relay.close)
        for settings in (
            PublishSettings(listen=(endpoint,)),
            PublishSettings(mode="client", connect=(router.endpoint,)),
        ):
            publisher = ZenohPublisher(Link(settings), "bench", "wrist")
            opened.callback(publisher.close)
            opened.callback(_Camera(publisher).close)
        with _client(relay.endpoint, policy) as relayed:
            for rate in (None, *RATES_BYTES_PER_S):
                relay.bytes_per_s = rate
                seen = _Seen()
                seen.poll(relayed, plan.slow_s)
                relay.bytes_per_s = None
                seen.poll(relayed, plan.after_s)
                results["no limit" if rate is None else f"{1e-3 * rate:g} kB/s"] = seen.summary()
        relay.bytes_per_s = RATES_BYTES_PER_S[-1]
        with TransformClient("bench", connect=[relay.endpoint], policy=policy) as late:
            seen = _Seen()
            seen.poll(late, plan.slow_s)
        results[f"{1e-3 * RATES_BYTES_PER_S[-1]:g} kB/s from the start"] = seen.summary()
        with _client(router.endpoint, policy) as routed:
            results[f"router stopped for {plan.stopped_s:g} s"] = _stopped(routed, router, plan)
    return _said(results)


def _said(found: dict[str, Any]) -> Measured:
    worst_s = max(row["true_max_s"] for row in found.values())
    lines = []
    for title, row in found.items():
        usable = f"{100.0 * row['usable'] / max(1, row['polls']):.0f} %"
        ages = (f"{row[key]:.3f}" for key in ("true_p999_s", "claimed_p999_s", "true_max_s"))
        lines.append([title, usable, *ages, f"{row['understated_max_s']:.4f}", f"{row['newest_max_s']:.2f}"])
    head = ("", "usable", "true 99.9 %", "claimed 99.9 %", "true max", "claimed too young by", "oldest newest")
    said = f"a client's usable readings over slow links, max_age_s {MAX_AGE_S:g}, 30 transforms/s of 2.6 kB; s"
    row = Row("true age of whatever is usable over slow links", worst_s, "s", AGE_BOUND_S)
    return Measured((row,), (said, kit.table(head, lines)), found)


def _client(endpoint: str, policy: Policy) -> TransformClient:
    client = TransformClient("bench", connect=[endpoint], policy=policy)
    kit.until(lambda: client.latest().usable, "no transform came that is usable", 30.0)
    return client


def _stopped(client: TransformClient, router: RouterProcess, plan: Plan) -> dict[str, Any]:
    seen = _Seen()
    os.kill(router.pid, signal.SIGSTOP)
    try:
        seen.poll(client, plan.stopped_s)
    finally:
        os.kill(router.pid, signal.SIGCONT)
    seen.poll(client, plan.after_s)
    return seen.summary()
