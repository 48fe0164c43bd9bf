"""What several subcommands share.  Nothing heavy at the top: this is imported for ``--help``."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.model.errors import InputError

if TYPE_CHECKING:
    from gripmon.daemon.config import Config

EXIT_DONE = 0
EXIT_USAGE = 2
EXIT_FAILED = 3
EXIT_INTERRUPTED = 130
EXIT_BROKEN_PIPE = 141  # as the shell reports a program that SIGPIPE stopped
_LARGEST_SEED = 2**32 - 1


def add_command(
    commands: Any,
    name: str,
    handler: Callable[[argparse.Namespace], int],
    summary: str,
    description: str,
    examples: str,
) -> argparse.ArgumentParser:
    """A subcommand's parser with its help texts."""
    parser: argparse.ArgumentParser = commands.add_parser(
        name,
        help=summary,
        description=description,
        epilog=f"examples:\n{examples}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(handler=handler)
    return parser


def positive_number(text: str) -> float:
    """An argument that is a finite number above zero."""
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number; a number above 0") from None
    if not (math.isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f"{text} is not above 0; a number above 0")
    return value


def arm_noise(text: str) -> tuple[float, float]:
    """An argument M:RAD, standard deviations of an arm's poses."""
    parts = text.split(":")
    try:
        position, rotation = (float(part) for part in parts)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not M:RAD; e.g. 0.0001:0.0002") from None
    if not (0.0 <= position < 0.1 and 0.0 <= rotation < 0.5):
        raise argparse.ArgumentTypeError(f"{text} is no arm's noise; metres and radians, e.g. 0.0001:0.0002")
    return position, rotation


def seed(text: str) -> int:
    """An argument that seeds a simulation."""
    if not text.isdecimal() or int(text) > _LARGEST_SEED:
        raise argparse.ArgumentTypeError(f"'{text}' is no seed; a whole number, 0 to {_LARGEST_SEED}")
    return int(text)


def load(path: str, *, check_source: bool = True, with_taught: bool = True) -> Config:
    """The checked configuration in a file."""
    from gripmon.daemon.config import load_config

    return load_config(Path(path), check_source=check_source, with_taught=with_taught)


def load_demo_or(path: str | None) -> Config:
    """The configuration in a file, or that of the demo."""
    from gripmon.daemon.config import builtin_config

    return load(str(builtin_config("demo.yaml")) if path is None else path, check_source=False)


def make_directory(path: Path, option: str = "--out") -> Path:
    """Create a directory for output, which ``option`` names; a fault ends the command with exit code 2."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{option} {path}: can't be made ({error.strerror}); a directory to write to") from None
    if not os.access(path, os.W_OK | os.X_OK):
        raise InputError(f"{option} {path}: may not be written to; a directory of your own")
    return path


def not_writable(path: Path, error: OSError, option: str = "--out") -> InputError:
    """What to raise when a file for output can't be opened."""
    return InputError(f"{option} {path}: can't be written ({error.strerror or error}); a file")


def check_file(path: Path, option: str = "--out") -> None:
    """End the command with exit code 2, before any work, if a file can't be written; it is made but not changed."""
    try:
        path.open("ab").close()
    except OSError as error:
        raise not_writable(path, error, option) from None


def progress_bar(total: int | None, unit: str) -> AbstractContextManager[Callable[..., None]]:
    """A context that gives a function to call once for each step, with the total if that is known then; it draws on
    stderr, and only for a person.
    """
    if not sys.stderr.isatty():
        return nullcontext(lambda *_total: None)
    return _TqdmSteps(total, unit)


def messages_above_bar(logger: str) -> AbstractContextManager[object]:
    """While it lasts, what this logger writes to a terminal appears above the progress bar."""
    if not sys.stderr.isatty():
        return nullcontext()
    import logging

    from tqdm.contrib.logging import logging_redirect_tqdm

    redirected: AbstractContextManager[object] = logging_redirect_tqdm([logging.getLogger(logger)])
    return redirected


class _TqdmSteps(AbstractContextManager[Callable[..., None]]):
    def __init__(self, total: int | None, unit: str):
        from tqdm import tqdm

        self._bar = tqdm(total=total, unit=unit, file=sys.stderr, dynamic_ncols=True)

    def __enter__(self) -> Callable[..., None]:
        return self._step

    def __exit__(self, *_exception: object) -> None:
        self._bar.close()

    def _step(self, total: int | None = None) -> None:
        self._bar.total = total or self._bar.total
        self._bar.update()
