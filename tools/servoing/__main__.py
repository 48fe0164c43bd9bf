"""``tools/servo``: its report goes to standard output, progress to standard error."""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import sys
from pathlib import Path
from typing import Any

_DESCRIPTION = """\
A simulated six-axis arm with a camera at its wrist grasps an object by what the camera sees.  Half way of the
approach the camera's mount is knocked by 1.5 or 4.5 mm in any direction, with some rotation; in every other row a
hand then covers the view.  A real monitor (gripmon run, a process of its own) watches the images of that camera and
its transforms come over Zenoh.  Four arms do the same on the same images: by the calibration from before (without
gripmon), by the monitor's transform, by its smoothed transform, and by the truth.  The arms that follow the monitor
keep to its verdicts: they stop on unknown, go on slowly by what is suspect, begin and grasp by what is valid only.

Printed is how far the tool centre point (TCP) ends from where it should hold the object."""

_EPILOG = """\
examples:
  tools/servo
  tools/servo --runs 3 --plot servo.png --json servo.json
  tools/servo --realtime        the camera as on a robot: frames that come too late are dropped, transforms age

The loop is closed on frames: between two of them each arm moves by the command that the earlier one gave, for the
time between their stamps.  Without --realtime the monitor takes every frame as fast as it can, and time is that of the
frames, so that a seed gives the same figures again, whatever else the machine does.

exit codes: 0 all figures reached; 1 not all; 2 wrong usage; 3 the monitor failed; 130 interrupted"""

_EXIT_MISSED, _EXIT_USAGE, _EXIT_FAILED, _EXIT_INTERRUPTED = 1, 2, 3, 130


def main() -> int:
    arguments = _parser().parse_args()
    for package in ("pinocchio", *(("matplotlib",) if arguments.plot else ())):
        if importlib.util.find_spec(package) is None:
            print(f"servo: {package} is not installed; tools/servo, or pip install '.[bench]'", file=sys.stderr)
            return _EXIT_USAGE
    for option, path in (("--json", arguments.json), ("--plot", arguments.plot)):
        if path is not None and not os.access(path if path.exists() else path.parent, os.W_OK):
            print(f"servo: {option} {path}: can't be written; a file in a folder of your own", file=sys.stderr)
            return _EXIT_USAGE
    # Four arms and a monitor share the cores.  Has to come before NumPy is imported.
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = "1"
    try:
        return _run(arguments)
    except KeyboardInterrupt:
        return _EXIT_INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="tools/servo",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--runs", type=_count, default=10, metavar="N", help="of each of the four rows (default 10)")
    parser.add_argument("--seed", type=_seed, default=1, metavar="N", help="of everything random (default 1)")
    parser.add_argument("--fps", type=_rate, default=30.0, metavar="HZ", help="frame rate of the camera (default 30)")
    parser.add_argument(
        "--realtime", action="store_true", help="a live camera; needs a machine with nothing else to do"
    )
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw distance over time, a run of each row (PNG)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write everything that was measured")
    parser.add_argument("--markdown", action="store_true", help="print the table for a document, too")
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


def _run(arguments: argparse.Namespace) -> int:
    from benchmarks import machine

    from servoing import report
    from servoing.feed import FeedError
    from servoing.figures import figures, targets

    about = machine.description()
    try:
        runs = _measure(arguments)
    except FeedError as error:
        print(f"servo: {error}", file=sys.stderr)
        return _EXIT_FAILED
    every = figures(runs)
    reached = targets(every)
    print(report.as_text(about, runs, every, reached))
    if arguments.markdown:
        print("\n" + report.markdown(every))
    if arguments.json is not None:
        values = report.as_values(about, every, reached) | {"seed": arguments.seed, "realtime": arguments.realtime}
        arguments.json.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
    if arguments.plot is not None:
        from servoing import plot

        plot.draw(runs, arguments.plot)
    return 0 if all(target.met for target in reached) else _EXIT_MISSED


def _measure(arguments: argparse.Namespace) -> list[Any]:
    from tqdm import tqdm

    from servoing import runs, stage

    out = []
    total = sum(round(stage.duration_s(row) * arguments.fps) for row in stage.ROWS) * arguments.runs
    with tqdm(total=total, desc="frames", unit="frame", file=sys.stderr, disable=None) as bar:
        for row in stage.ROWS:
            for number in range(arguments.runs):
                bar.set_postfix_str(f"{row.name}, run {number + 1}")
                out.append(
                    runs.run(row, number, arguments.seed, arguments.fps, realtime=arguments.realtime, step=bar.update)
                )
    return out


if __name__ == "__main__":
    sys.exit(main())
