"""What all methods of ``gripmon calibrate`` share: files to write, errors in its words, the command line for files."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import common
from gripmon.model.errors import InputError, NoResultError

if TYPE_CHECKING:
    import msgspec

    from gripmon.model.records import Image
    from gripmon.model.targets import Target


@contextmanager
def errors_of(method: str) -> Iterator[None]:
    """Errors that know nothing of a command line get its words: the method's name, or the option."""
    from gripmon.calibrate.sighting import CalibrationError
    from gripmon.model.targets import TargetError

    try:
        yield
    except CalibrationError as error:
        for detail in error.details:
            print(detail, file=sys.stderr)
        raise NoResultError(f"calibrate {method}: {error}") from None
    except TargetError as error:
        raise InputError(f"--target: {error}") from None


def target_of(text: str) -> Target:
    """The target that ``--target`` describes, or in the file that it names."""
    from gripmon.daemon.calibrations import target_of as described

    with errors_of(""):
        return described(text)


def check_output(path: Path, *, force: bool, option: str = "--out") -> None:
    """Refuse, before any work, a file that can't be written or is there already."""
    common.make_directory(path.parent, option)
    if path.is_dir():
        raise InputError(f"{option} {path}: is a folder; a file")
    if path.exists() and not force:
        raise InputError(f"{option} {path}: is there already; another file, or --force to replace it")


def check_picture(path: Path, *, force: bool, option: str = "--picture") -> None:
    """As :func:`check_output`, for a picture."""
    check_output(path, force=force, option=option)
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise InputError(f"{option} {path}: has no known ending; .png or .jpg")


def write_document(document: msgspec.Struct | dict[str, Any], path: Path, option: str = "--out") -> None:
    """Write it as YAML, whole or not at all."""
    from gripmon.daemon.calibrations import write_document as write

    with _writing(path, option):
        write(document, path)


def write_picture(picture: Image, path: Path, option: str = "--picture") -> None:
    """Write it, whole or not at all, in the format that the file's name ends in."""
    import cv2

    write_bytes(cv2.imencode(path.suffix, picture)[1].tobytes(), path, option)


def write_bytes(data: bytes, path: Path, option: str = "--out") -> None:
    """Write them, whole or not at all."""
    from gripmon.model.atomic import write_atomically

    with _writing(path, option):
        write_atomically(path, data)


@contextmanager
def _writing(path: Path, option: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise common.not_writable(path, error, option) from None


def command_line(method: str, positional: Sequence[str], options: dict[str, Any]) -> str:
    """What a file's provenance calls the command; options that are None or False were not given."""
    words = ["gripmon", "calibrate", method, *positional]
    for option, value in options.items():
        if value is True:
            words.append(option)
        elif isinstance(value, list):
            words += [word for one in value for word in (option, str(one))]
        elif value is not None and value is not False:
            words += [option, str(value)]
    return shlex.join(words)


def options_of(arguments: Any, *names: str) -> dict[str, Any]:
    """Options by name with what was given for them, for :func:`command_line`."""
    return {f"--{name}": getattr(arguments, name.replace("-", "_")) for name in names}
