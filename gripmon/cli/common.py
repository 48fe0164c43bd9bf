"""What all commands share: how they are declared, the files that they write, progress bars.

Nothing heavy at the top: this is imported for ``--help``.
"""

from __future__ import annotations

import argparse
import inspect
import json
import math
import re
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any, TypeVar, cast

from gripmon.model.errors import InputError
from gripmon.model.units import jaw_opening_in, jaw_range_in

_T = TypeVar("_T")
REQUIRED = {"required": True}
DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"  # gripmon.io.wire's, which is too heavy for --help
NETWORK_OPTIONS = f"""
--connect ENDPOINT...  {{}} or a router's Zenoh endpoint, several times if need be; default: {DEFAULT_ENDPOINT}
--zenoh-config FILE    a configuration file of Zenoh's instead of --connect
"""
"""Of the commands that join the network as a client, which say whose endpoint it is."""

_PATHS = re.compile(r"FILE|DIR|CONFIG|CALIBRATION|DATA|IMAGE|INPUT|RECORDING|[A-Z]+\.yaml")
_NUMBERS = {"": None, "...": "+", "[]": "?", "[...]": "*"}
_PICTURES = (".png", ".jpg", ".jpeg")
_LARGEST_SEED = 2**32 - 1
PORT_OPTIONS = """
--port N            port of the page (default: any free one)
--no-browser        print the page's address, but open no browser
"""


class Command:
    """A command's declaration, and the decorator of the function that carries it out, whose docstring is the
    description in ``--help``.

    ``options`` is a table like that of ``--help``.  A row is what is typed, two blanks or a new line, and its meaning,
    which goes on in lines that are indented: ``NAME``, ``[NAME]``, ``NAME...``, ``[NAME...]`` for one argument, at most
    one, some, any number; ``--flag``, ``--option VALUE``, ``--option VALUE...`` for one that may be repeated.  A row
    that begins with ``|`` excludes the row before.  ``groups``: more such tables by title, each with a description.
    Values called FILE, DIR and the like are paths.  ``more``: keywords of ``add_argument`` for single arguments, or
    only a type.
    """

    def __init__(
        self,
        name: str,
        summary: str,
        options: str,
        examples: str,
        groups: Mapping[str, tuple[str | None, str]] | None = None,
        /,
        **more: Any,
    ) -> None:
        self._name, self._summary, self._epilog = name, summary, f"examples:\n{examples}"
        self._tables, self._more = {"": (None, options), **(groups or {})}, more
        self.arguments: dict[str, str] = {}  # by name: the option, empty for a positional one
        self.defaults: dict[str, Any] = {}
        self.prog = ""

    def __call__(self, handler: Callable[[Arguments], int | None]) -> Command:
        self._handler = handler
        return self

    def run(self, arguments: Arguments) -> int:
        """Carry it out; the exit code."""
        return self._handler(arguments) or 0

    def add_to(self, commands: Any) -> None:
        """Add it below a parser."""
        raw, description = argparse.RawDescriptionHelpFormatter, inspect.getdoc(self._handler)
        parser: argparse.ArgumentParser = commands.add_parser(
            self._name, help=self._summary, description=description, epilog=self._epilog, formatter_class=raw
        )
        parser.set_defaults(command=self)
        self.prog = parser.prog.partition(" ")[2]
        for title, (about, table) in self._tables.items():
            self._add_rows(parser.add_argument_group(title, about) if title else parser, _rows(table))

    def _add_rows(self, group: Any, rows: list[tuple[str, str]]) -> None:
        choice: Any = None
        for number, (typed, text) in enumerate(rows):
            if not typed.startswith("| "):
                follows = number + 1 < len(rows) and rows[number + 1][0].startswith("| ")
                choice = group.add_mutually_exclusive_group() if follows else None
            self._add(choice or group, typed.removeprefix("| "), text)

    def _add(self, group: Any, typed: str, text: str) -> None:
        word, _, value = typed.partition(" ")
        option = word if word.startswith("--") else ""
        metavar = (value if option else word.strip("[]")).removesuffix("...")
        name = (option or metavar).strip("-").replace("-", "_").lower()
        more = self._more.get(name, {})
        more = {"type": more} if callable(more) else more
        keywords: dict[str, Any] = {"help": text}
        if metavar:
            keywords["metavar"] = metavar
        if _PATHS.match(metavar):
            keywords["type"] = Path
        if not option:
            keywords["nargs"] = _NUMBERS[re.sub(r"[^][.]", "", word.replace(metavar, ""))]
        elif value.endswith("..."):
            keywords["action"] = "append"
        elif not value and "choices" not in more:
            keywords["action"] = "store_true"
        group.add_argument(option or name, **(keywords | more))
        self.arguments[name], self.defaults[name] = option, more.get("default")


