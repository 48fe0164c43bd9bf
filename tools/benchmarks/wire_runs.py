"""The daemon's loop with its subscribers elsewhere: each condition for some seconds at a time, in turns."""

from __future__ import annotations

import contextlib
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks import harness, kit, scene
from benchmarks.harness import free_endpoint
from benchmarks.parts import Measured, Row
from benchmarks.wire_others import Crowd, RouterProcess, Staller
from gripmon.io.publish.publisher import ZenohPublisher
from gripmon.io.wire import Link, PublishSettings
from gripmon.model.outputs import Event, Notes, Output, Trace
from gripmon.model.records import Frame, FrameRecord

_TITLES = {
    "alone": "one subscriber",
    "stopped": "and one that is stopped (SIGSTOP)",
    "blocked": "and one whose callback blocks",
    "ten": "ten subscribers",
    "router": "through a router",
}
CONDITIONS = tuple(_TITLES)
RATIO, TAIL, RECOVERY_S = 1.5, 1.10, 2.0
"""To reach: the way to a callback over the monitor's own time, tails with stalled subscribers over those alone, and the
first transform after a router's return.
"""
_SPANS = {"published": "until it has left", "loop": "whole loop"}
"""The loop tidies up once a second, which would hide a shorter stall: so also until the transform has left."""


@dataclass(frozen=True)
class Plan:
    """How much is measured: frames of each condition at a time, how often, and restarts of the router."""

    block: int = 270
    settle: int = 30
    rounds: int = 12
    more_subscribers: int = 9
    restarts: int = 6
    before_s: float = 2.0
    down_s: float = 1.0
    after_s: float = 5.0


class _Switched(Output):
    """The publisher of the moment; notes what the monitor needed for each frame, and counts exceptions."""

    def __init__(self, publishers: list[ZenohPublisher], count: int) -> None:
        self.publishers, self.current = publishers, 0
        self.judged_us = np.full(count, np.nan)
        self.exceptions = 0

    def frame(self, frame: Frame, record: FrameRecord, trace: Trace, notes: Notes | None = None) -> None:
        self.judged_us[record.seq] = 1e-3 * record.latency_ns
        self._say(lambda to: to.frame(frame, record, trace, notes))

    def event(self, event: Event) -> None:
        self._say(lambda to: to.event(event))

    def close(self) -> None: ...

    def _say(self, what: Callable[[Output], None]) -> None:
        try:
            what(self.publishers[self.current])
        except Exception:
            self.exceptions += 1
            raise


