"""``python -m benchmarks NAME``: runs one benchmark; its report goes to standard output, progress to standard error.

A benchmark is a module: its docstring describes it, ``add_options(parser)`` adds its options, and
``run(arguments, report)`` measures.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from pathlib import Path

BENCHMARKS = {
    "accuracy": "errors, honesty and time of the transform in every condition; against others",
    "belief": "sampled risk of the belief's bound",
    "causes": "is the right cause named when something goes wrong",
    "correction": "the retroactively corrected transform beside the live ones",
    "dataset": "episodes in bulk: rate, memory, a kill, Ray",
    "drift": "false alarms and delays of the drift test",
    "integrity": "whether a valid transform can be relied on, in scenes made to mislead",
    "laser": "the laser-pointer method: errors, bound, coverage, wrong spots, time",
    "latency": "time from frame to published transform, and of the rest of the program; against tags and ViSP",
    "offline": "off-line calibrations against the truth",
    "real": "stills of real grippers, at fixed limits",
    "recalibration": "what becomes the reference after the camera was knocked",
    "record": "what recording costs: loop, disk, memory, a kill; and reading an hour of it",
    "recovery": "back on track after jumps of the camera, and never at a wrong place",
    "series": "the self-viewing paper's two series of image pairs, its tables beside ours",
    "servo": "a simulated arm grasps by the monitor's transform while its camera is knocked; tools/servo",
    "shapes": "fingers of any shape, from CAD, while the camera moves",
    "wire": "time from frame to another process's callback; stalled subscribers, a router, its restart",
}


def main() -> int:
    """Exit code 1: a target is missed; 2: it can't be run as asked."""
    listed = "\n".join(f"  {name:14}{what}" for name, what in BENCHMARKS.items())
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        prog="tools/bench", description="Benchmarks of gripmon.", epilog=f"benchmarks:\n{listed}",
        formatter_class=formatter,
    )  # fmt: skip
    parser.add_argument("name", choices=BENCHMARKS, metavar="NAME", help="tools/bench NAME --help says its options")
    name = parser.parse_args(sys.argv[1:2]).name
    # One thread for all that are compared; must be set before NumPy is imported.
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = "1"
    benchmark = importlib.import_module(f"benchmarks.{name}")
    own = argparse.ArgumentParser(
        prog=f"tools/bench {name}", description=benchmark.__doc__, formatter_class=formatter
    )  # fmt: skip
    benchmark.add_options(own)
    own.add_argument("--json", type=Path, metavar="FILE", help="write everything that was measured")
    own.add_argument("--markdown", type=Path, metavar="FILE", help="write the report as a Markdown file")
    arguments = own.parse_args(sys.argv[2:])
    return _run(benchmark, arguments, " ".join(["tools/bench", *sys.argv[1:]]))


def _run(benchmark: object, arguments: argparse.Namespace, title: str) -> int:
    from benchmarks.kit import Refused, Report, writable

    name = " ".join(title.split()[:2])
    try:
        writable(arguments.json, arguments.markdown)
        report = Report(title)
        ended = benchmark.run(arguments, report)  # type: ignore[attr-defined]
        return report.end(arguments.json, arguments.markdown) if ended is None else int(ended)
    except Refused as error:
        print(f"{name}: {error}", file=sys.stderr)
    except OSError as error:
        print(f"{name}: {error.filename}: {error.strerror}; a place that can be written to", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
