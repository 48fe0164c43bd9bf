"""``python -m benchmarks NAME``: runs one benchmark; its report goes to standard output, progress to standard error."""

from __future__ import annotations

import argparse
import os
import sys

from benchmarks import (
    accuracy,
    belief,
    causes,
    correction,
    dataset,
    drift,
    integrity,
    laser,
    latency,
    offline,
    real,
    recalibration,
    record,
    recovery,
    series,
    shapes,
    wire,
)

_BENCHMARKS = (
    accuracy,
    belief,
    causes,
    correction,
    dataset,
    drift,
    integrity,
    laser,
    latency,
    offline,
    real,
    recalibration,
    record,
    recovery,
    series,
    shapes,
    wire,
)


def main() -> int:
    parser = argparse.ArgumentParser(prog="tools/bench", description="Benchmarks of gripmon.")
    commands = parser.add_subparsers(title="benchmarks", metavar="NAME", required=True)
    for benchmark in _BENCHMARKS:
        benchmark.add_parser(commands)
    arguments = parser.parse_args()
    # One thread for all that are compared; must be set before NumPy is imported.
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = "1"
    code: int = arguments.handler(arguments)
    return code


if __name__ == "__main__":
    sys.exit(main())