def _rows(table: str) -> list[tuple[str, str]]:
    """What is typed and what it means."""
    rows: list[tuple[str, str]] = []
    for line in table.strip("\n").splitlines():
        typed, _, text = line.partition("  ")
        if not typed:
            typed, before = rows.pop()
            text = f"{before} {line.strip()}"
        rows.append((typed, text.strip()))
    return rows


class Arguments(argparse.Namespace):
    """What was given to a command, and what commands do with it; a file or folder is named by its option."""

    def command_line(self, **instead: Any) -> str:
        """The command with what was given to it, for a file's provenance; ``instead``: values in place of those."""
        command: Command = self.command
        words = ["gripmon", *command.prog.split()]
        for name, option in command.arguments.items():
            value = instead.get(name, getattr(self, name))
            if name == "json" or value in (None, False, [], command.defaults[name]):
                continue
            for each in value if isinstance(value, list) else [value]:
                words += [option] if option else []
                if isinstance(each, tuple):
                    each = ("x" if isinstance(each[0], int) else ":").join(f"{part:g}" for part in each)
                words += [] if each is True else [str(each)]
        return shlex.join(words)

    def refuse(self, names: Iterable[str], why: str) -> None:
        """End the command with exit code 2 if one of these options was given."""
        for name in names:
            if getattr(self, name) not in (None, False):
                raise InputError(f"{_option(name)}: {why}")

    def answer(self, values: Mapping[str, Any], lines: Iterable[str]) -> None:
        """Print the result: one JSON object with ``--json``, else lines for a person."""
        print(json.dumps(values, indent=2) if self.json else "\n".join(lines))

    def metres(self, name: str) -> float | None:
        """What an option in millimetres says; None where it wasn't given."""
        value_mm = getattr(self, name)
        return None if value_mm is None else 1e-3 * float(value_mm)

    def radians(self, name: str) -> float | None:
        """What an option in degrees says; None where it wasn't given."""
        value_deg = getattr(self, name)
        return None if value_deg is None else math.radians(value_deg)

    def network(self) -> dict[str, Any]:
        """``--connect`` and ``--zenoh-config``, as the clients take them."""
        if self.connect and self.zenoh_config:
            raise InputError(f"{self.command.prog}: --connect has no effect beside --zenoh-config; one of them")
        file = None if self.zenoh_config is None else str(self.zenoh_config)
        return {"connect": self.connect or (DEFAULT_ENDPOINT,), "zenoh_config_file": file}

    @contextmanager
    def network_errors(self) -> Iterator[None]:
        """Where there is no session, the error names the option: no key was written."""
        from gripmon.io.wire import PublishError

        try:
            yield
        except PublishError as error:
            option = {"connect": "--connect", "zenoh_config": "--zenoh-config"}.get(error.key, error.key)
            raise InputError(f"{self.command.prog}: {option}: {error.text}") from None

    def check_outputs(self, *names: str) -> None:
        """Refuse, before any work, files that can't be written, that are there already (without --force), or twice."""
        written: dict[Path, str] = {}
        for name in names:
            path, option = getattr(self, name), _option(name)
            if path is None:
                continue
            other = written.setdefault(path.resolve(), option)
            if other != option:
                raise InputError(f"{other} and {option}: both are {path}; different files")
            make_directory(path.parent, option)
            if path.is_dir():
                raise InputError(f"{option} {path}: is a folder; a file")
            if path.exists() and not getattr(self, "force", True):
                raise InputError(f"{option} {path}: is there already; another file, or --force to replace it")
            if name == "picture" and path.suffix.lower() not in _PICTURES:
                raise InputError(f"{option} {path}: has no known ending; .png or .jpg")

    def save(self, name: str, content: Any) -> None:
        """Write a file, whole or not at all, if it is wanted: bytes, a calibration as YAML, a picture in the format
        that the file's name ends in; or what a function gives that makes one of them.
        """
        path = getattr(self, name)
        if path is None:
            return
        made = content() if callable(content) else content
        with writing(path, _option(name)):
            if isinstance(made, bytes):
                from gripmon.model.atomic import write_atomically

                write_atomically(path, made)
            elif name == "picture":
                import cv2

                self.save(name, cv2.imencode(path.suffix, made)[1].tobytes())
            else:
                from gripmon.daemon.calibrations import write_document

                write_document(made, path)


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def positive_number(text: str) -> float:
    """An argument that is a finite number above zero."""
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number; a number above 0") from None
    if not (math.isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f"{text} is not above 0; a number above 0")
    return value


