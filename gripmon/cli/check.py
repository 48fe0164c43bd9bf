"""``gripmon check``: is this configuration sound, and what does it expect to see?"""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING, Any

from gripmon.cli import check_laser, common, second_check, second_run, sweep
from gripmon.model.errors import InputError

if TYPE_CHECKING:
    from gripmon.daemon.config import Config

_DESCRIPTION = """\
Validate a configuration, its gripper file and its source, and say of each thing that matters whether
it is in order: OK, WARN (the monitor runs, but not all that is expected of it will come) or FAIL (it
can't do its work).

With --verbose, also what the calibration expects to see: where the fingertip corners are in the image
(px), which of them and which edges are visible, how far away the gripper is (mm), how exact one frame
will be along each axis, what the view can't separate (an unknown jaw opening and the distance), whether
its corners suffice to recalibrate, how far camera and jaws may move until too little is in view.  Of a
second camera (a configuration with a section laser): its calibration, what is known of its errors, and
what fresh spots would show.

With --laser, in place of a configuration: does a laser calibration still hold?  Which motions of
camera, plane and laser pointer fresh spots would tell, or do tell.

With --sweep: what other camera mounts and lenses would see, as a table and a picture, before
anyone drills a hole."""

_EXAMPLES = """\
  gripmon check configs/live_camera.yaml
  gripmon check configs/demo.yaml --verbose
  gripmon check configs/demo.yaml --json | python3 -m json.tool
  gripmon check configs/folder.yaml --sweep --distance 0.08:0.2:7 --tilt 10:60:6 --picture sweep.png
  gripmon check configs/folder.yaml --sweep --fov 40,60,80 --roll 0,90 --at 384,288
  gripmon check --laser laser.yaml
  gripmon check --laser laser.yaml fresh_spots.csv --arm-noise 0.0002:0.0004

exit codes: 0 sound, perhaps with warnings; 2 a fault in the configuration, in a file of Zenoh's that it
names, or a package that it needs is missing (one line says file, key, what is wrong, what would be
right); 3 a line says FAIL, such as a camera that can't be reached now; or something has moved since a
laser calibration, or its spots don't tell"""


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = common.add_command(
        commands, "check", run, "validate a configuration and show what it expects to see", _DESCRIPTION, _EXAMPLES
    )
    parser.add_argument(
        "config", nargs="*", metavar="CONFIG", help="configuration file (YAML); with --laser: tables of fresh spots"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object instead of text; metres, radians, px")
    parser.add_argument("--verbose", action="store_true", help="what the calibration expects to see, in numbers")
    sweep.add_options(parser)
    check_laser.add_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon check``."""
    if arguments.laser is not None:
        if arguments.sweep:
            raise InputError("--sweep: not with --laser; one of them")
        sweep.refuse_without_sweep(arguments)
        return check_laser.run(arguments)
    check_laser.refuse_without_laser(arguments)
    if len(arguments.config) != 1:
        raise InputError(f"check: {len(arguments.config)} configurations; one, or --laser LASER.yaml")
    arguments.config = arguments.config[0]
    if arguments.sweep:
        return sweep.run(arguments)
    sweep.refuse_without_sweep(arguments)
    second = second_run.load(arguments.config)
    if second is not None:
        return second_check.run(second, as_json=arguments.json, verbose=arguments.verbose)
    return _check(common.load(arguments.config), as_json=arguments.json, verbose=arguments.verbose)


def _check(config: Config, *, as_json: bool, verbose: bool) -> int:
    import msgspec

    from gripmon.cli import check_text
    from gripmon.daemon.findings import findings
    from gripmon.daemon.forecast import forecast
    from gripmon.daemon.surroundings import surroundings

    expected, around = forecast(config), surroundings(config)
    found = findings(expected, around)
    if as_json:
        values = {**msgspec.to_builtins(expected), **msgspec.to_builtins(around)}
        print(json.dumps({"findings": [each._asdict() for each in found], **values}, indent=2))
    else:
        lines = check_text.lines(expected.config, found)
        print("\n".join([*lines, "", *check_text.details(expected, around)] if verbose else lines))
    return check_text.exit_code(found)
