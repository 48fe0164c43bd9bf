"""A visual servo of a simulated arm that carries the camera which a real monitor watches.

A simulated six-axis arm with a camera at its wrist grasps an object by what the camera sees.  Half way of the
approach the camera's mount is knocked by 1.5 or 4.5 mm in any direction, with some rotation; in every other row a
hand then covers the view.  A real monitor (gripmon run, a process of its own) watches the images of that camera and
its transforms come over Zenoh.  Four arms do the same on the same images: by the calibration from before (without
gripmon), by the monitor's transform, by its smoothed transform, and by the truth.  The arms that follow the monitor
keep to its verdicts: they stop on unknown, go on slowly by what is suspect, begin and grasp by what is valid only.

Printed is how far the tool centre point (TCP) ends from where it should hold the object.

The loop is closed on frames: between two of them each arm moves by the command that the earlier one gave, for the
time between their stamps.  Without --realtime the monitor takes every frame as fast as it can, and time is that of the
frames, so that a seed gives the same figures again, whatever else the machine does.  Exit code 3: the monitor failed.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys

from benchmarks import kit
from benchmarks.kit import Report

_FASTEST_HZ, _SLOWEST_HZ = 200.0, 10.0
_EXIT_FAILED = 3


def add_options(parser: argparse.ArgumentParser) -> None:
    kit.numbers(parser, runs=(10, "of each of the four rows"))
    parser.add_argument("--seed", type=kit.count, default=1, metavar="N", help="of everything random (default 1)")
    parser.add_argument("--fps", type=float, default=30.0, metavar="HZ", help="frame rate of the camera (default 30)")
    parser.add_argument(
        "--realtime", action="store_true",
        help="a live camera, as on a robot: frames that come too late are dropped, transforms age; needs a machine "
        "with nothing else to do",
    )  # fmt: skip


def run(arguments: argparse.Namespace, report: Report) -> int | None:
    if importlib.util.find_spec("pinocchio") is None:
        raise kit.Refused("pinocchio is not installed; tools/servo, or pip install '.[bench]'")
    fps = arguments.fps
    if not _SLOWEST_HZ <= fps <= _FASTEST_HZ:
        raise kit.Refused(f"--fps {fps:g}; a number from 10 to 200 (a command lives for 0.1 s)")
    from servoing import report as reports
    from servoing import runs, stage
    from servoing.feed import FeedError

    total = sum(round(stage.duration_s(row) * fps) for row in stage.ROWS) * arguments.runs
    try:
        with kit.bar("frame", total) as bar:
            done = [
                runs.run(row, number, arguments.seed, fps, realtime=arguments.realtime, step=bar.update)
                for row in stage.ROWS
                for number in range(arguments.runs)
            ]
    except FeedError as error:
        print(f"servo: {error}", file=sys.stderr)
        return _EXIT_FAILED
    reports.show(done, report)
    report.values |= {"seed": arguments.seed, "realtime": arguments.realtime}
    return None