def conditions(paths: tuple[Path, ...], plan: Plan) -> Measured:
    """Every condition in turns."""
    ring = scene.Ring.load(paths[0])
    config = scene.config_for(ring.size)
    order = [CONDITIONS[(i + shift) % len(CONDITIONS)] for shift in range(plan.rounds) for i in range(len(CONDITIONS))]
    count = plan.block * len(order)
    with tempfile.TemporaryDirectory(prefix="gripmon-bench-") as scratch, _wires(config, Path(scratch)) as wires:
        direct, routed = wires.subscribers
        switched = _Switched(wires.publishers, count)
        guest = contextlib.ExitStack()

        def change(seq: int) -> None:
            if seq % plan.block == 0:
                guest.close()
                condition = order[seq // plan.block]
                switched.current = int(condition == "router")
                if (somebody := wires.guest(condition, plan)) is not None:
                    guest.callback(somebody.close)

        source = harness.RingSource(ring, count, paced=True, between=change)
        with guest:
            harness.run_loop(config, source, switched)
        for subscriber in wires.subscribers:
            subscriber.finish()
    seqs = np.arange(count)
    settled = seqs % plan.block >= plan.settle
    which = np.array([CONDITIONS.index(order[seq // plan.block]) for seq in seqs])
    results: dict[str, Any] = {"exceptions": switched.exceptions}
    for i, condition in enumerate(CONDITIONS):
        mine = settled & (which == i)
        receiver = routed if condition == "router" else direct
        arrived_us = _arrived_us(receiver, source, count)[mine]
        results[condition] = {
            "frames": int(mine.sum()),
            "lost": int(np.isnan(arrived_us).sum()),
            "judged_us": harness.summary(switched.judged_us[mine]),
            "received_us": harness.summary(arrived_us),
            "published_us": harness.summary(source.latency_us()[mine]),
            "loop_us": harness.summary(source.loop_us()[mine]),
        }
        in_round = [mine & (seqs // (plan.block * len(CONDITIONS)) == i) for i in range(plan.rounds)]
        for what, values_us in (("published", source.latency_us()), ("loop", source.loop_us())):
            results[condition][f"{what}_p99_by_round_us"] = [
                harness.summary(values_us[frames])["p99"] for frames in in_round
            ]
    return _conditions(results)


def _conditions(found: dict[str, Any]) -> Measured:
    alone = found["alone"]
    ratio = alone["received_us"]["median"] / alone["judged_us"]["median"]
    rows = [Row("handed over -> in a callback, median over the monitor's own", ratio, "times", RATIO)]
    for condition in ("stopped", "blocked"):
        for span, title in _SPANS.items():
            # The middle one of the rounds: whatever else the machine does comes in bursts.
            tails = [median(found[who][f"{span}_p99_by_round_us"]) for who in (condition, "alone")]
            what = f"{condition} subscriber: 99 % {title}, over that alone"
            rows.append(Row(what, tails[0] / tails[1], "times", TAIL))
    rows.append(Row("exceptions", found["exceptions"], "", 0.0))
    lines, rounds = [], []
    for condition, title in _TITLES.items():
        row = found[condition]
        spans = (row[f"{key}_us"] for key in ("judged", "published", "received", "loop"))
        times = (f"{1e-3 * span['median']:.3f} / {1e-3 * span['p99']:.3f}" for span in spans)
        lines.append([title, *times, f"{row['lost']} of {row['frames']}"])
    for what, title in _SPANS.items():
        for condition in ("alone", "stopped", "blocked"):
            by_round = found[condition][f"{what}_p99_by_round_us"]
            rounds.append([f"{title}, {condition}", " ".join(f"{1e-3 * p99:.2f}" for p99 in by_round)])
    head = ("ms, median / 99 %", "monitor alone", "it has left", "in a callback", "whole loop", "lost")
    return Measured(tuple(rows), (kit.table(head, lines), kit.table(("", "99 % of each round, ms"), rounds)), found)


def restarts(paths: tuple[Path, ...], plan: Plan) -> Measured:
    """The router killed and started again under the running loop, some times; loss and recovery of each."""
    ring = scene.Ring.load(paths[0])
    config = scene.config_for(ring.size)
    steps = [round(scene.FPS * seconds) for seconds in (plan.before_s, plan.down_s, plan.after_s)]
    count = plan.restarts * sum(steps)
    killed_ns, up_ns = np.zeros(plan.restarts, np.int64), np.zeros(plan.restarts, np.int64)
    with tempfile.TemporaryDirectory(prefix="gripmon-bench-") as scratch, _wires(config, Path(scratch)) as wires:
        switched = _Switched(wires.publishers, count)
        switched.current = 1

        def disturb(seq: int) -> None:
            turn, place = divmod(seq, sum(steps))
            if place == 0 and turn:
                up_ns[turn - 1] = wires.router.up_ns
            if place == steps[0]:
                killed_ns[turn] = time.monotonic_ns()
                wires.router.kill()
            elif place == steps[0] + steps[1]:
                wires.router.start()

        source = harness.RingSource(ring, count, paced=True, between=disturb)
        harness.run_loop(config, source, switched)
        up_ns[-1] = wires.router.up_ns
        for subscriber in wires.subscribers:
            subscriber.finish()
        routed = wires.subscribers[1]
    runs = []
    for turn in range(plan.restarts):
        seqs = np.arange(turn * sum(steps), (turn + 1) * sum(steps))
        came = np.isin(seqs, routed.seqs)
        after = routed.arrivals_ns[routed.arrivals_ns > killed_ns[turn] + round(1e9 * plan.down_s)]
        first_ns = int(after[0]) if len(after) else 0
        away = (source.handed_ns[seqs] >= killed_ns[turn]) & (source.handed_ns[seqs] < up_ns[turn])
        runs.append(
            {
                "router_away_s": 1e-9 * float(up_ns[turn] - killed_ns[turn]),
                "recovery_s": 1e-9 * (first_ns - float(up_ns[turn])) if first_ns else None,
                "lost": int((~came).sum()),
                "lost_while_away": int((~came & away).sum()),
            }
        )
    return _restarts(runs, switched.exceptions)


def _restarts(runs: list[dict[str, Any]], exceptions: int) -> Measured:
    recoveries = [turn["recovery_s"] for turn in runs]
    worst_s = max(np.inf if s is None else s for s in recoveries)
    lines = [
        [f"{turn['router_away_s']:.2f}", "never" if turn["recovery_s"] is None else f"{turn['recovery_s']:.2f}",
         turn["lost"], turn["lost_while_away"]]
        for turn in runs
    ]  # fmt: skip
    head = ("router away, s", "first transform after it listened again, s", "lost", "of them while it was away")
    return Measured(
        (
            Row("first transform after the router's return", worst_s, "s", RECOVERY_S, note="the worst"),
            Row("exceptions", exceptions, "", 0.0),
        ),
        (kit.table(head, lines), "before 0: processes that found it before it reported so"),
        {"runs": runs},
    )


@dataclass
class _Wires:
    """A publisher that listens and one that is a router's client, with a subscriber each."""

    links: list[Link]
    publishers: list[ZenohPublisher]
    subscribers: list[harness.Subscriber]
    router: RouterProcess
    endpoint: str

    def guest(self, condition: str, plan: Plan) -> Staller | Crowd | None:
        """Whoever belongs to a condition.  Before "alone" one comes and goes, so that all begin after the same stir."""
        key = self.publishers[0].keys["transform"]
        if condition in ("alone", "stopped", "blocked"):
            sessions: list[Any] = []
            self.links[0].attach(sessions.append)
            staller = Staller(sessions[0], self.endpoint, key, stop=condition == "stopped")
            if condition != "alone":
                return staller
            staller.close()
        return Crowd(self.endpoint, key, plan.more_subscribers) if condition == "ten" else None


@contextlib.contextmanager
def _wires(config: Any, scratch: Path) -> Iterator[_Wires]:
    with contextlib.ExitStack() as opened:
        endpoint, router = free_endpoint(), RouterProcess(scratch)
        opened.callback(router.close)
        settings = (PublishSettings(listen=(endpoint,)), PublishSettings(mode="client", connect=(router.endpoint,)))
        links = [Link(each) for each in settings]
        names = config.settings.robot, config.settings.camera_name
        publishers = [ZenohPublisher(link, *names) for link in links]
        for publisher in publishers:
            opened.callback(publisher.close)
        kit.until(lambda: links[1].connected, "the router was not reached", 30.0)
        key = publishers[0].keys["transform"]
        subscribers = [harness.Subscriber(place, key) for place in (endpoint, router.endpoint)]
        yield _Wires(links, publishers, subscribers, router, endpoint)


def _arrived_us(subscriber: harness.Subscriber, source: harness.RingSource, count: int) -> NDArray[np.float64]:
    """From handed over to in the other process's callback, per frame; NaN for one that never came."""
    arrived_us = np.full(count, np.nan)
    arrived_us[subscriber.seqs] = 1e-3 * (subscriber.arrivals_ns - source.handed_ns[subscriber.seqs])
    return arrived_us
