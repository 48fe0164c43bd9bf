"""``gripmon run``: the daemon."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from gripmon.cli import common, second_run, viewing
from gripmon.model.errors import InputError
from gripmon.model.stopping import StopRequest, signals_exit

_DESCRIPTION = """\
Watch a camera: correct cam_T_grip in every frame, publish it over Zenoh and record it, until
interrupted (Ctrl-C or SIGTERM).  A camera that is missing or goes away is tried again for ever, and
the state on the network says so.

The references, a proposal and open alerts survive a restart, also kill -9 and a power cut, in the file
that state.file names: a live camera's in ~/.local/state/gripmon.  After a restart the monitor goes on
from the last reference, checks in the picture that it still fits, and says so (alert restarted).

A configuration with a section laser is that of a second camera, beside the robot: its calibration is
tested with every pulse of a laser pointer on the arm, which the robot's program tells
(docs/howto/laser.md, Watching)."""

_EXAMPLES = """\
  gripmon run configs/live_camera.yaml
  gripmon run configs/demo.yaml --duration 60 --out results

  gripmon run configs/live_camera.yaml --fresh-state     begin anew; the kept state is set aside
  gripmon send undo --robot arm1                         back to the reference before
  gripmon run configs/live_camera.yaml --view web        watch it live in a browser, on this machine

  gripmon run configs/second_camera.yaml                 a fixed camera, watched with a pulsed laser

Messages are on the Zenoh keys gripmon/<robot>/<camera>/{transform,state,alert,reference}; a second
camera's on {spot,state,alert}, and it hears pulses on …/pulse.
exit codes: 0 the source ended, the time was over, or SIGTERM; 2 wrong usage or configuration; 3 no
usable frame, pulses of which none showed its spot, or an internal error that persisted; 4 another
monitor of this robot and camera is on the network; 130 Ctrl-C"""


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
        help="put the recording and estimates.jsonl (one JSON line a frame; spots.jsonl, a line a pulse) here; made if "
        "it is missing, and what is there is kept (estimates-1.jsonl …) within daemon.estimates_budget_bytes",
    )
    parser.add_argument(
        "--fresh-state",
        action="store_true",
        help="start from the configured reference; a kept state is set aside as <file>.replaced-<n>",
    )
    parser.add_argument(
        "--take-over",
        action="store_true",
        help="start also where another monitor of this robot and camera is on the network; nothing is usable until "
        "one of the two is stopped",
    )
    viewing.add_option(parser)
    parser.add_argument("--verbose", action="store_true", help="say more on stderr")


def run(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon run``."""
    with signals_exit() as stop:
        return _run(arguments, stop)


def _run(arguments: argparse.Namespace, stop: StopRequest) -> int:
    second = second_run.load(arguments.config)
    if second is not None:
        if arguments.fresh_state:
            text = f"run: --fresh-state is for wrist cameras, {arguments.config} is a second camera's; leave it out"
            raise InputError(text)
        out = None if arguments.out is None else common.make_directory(Path(arguments.out))
        return second_run.run_second(
            second,
            out=out,
            duration_s=arguments.duration,
            verbose=arguments.verbose,
            view=arguments.view,
            take_over=arguments.take_over,
            stop=stop,
        )
    from gripmon.daemon.camera_source import look_ahead
    from gripmon.daemon.starting import run_monitor

    config = common.load(arguments.config)
    look_ahead(config)
    out = None if arguments.out is None else common.make_directory(Path(arguments.out))
    if out is not None:
        common.check_file(out / "estimates.jsonl")
    view = None if arguments.view is None else viewing.LiveView(config.settings.view, arguments.view, str(config.path))
    return run_monitor(
        config,
        out=out,
        duration_s=arguments.duration,
        verbose=arguments.verbose,
        warns=True,
        keep_state=True,
        fresh_state=arguments.fresh_state,
        view=view,
        take_over=arguments.take_over,
        stop=stop,
    )
