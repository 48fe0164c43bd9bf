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
frames, so that a seed gives the same figures again, whatever else the machine does.

exit codes: 0 all figures reached; 1 not all; 2 wrong usage; 3 the monitor failed; 130 interrupted
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import sys
from pathlib import Path
from typing import Any

_EXIT_USAGE, _EXIT_FAILED, _EXIT_INTERRUPTED = 2, 3, 130


def main() -> int:
    arguments = _parser().parse_args()
    if importlib.util.find_spec("pinocchio") is None:
        print("servo: pinocchio is not installed; tools/servo, or pip install '.[bench]'", file=sys.stderr)
        return _EXIT_USAGE
    # Four arms and a monitor share the cores.  Has to come before NumPy is imported.
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = "1"
    from benchmarks.kit import Refused, Report, writable

    from servoing import report as reports
    from servoing.feed import FeedError

    try:
        writable(arguments.json, arguments.markdown)
        report = Report(" ".join(["tools/servo", *sys.argv[1:]]))
        reports.show(_measure(arguments), report)
        report.values |= {"seed": arguments.seed, "realtime": arguments.realtime}
        return report.end(arguments.json, arguments.markdown)
    except Refused as error:
        print(f"servo: {error}", file=sys.stderr)
        return _EXIT_USAGE
    except FeedError as error:
        print(f"servo: {error}", file=sys.stderr)
        return _EXIT_FAILED
    except KeyboardInterrupt:
        return _EXIT_INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="tools/servo", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=_count, default=10, metavar="N", help="of each of the four rows (default 10)")
    parser.add_argument("--seed", type=_seed, default=1, metavar="N", help="of everything random (default 1)")
    parser.add_argument("--fps", type=_rate, default=30.0, metavar="HZ", help="frame rate of the camera (default 30)")
    parser.add_argument(
        "--realtime", action="store_true",
        help="a live camera, as on a robot: frames that come too late are dropped, transforms age; needs a machine "
        "with nothing else to do",
    )  # fmt: skip
    parser.add_argument("--json", type=Path, metavar="FILE", help="write everything that was measured")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the report as a Markdown file")
    return parser


def _count(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 1000:
        raise argparse.ArgumentTypeError(f"'{text}'; a whole number, 1 to 1000")
    return int(text)


def _seed(text: str) -> int:
    if not text.isdecimal() or int(text) >= 2**32:
        raise argparse.ArgumentTypeError(f"'{text}' is not a seed; a whole number, 0 to {2**32 - 1}")
    return int(text)


def _rate(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 10.0 <= value <= 200.0:
        raise argparse.ArgumentTypeError(f"'{text}'; a number from 10 to 200 (a command lives for 0.1 s)")
    return value


def _measure(arguments: argparse.Namespace) -> list[Any]:
    from benchmarks import kit

    from servoing import runs, stage

    total = sum(round(stage.duration_s(row) * arguments.fps) for row in stage.ROWS) * arguments.runs
    with kit.bar("frame", total) as bar:
        return [
            runs.run(row, number, arguments.seed, arguments.fps, realtime=arguments.realtime, step=bar.update)
            for row in stage.ROWS
            for number in range(arguments.runs)
        ]


if __name__ == "__main__":
    sys.exit(main())
