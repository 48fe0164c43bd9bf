"""The command ``gripmon``: one file a subcommand, nothing heavy imported before a subcommand runs.

``argparse`` stays: it costs no import time, and its error lines and exit codes are what scripts rely on.
"""

from __future__ import annotations

import argparse
import os
import sys

from gripmon import __version__
from gripmon.cli import (
    calibrate,
    certificates,
    check,
    correct,
    demo,
    export,
    feed,
    replay,
    report,
    router,
    run,
    schema,
    send,
    simulate,
    teach,
    view,
    watch,
)
from gripmon.cli.common import EXIT_BROKEN_PIPE, EXIT_INTERRUPTED
from gripmon.model.errors import InputError, NoResultError

_COMMANDS = (
    demo,
    run,
    watch,
    send,
    router,
    schema,
    feed,
    replay,
    view,
    report,
    export,
    correct,
    simulate,
    check,
    calibrate,
    teach,
    certificates,
)

# To be set before NumPy and OpenCV are imported; what the user has set stays.
_ENVIRONMENT = {
    # One thread: the matrices are tiny, and the same input then gives the same bytes.
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    # A camera that is absent, or a file that is no video, we report in our own words.
    "OPENCV_LOG_LEVEL": "ERROR",
    "OPENCV_FFMPEG_LOGLEVEL": "-8",
    # rerun's own lines, read when it is imported: so are a disk that is full and a file that is damaged.
    "RUST_LOG": "off",
}

_DESCRIPTION = """\
gripmon watches a robot's wrist camera that sees its own fingertips: in every frame it measures the
fingertips' corners, corrects the hand/eye calibration cam_T_grip, says whether it can still be
trusted, and publishes it over Zenoh."""

_EPILOG = """\
first steps:
  gripmon demo                                   everything at work on a simulated camera, 20 s
  gripmon check configs/live_camera.yaml         is my configuration sound?
  gripmon run configs/live_camera.yaml           the daemon

exit codes: 0 done; 2 wrong usage or configuration (one line says file, key, what is wrong, what
would be right); 3 the monitored thing failed (for example: no usable frame); 130 interrupted"""


def build_parser() -> argparse.ArgumentParser:
    """The parser of all subcommands; each sets ``handler``."""
    parser = argparse.ArgumentParser(
        prog="gripmon", description=_DESCRIPTION, epilog=_EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--version", action="version", version=f"gripmon {__version__}")
    parser.add_argument("--print-completion", action=_PrintCompletion, choices=("bash", "zsh"), help=argparse.SUPPRESS)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")
    for command in _COMMANDS:
        command.add_parser(commands)
    return parser


class _PrintCompletion(argparse.Action):
    """Print what a shell needs to complete commands, options and choices: source <(gripmon --print-completion bash)."""

    def __call__(
        self, parser: argparse.ArgumentParser, _namespace: object, value: object, _option: str | None = None
    ) -> None:
        import shtab

        print(shtab.complete(parser, str(value)))
        parser.exit()


def main(arguments: list[str] | None = None) -> int:
    """Run a command line (default: the process's own) return its exit code; wrong usage raises ``SystemExit(2)``."""
    parser = build_parser()
    chosen = parser.parse_args(arguments)
    if not hasattr(chosen, "handler"):
        parser.print_help()
        return 0
    for variable, value in _ENVIRONMENT.items():
        os.environ.setdefault(variable, value)
    try:
        code: int = chosen.handler(chosen)
        sys.stdout.flush()
    except (InputError, NoResultError) as error:
        print(error, file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("gripmon: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        # Whoever read our output has seen enough.  Python would complain once more at exit without this.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_BROKEN_PIPE
    return code
