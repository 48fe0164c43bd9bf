"""From a frame handed over to its transform in another process's callback.

Runs the daemon's own loop on frames of the demo's scene, rendered beforehand, at 60 frames/s, and times
each from handed over until its transform is in the callback of a subscriber in another process: alone,
with a subscriber whose process is stopped, with one whose callback blocks (both with the connection filled
to the brim), with ten subscribers, and through a router; in turns, in one run, beside what the monitor needed
for the same frames. Then the router is killed and started again under the running loop. Last, a
controller's client behind links that can't carry the rate, and behind a router that is stopped: the true age of
what it calls usable, against the age that it claims. Takes some nine minutes; --quick, less exact, three.
"""

from __future__ import annotations

import argparse

from benchmarks import parts, wire_runs, wire_slow
from benchmarks.kit import Report
from benchmarks.parts import Frames, Part

_FRAMES = (Frames(count=60, quick=30),)
PARTS = {
    "conditions": Part(
        "subscribers that are alone, stalled, many, behind a router", wire_runs.conditions, wire_runs.Plan(), _FRAMES,
        {"block": 210, "rounds": 3},
    ),
    "restarts": Part(
        "a router killed and started again", wire_runs.restarts, wire_runs.Plan(), _FRAMES, {"restarts": 2}
    ),
    "slow": Part("a client over slow links", wire_slow.slow_links, wire_slow.Plan(), quick={"slow_s": 8.0}),
}  # fmt: skip


def add_options(parser: argparse.ArgumentParser) -> None:
    parts.add_options(parser, "a shorter run")


def run(arguments: argparse.Namespace, report: Report) -> int | None:
    return parts.run(arguments, report, PARTS)
