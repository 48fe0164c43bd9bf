"""``gripmon run``: the daemon."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from gripmon.cli import common

_DESCRIPTION = """\
Watch a camera: correct cam_T_grip in every frame, publish it over Zenoh and record it, until
interrupted (Ctrl-C or SIGTERM).  A camera that is missing or goes away is tried again for ever, and
the state on the network says so."""

_EXAMPLES = """\
  gripmon run configs/live_camera.yaml
  gripmon run configs/demo.yaml --duration 60 --out results

Messages are on the Zenoh keys gripmon/<robot>/<camera>/{transform,state,alert,reference}.
exit codes: 0 the source ended, the time was over, or SIGTERM; 2 wrong usage or configuration; 3 no
usable frame, or an internal error that persisted; 130 Ctrl-C"""


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = common.add_command(
        commands, "run", run, "the daemon: watch a camera, publish and record", _DESCRIPTION, _EXAMPLES
    )
    parser.add_argument("config", metavar="CONFIG", help="configuration file (YAML)")
    parser.add_argument(
        "--duration", type=common.positive_number, metavar="S", help="stop after so many seconds (s); default: never"
    )
    parser.add_argument(
        "--out",
        metavar="DIR",
        help="put the recording and estimates.jsonl (one JSON line a frame) here; made if it is missing",
    )
    parser.add_argument("--verbose", action="store_true", help="say more on stderr")


def run(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon run``."""
    config = common.load(arguments.config)
    out = None if arguments.out is None else common.make_directory(Path(arguments.out))
    return common.run_daemon(config, out=out, duration_s=arguments.duration, verbose=arguments.verbose)
