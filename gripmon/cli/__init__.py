"""The command ``gripmon``: one declaration per subcommand; only the module of the one that runs is imported.

It uses ``argparse``, which costs little import time; scripts rely on its error lines and exit codes.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from gripmon import __version__
from gripmon.model.errors import InputError, NoResultError
from gripmon.model.stopping import EXIT_INTERRUPTED, interrupts_kept

if TYPE_CHECKING:
    from gripmon.cli.common import Arguments, Command

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
    # A file of 1 MB may hold gigabytes of one colour; 12,000 x 12,000 px of 16-bit colour are 0.8 GiB.
    "OPENCV_IO_MAX_IMAGE_PIXELS": "144000000",
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

_COMMANDS: dict[str, dict[str, tuple[str, str]]] = {
    "start": {
        "setup": ("start:setup", "from a camera to a running monitor, on one page"),
        "demo": ("start:demo", "the whole system on a simulated camera"),
        "simulate": ("start:simulate", "write simulated images with exact truth"),
        "gripper": ("", "make a gripper file: from-cad, from-images"),
        "teach": ("teach:teach", "measure how the gripper's edges look at the reference"),
        "check": ("check:check", "validate a configuration and say what it will keep"),
    },
    "calibrate": {
        "target": ("start:target", "a calibration target to print"),
        "calibrate": ("", "calibrate from images: camera, hand/eye and more"),
    },
    "run": {
        "run": ("run:run", "the daemon: monitor a camera, publish and record"),
        "send": ("run:send", "send a command to a running monitor: undo, accept, state, …"),
        "feed": ("network:feed", "publish images over Zenoh, as a camera's driver does"),
        "schema": ("network:schema", "print the JSON Schema of the messages"),
    },
    "look back": {
        "report": ("look_back:report", "what happened: when did the camera move, what is affected"),
        "view": ("look_back:view", "recordings in rerun's viewer, native or in a browser"),
        "replay": ("look_back:replay", "recorded images or a video through the monitor, JSON lines out"),
        "correct": ("look_back:correct", "the best transform for every frame, from the whole recording"),
        "export": ("look_back:export", "write recordings as Parquet, by robot and day"),
        "dataset": ("look_back:dataset", "the extrinsics of every episode of a dataset"),
    },
    "many robots": {
        "watch": ("watch:watch", "a live table of all monitors, or their alerts"),
        "router": ("network:router", "a Zenoh router between monitors and their readers"),
    },
}
"""By what a person wants: each command with its module and name there, and what it is for."""

_BELOW = {
    "calibrate": (
        "method", _CALIBRATE, _CALIBRATE_EPILOG,
        {
            "intrinsics": ("calibrate_images:intrinsics", "a camera from images of a flat target"),
            "plane": ("calibrate_images:plane", "camera to gripper, from images of it on a plate"),
            "laser": ("calibrate_arm:laser", "a fixed camera, its plane and a laser pointer on the arm"),
            "robot-world": ("calibrate_arm:robot_world", "camera and arm, from poses of a target on the hand"),
            "verify": ("calibrate_files:verify", "do two calibrations differ, or does one still hold"),
            "import": ("calibrate_files:import_", "a camera or a hand/eye transform from another program's file"),
            "export": (
                "calibrate_files:export", "a calibration for ROS, Kalibr, OpenCV, mrcal, URDF, easy_handeye2"
            ),
        },
    ),
    "gripper": (
        "way", _GRIPPER, None,
        {
            "from-cad": ("gripper:from_cad", "from STL, OBJ, PLY, DAE, URDF or .cao"),
            "from-images": ("gripper:from_images", "from images before changing backgrounds"),
        },
    ),
}  # fmt: skip


def build_parser(words: Sequence[str] | None = None) -> argparse.ArgumentParser:
    """The parser, in which each command sets ``command``; ``words`` of a command line: with the arguments of the
    command that they name alone, None: of all.
    """
    raw = argparse.RawDescriptionHelpFormatter
    parser = _Parser(prog="gripmon", description=_DESCRIPTION, epilog=_EPILOG, formatter_class=raw)
    parser.add_argument("--version", action="version", version=f"gripmon {__version__}")
    parser.add_argument("--print-completion", action=_PrintCompletion, choices=("bash", "zsh"), help=argparse.SUPPRESS)
    below = parser.add_subparsers(metavar="COMMAND", parser_class=argparse.ArgumentParser)
    for commands in _COMMANDS.values():
        _add_commands(below, commands, words)
    return parser


def _add_commands(parent: Any, commands: dict[str, tuple[str, str]], words: Sequence[str] | None) -> None:
    for name, (where, summary) in commands.items():
        parser = parent.add_parser(name, help=summary, formatter_class=argparse.RawDescriptionHelpFormatter)
        if words is not None and words[:1] != [name]:
            continue
        if where:
            module, _, named = where.partition(":")
            command: Command = getattr(importlib.import_module(f"gripmon.cli.{module}"), named)
            command.fill(parser)
            continue
        called, parser.description, parser.epilog, members = _BELOW[name]
        group = parser.add_subparsers(title=f"{called}s", metavar=called.upper(), required=True)
        _add_commands(group, members, None if words is None else words[1:])


class _Parser(argparse.ArgumentParser):
    """Its help lists the commands by what a person wants."""

    def format_help(self) -> str:
        formatter = self._get_formatter()
        formatter.add_usage(self.usage, self._actions, self._mutually_exclusive_groups)
        formatter.add_text(self.description)
        (below,) = (action for action in self._actions if isinstance(action, argparse._SubParsersAction))
        listed: dict[str, argparse.Action] = {each.dest: each for each in below._get_subactions()}
        for title, commands in _COMMANDS.items():
            formatter.start_section(title)
            formatter.add_arguments([listed[name] for name in commands])
            formatter.end_section()
        formatter.start_section("options")
        formatter.add_arguments([action for action in self._actions if action is not below])
        formatter.end_section()
        formatter.add_text(self.epilog)
        return formatter.format_help()


class _PrintCompletion(argparse.Action):
    """Print a shell's completion script for commands, options, choices and files:
    source <(gripmon --print-completion bash).
    """

    def __call__(
        self, parser: argparse.ArgumentParser, _namespace: object, value: object, _option: str | None = None
    ) -> None:
        import shtab

        parser = build_parser()
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
    try:
        try:
            return _run(sys.argv[1:] if arguments is None else arguments)
        finally:  # also of what argparse prints
            if sys.stdout is not None:  # closed by who started it
                sys.stdout.flush()
    except BrokenPipeError:
        # The reader of our output has closed it.  Without this Python would report it again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _EXIT_BROKEN_PIPE
    except KeyboardInterrupt:  # also while modules are imported
        print("gripmon: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED


def _run(words: list[str]) -> int:
    named = [word for word in words if not word.startswith("-")]  # before a command no option has a value
    parser = build_parser(named[:2])
    chosen: Any = parser.parse_args(words, _arguments() if named else None)
    if not hasattr(chosen, "command"):
        parser.print_help()
        return 0
    for variable, value in _ENVIRONMENT.items():
        os.environ.setdefault(variable, value)
    command: Command = chosen.command
    try:
        with interrupts_kept():
            return command.run(chosen)
    except (InputError, NoResultError) as error:
        print(_in_words(error, chosen), file=sys.stderr)
        return error.exit_code


def _arguments() -> Arguments:
    from gripmon.cli.common import Arguments

    return Arguments()


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