def jaw_opening(text: str) -> float:
    """An argument that is a jaw opening, m."""
    return _argument(jaw_opening_in, text)


def jaw_range(text: str) -> tuple[float, float]:
    """An argument MIN:MAX of jaw openings, m."""
    return _argument(jaw_range_in, text)


def _argument(convert: Callable[[str], _T], text: str) -> _T:
    try:
        return convert(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def whole_number(low: int, high: int, wrong: str) -> Callable[[str], int]:
    """The type of an argument within these bounds; ``wrong``: what another text is not, and what would be right."""

    def convert(text: str) -> int:
        if not text.isdecimal() or not low <= int(text) <= high:
            raise argparse.ArgumentTypeError(f"'{text}' {wrong}")
        return int(text)

    return convert


port = whole_number(1, 65535, "isn't a TCP port; 1 to 65535")
PAGE_PORT = {"type": whole_number(0, 65535, "isn't a port; a whole number, 0 (any free one) to 65535"), "default": 0}
seed = whole_number(0, _LARGEST_SEED, f"isn't a seed; a whole number, 0 to {_LARGEST_SEED}")


def two_numbers(text: str, between: str = ":") -> tuple[float, float] | None:
    """Both of them; None for another text."""
    try:
        first, second = map(float, text.split(between))
    except ValueError:
        return None
    return first, second


def arm_noise(text: str) -> tuple[float, float]:
    """An argument M:RAD, standard deviations of an arm's poses."""
    sigmas = two_numbers(text)
    if sigmas is None or not (0.0 <= sigmas[0] < 0.1 and 0.0 <= sigmas[1] < 0.5):
        raise argparse.ArgumentTypeError(f"'{text}' isn't an arm's noise M:RAD; metres, radians, e.g. 0.0001:0.0002")
    return sigmas


def note(lines: Iterable[str]) -> None:
    """Tell a person on stderr, beside the results."""
    for line in lines:
        print(line, file=sys.stderr)


def announcer(verb: str) -> Callable[[str], None]:
    """What tells a person where the page is."""
    key = "its address is the key to it: keep it to yourself; Ctrl-C, or Done on the page, ends it"
    return lambda url: print(f"{verb} on this page: {url}\n{key}", flush=True)


def make_directory(path: Path, option: str = "--out") -> Path:
    """Create a directory for output, which ``option`` names."""
    from gripmon.model.atomic import writable_folder

    try:
        return writable_folder(path)
    except InputError as error:
        raise InputError(f"{option} {error.wrong}") from None


def check_file(path: Path) -> None:
    """Refuse, before any work, a file that can't be written; it is made but not changed."""
    with writing(path):
        path.open("ab").close()


@contextmanager
def input_errors(what: str) -> Iterator[None]:
    """A ValueError is wrong usage, of ``what``; one that says so itself stays as it is."""
    try:
        yield
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{what}: {error}") from None


@contextmanager
def writing(path: Path, option: str = "--out") -> Iterator[None]:
    """A fault of a file for output ends the command with exit code 2."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{option} {path}: can't be written ({error.strerror or error}); a file") from None


@contextmanager
def progress_bar(total: int | None, unit: str) -> Iterator[Callable[..., None]]:
    """A context that gives a function to call once for each step, with the total if that is known then; it draws on
    stderr, and only for a person.
    """
    with _bar(total=total, unit=unit) as bar:

        def step(total: int | None = None) -> None:
            if bar is not None:
                bar.total = total or bar.total
                bar.update()

        yield step


@contextmanager
def reading_bar() -> Iterator[Callable[[int, int], None]]:
    """The same of bytes: the function takes those that are read and all."""
    with _bar(unit="B", unit_scale=True, desc="reading", leave=False) as bar:

        def reached(done: int, total: int) -> None:
            if bar is not None:
                bar.total = total
                bar.update(done - bar.n)

        yield reached


def _bar(**shown: Any) -> AbstractContextManager[Any]:
    if not sys.stderr.isatty():
        return nullcontext()
    from tqdm import tqdm

    return cast(AbstractContextManager[Any], tqdm(file=sys.stderr, dynamic_ncols=True, **shown))


def messages_above_bar(logger: str) -> AbstractContextManager[object]:
    """While it lasts, what this logger writes to a terminal appears above the progress bar."""
    if not sys.stderr.isatty():
        return nullcontext()
    import logging

    from tqdm.contrib.logging import logging_redirect_tqdm

    return cast(AbstractContextManager[object], logging_redirect_tqdm([logging.getLogger(logger)]))
