"""The command ``gripmon``: one declaration per subcommand, no heavy import before a subcommand runs.

It uses ``argparse``, which costs no import time; scripts rely on its error lines and exit codes.
"""

from __future__ import annotations

import argparse
import os
import sys
from typing import Any

from gripmon import __version__
from gripmon.cli import (
    calibrate_arm,
    calibrate_exchange,
    calibrate_intrinsics,
    calibrate_plane,
    calibrate_verify,
    check,
    dataset,
    demo,
    gripper_cad,
    gripper_images,
    network,
    recordings,
    replay,
    run,
    send,
    setup,
    simulate,
    teach,
    watch,
)
from gripmon.cli.common import Arguments, Command
from gripmon.model.errors import InputError, NoResultError
from gripmon.model.stopping import EXIT_INTERRUPTED

_COMMANDS = (
    demo.demo, run.run, watch.watch, send.send, network.router, network.schema, network.feed, replay.replay,
    recordings.view, recordings.report, recordings.export, recordings.correct, dataset.dataset,
    simulate.simulate, check.check,
)  # fmt: skip
_METHODS = (
    calibrate_intrinsics.intrinsics, calibrate_plane.plane, calibrate_arm.laser, calibrate_arm.robot_world,
    calibrate_verify.verify, calibrate_exchange.import_, calibrate_exchange.export,
)  # fmt: skip
_WAYS = (gripper_cad.from_cad, gripper_images.from_images)
_LAST = (setup.setup, setup.target, teach.teach)

_EXIT_BROKEN_PIPE = 141  # as the shell reports a program that SIGPIPE stopped

# Set before NumPy and OpenCV are imported, unless the user has set them.
_ENVIRONMENT = {
    # One thread: the matrices are tiny, and the same input then gives the same bytes.
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    # We report missing cameras and files that aren't videos ourselves.
    "OPENCV_LOG_LEVEL": "ERROR",
    "OPENCV_FFMPEG_LOGLEVEL": "-8",
    # rerun reads this at import; we report full disks and damaged files ourselves.
    "RUST_LOG": "off",
}

_DESCRIPTION = """\
gripmon monitors a robot's wrist camera that sees its own fingertips: in every frame it measures the
fingertips' edges and corners, corrects the hand/eye calibration cam_T_grip, judges whether it may be
used, and publishes it over Zenoh."""

_EPILOG = """\
first steps:
  gripmon demo                                   the whole system on a simulated camera, 20 s
  gripmon setup arm1                             from your camera to a running monitor, on one page
  gripmon check arm1/config.yaml                 validate a configuration
  gripmon run arm1/config.yaml                   the daemon

exit codes: 0 done; 2 wrong usage or configuration (one line says file, key, what is wrong, what
would be right); 3 the monitored system failed (for example: no usable frame); 130 interrupted"""

_CALIBRATE = """\
The off-line methods, from images alone.  Each writes a file with residuals, covariance and
provenance, atomically, and replaces none without --force."""

_CALIBRATE_EPILOG = """\
examples:
  gripmon calibrate intrinsics plate/*.png --target chequerboard:9x6:0.025 --out camera.yaml
  gripmon calibrate plane on_plate.png --camera camera.yaml --target circles:8x8:0.008:0.004 \\
      --gripper gripper.yaml --corners rough.yaml --out hand_eye.yaml
  gripmon calibrate laser spots.csv --camera camera.yaml --out laser.yaml

exit codes: 0 written; 2 wrong usage or files; 3 the images can't be calibrated from, and why"""


_GRIPPER = """\
Make a gripper file from CAD or from images.  The file is written atomically, and none is replaced
without --force."""

_GROUPS = (
    (
        "calibrate",
        "calibrate from images: camera, hand/eye and more",
        _CALIBRATE,
        _CALIBRATE_EPILOG,
        "method",
        _METHODS,
    ),
    ("gripper", "make a gripper file", _GRIPPER, None, "way", _WAYS),
)


def build_parser() -> argparse.ArgumentParser:
    """The parser of all subcommands; each sets ``command``."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="gripmon", description=_DESCRIPTION, epilog=_EPILOG, formatter_class=raw)
    parser.add_argument("--version", action="version", version=f"gripmon {__version__}")
    parser.add_argument("--print-completion", action=_PrintCompletion, choices=("bash", "zsh"), help=argparse.SUPPRESS)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")
    for command in _COMMANDS:
        command.add_to(commands)
    for name, summary, description, epilog, called, members in _GROUPS:
        group = commands.add_parser(
            name, help=summary, description=description, epilog=epilog, formatter_class=raw
        ).add_subparsers(title=f"{called}s", metavar=called.upper(), required=True)
        for member in members:
            member.add_to(group)
    for command in _LAST:
        command.add_to(commands)
    return parser


class _PrintCompletion(argparse.Action):
    """Print a shell's completion script for commands, options, choices and files:
    source <(gripmon --print-completion bash).
    """

    def __call__(
        self, parser: argparse.ArgumentParser, _namespace: object, value: object, _option: str | None = None
    ) -> None:
        import shtab

        _complete_files(parser, shtab.FILE)
        print(shtab.complete(parser, str(value)))
        parser.exit()


def _complete_files(parser: argparse.ArgumentParser, files: Any) -> None:
    """Complete every value as a file name, because a command's own completion replaces the shell's."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for each in action.choices.values():
                _complete_files(each, files)
        elif action.choices is None and action.nargs != 0:
            action.complete = files  # type: ignore[attr-defined]


def main(arguments: list[str] | None = None) -> int:
    """Run a command line (default: the process's own); return its exit code; wrong usage raises ``SystemExit(2)``."""
    parser = build_parser()
    chosen = parser.parse_args(arguments, Arguments())
    if not hasattr(chosen, "command"):
        parser.print_help()
        return 0
    for variable, value in _ENVIRONMENT.items():
        os.environ.setdefault(variable, value)
    command: Command = chosen.command
    try:
        code = command.run(chosen)
        sys.stdout.flush()
    except (InputError, NoResultError) as error:
        print(_in_words(error, chosen), file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("gripmon: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        # The reader of our output has closed it.  Without this Python would report it again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _EXIT_BROKEN_PIPE
    return code


def _in_words(error: InputError | NoResultError, arguments: Arguments) -> str:
    """The error's line; if a function's argument is wrong, its option is put in front."""
    from gripmon.model.targets import OtherSizeError

    command: Command = arguments.command
    if isinstance(error, OtherSizeError) and (option := command.arguments.get("other_target")):
        error = error.worded(option)
    if isinstance(error, InputError):
        for name in (error.argument, error.argument.rpartition("_")[0]):
            if option := command.arguments.get(name):
                given = getattr(arguments, name)
                values = tuple(map(str, given if isinstance(given, list) else [given]))
                return f"{option} {error.wrong}" if error.wrong.startswith(values) else f"{option}: {error.wrong}"
        return str(error)
    if error.details is None:
        return str(error)
    return "\n".join([*error.details, f"{command.prog}: {str(error).removeprefix(f'{command.prog}: ')}"])
