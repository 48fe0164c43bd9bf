"""``gripmon calibrate``: the off-line methods, one module each."""

from __future__ import annotations

import argparse
from typing import Any

from gripmon.cli import (
    calibrate_export,
    calibrate_import,
    calibrate_intrinsics,
    calibrate_laser,
    calibrate_plane,
    calibrate_robot_world,
    calibrate_verify,
)

_METHODS = (
    calibrate_intrinsics,
    calibrate_plane,
    calibrate_laser,
    calibrate_robot_world,
    calibrate_verify,
    calibrate_import,
    calibrate_export,
)

_DESCRIPTION = """\
The off-line methods, from images alone.  Each writes a file with residuals, covariance and
provenance, whole or not at all, and replaces none without --force."""

_EPILOG = """\
examples:
  gripmon calibrate intrinsics plate/*.png --target chequerboard:9x6:0.025 --out camera.yaml
  gripmon calibrate plane on_plate.png --camera camera.yaml --target circles:8x8:0.008:0.004 \\
      --gripper gripper.yaml --corners rough.yaml --out hand_eye.yaml
  gripmon calibrate laser spots.csv --camera camera.yaml --out laser.yaml

exit codes: 0 written; 2 wrong usage or files; 3 the images can't be calibrated from, and why"""


def add_parser(commands: Any) -> None:
    """Add the subcommand with its methods."""
    parser = commands.add_parser(
        "calibrate",
        help="calibrate from images: camera, hand/eye and more",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    methods = parser.add_subparsers(title="methods", metavar="METHOD", required=True)
    for method in _METHODS:
        method.add_parser(methods)
