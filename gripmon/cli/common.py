"""Shared by all commands: their declaration, the files that they write, progress bars.

No heavy imports at the top: this is imported for a command's ``--help``.
"""

from __future__ import annotations

import argparse
import inspect
import json
import math
import re
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any, TypeVar, cast

from gripmon.model.atomic import writable_folder, write_atomically, writing
from gripmon.model.errors import InputError
from gripmon.model.project import Part, file_of
from gripmon.model.units import jaw_opening_in, jaw_range_in

_T = TypeVar("_T")
REQUIRED = {"required": True}
DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"  # gripmon.io.wire's, which is too heavy for --help
NETWORK_OPTIONS = f"""
--connect ENDPOINT...  {{}} or a router's Zenoh endpoint; may be repeated; default: {DEFAULT_ENDPOINT}
--zenoh-config FILE    a Zenoh configuration file instead of --connect
"""
"""Options of the commands that join the network as a client; the placeholder says whose endpoint it is."""

RESPONSE_OPTION = """
--response          how grey levels follow the light: linear, srgb, or auto, as the images show it (default: auto)
"""
RESPONSE = {"choices": ("auto", "linear", "srgb"), "default": "auto"}
VIEW = {"nargs": "?", "const": "auto", "choices": ("auto", "web", "native", "server")}
VIEW_OPTION = """
--view  show it live in rerun's viewer, on this machine: native (a window), web (a page whose address is printed),
        auto (native if there is a display), or server (only the stream that viewers connect to)
"""
_PATHS = re.compile(r"FILE|DIR|CONFIG|CALIBRATION|DATA|IMAGE|INPUT|RECORDING|[A-Z]+\.yaml")
_PARTS: dict[str, Part] = {
    "camera": "camera", "lens": "camera", "gripper": "gripper", "reference": "reference", "config": "config",
}  # fmt: skip
"""Options that name a file of a project, for which its folder stands."""
_NUMBERS = {"": None, "...": "+", "[]": "?", "[...]": "*"}
_ENDINGS = {"picture": (".png", ".jpg", ".jpeg"), "report": (".html",), "recording": (".rrd",)}
_NEVER_READ = (".html", ".json")
"""Endings of what commands write and no command reads from a folder: there they replace the last one of its name."""
_LARGEST_SEED = 2**32 - 1
PORT_OPTIONS = """
--port N            port of the page (default: any free one)
--no-browser        print the page's address, but open no browser
"""


class Command:
    """A command's declaration, and the decorator of its function, whose docstring is the description in ``--help``.

    ``options`` is a table like that of ``--help``.  A row has the argument, two blanks or a new line, and its meaning,
    which continues in indented lines: ``NAME``, ``[NAME]``, ``NAME...``, ``[NAME...]`` for one argument, at most one,
    one or more, any number; ``--flag``, ``--option VALUE``, ``--option VALUE...`` for one that may be repeated.  A row
    that begins with ``|`` excludes the previous row.  ``groups``: further tables by title, each with a description.
    Values called FILE, DIR and the like are paths, those of :data:`_PARTS` also a project's folder.  ``more``:
    keywords of ``add_argument`` for single arguments, or only a type.
    """

    def __init__(
        self,
        options: str,
        examples: str,
        groups: Mapping[str, tuple[str | None, str]] | None = None,
        /,
        **more: Any,
    ) -> None:
        self._epilog = f"examples:\n{examples}"
        self._tables, self._more = {"": (None, options), **(groups or {})}, more
        self.arguments: dict[str, str] = {}  # by name: the option, empty for a positional one
        self.defaults: dict[str, Any] = {}
        self.prog = ""

    def __call__(self, handler: Callable[[Arguments], int | None]) -> Command:
        self._handler = handler
        return self

    def run(self, arguments: Arguments) -> int:
        """Run the command; return the exit code."""
        return self._handler(arguments) or 0

    def fill(self, parser: argparse.ArgumentParser) -> None:
        """Make a parser that of this command."""
        parser.description, parser.epilog = inspect.getdoc(self._handler), self._epilog
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
            part = _PARTS.get(name)
            keywords["type"] = Path if part is None else partial(file_of, part=part)
        if not option:
            keywords["nargs"] = _NUMBERS[re.sub(r"[^][.]", "", word.replace(metavar, ""))]
        elif value.endswith("..."):
            keywords["action"] = "append"
        elif not value and "choices" not in more:
            keywords["action"] = "store_true"
        group.add_argument(option or name, **(keywords | more))
        self.arguments[name], self.defaults[name] = option, more.get("default")


def _rows(table: str) -> list[tuple[str, str]]:
    """The arguments and their meanings."""
    rows: list[tuple[str, str]] = []
    for line in table.strip("\n").splitlines():
        typed, _, text = line.partition("  ")
        if not typed:
            typed, before = rows.pop()
            text = f"{before} {line.strip()}"
        rows.append((typed, text.strip()))
    return rows


class Arguments(argparse.Namespace):
    """The arguments of a command, with helpers; errors name a file or folder by its option."""

    def command_line(self, **instead: Any) -> str:
        """The command line, for a file's provenance; ``instead``: values that replace those given."""
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
        """Print the result: one JSON object with ``--json``, otherwise text lines."""
        print(json.dumps(values, indent=2) if self.json else "\n".join(lines))

    def metres(self, name: str) -> float | None:
        """The value of an option in millimetres, in metres; None if it wasn't given."""
        value_mm = getattr(self, name)
        return None if value_mm is None else 1e-3 * float(value_mm)

    def radians(self, name: str) -> float | None:
        """The value of an option in degrees, in radians; None if it wasn't given."""
        value_deg = getattr(self, name)
        return None if value_deg is None else math.radians(value_deg)

    def network(self) -> dict[str, Any]:
        """``--connect`` and ``--zenoh-config`` as arguments of the clients."""
        if self.connect and self.zenoh_config:
            raise InputError(f"{self.command.prog}: --connect has no effect beside --zenoh-config; one of them")
        file = None if self.zenoh_config is None else str(self.zenoh_config)
        return {"connect": self.connect or (DEFAULT_ENDPOINT,), "zenoh_config_file": file}

    @contextmanager
    def network_errors(self) -> Iterator[None]:
        """If there is no session, the error names the option instead of a configuration key."""
        from gripmon.io.wire import PublishError

        try:
            yield
        except PublishError as error:
            option = {"connect": "--connect", "zenoh_config": "--zenoh-config"}.get(error.key, error.key)
            raise InputError(f"{self.command.prog}: {option}: {error.text}") from None

    def check_outputs(self, *names: str, page: str = "") -> None:
        """Refuse, before any work, outputs that can't be written, exist (without --force), are given twice, or have an
        ending of something else; ``page``: the one that is an HTML page.
        """
        written: dict[Path, str] = {}
        for name in names:
            path, option = getattr(self, name), _option(name)
            if path is None:
                continue
            other = written.setdefault(path.resolve(), self._reading(path, names) or option)
            if other != option:
                raise InputError(f"{other} and {option}: both are {path}; different files")
            make_directory(path.parent, option)
            if path.is_dir():
                raise InputError(f"{option} {path}: is a folder; a file")
            if path.exists() and not getattr(self, "force", True):
                raise InputError(f"{option} {path}: is there already; another file, or --force to replace it")
            if path.exists() and path.suffix.lower() not in _NEVER_READ and self._in_folder(path):
                raise InputError(f"{option} {path}: is there already, in a folder that is read; another file")
            endings = _ENDINGS.get("report" if name == page else name, (path.suffix.lower(),))
            if path.suffix.lower() not in endings:
                raise InputError(f"{option} {path}: has no known ending; {' or '.join(endings[:2])}")

    def _reading(self, path: Path, written: Sequence[str]) -> str | None:
        """The option by which a file is an input, too; None with --force, which replaces it once it is read."""
        for name, option in self.command.arguments.items():
            value = getattr(self, name)
            for each in value if isinstance(value, list) else [value]:
                if isinstance(each, Path) and each.resolve() == path.resolve() and name not in written:
                    return None if hasattr(self, "force") else option or name.upper()
        return None

    def _in_folder(self, path: Path) -> bool:
        """Whether a file lies in a folder that is an input; not with --force."""
        given = [getattr(self, name) for name in self.command.arguments]
        inputs = [each for value in given for each in (value if isinstance(value, list) else [value])]
        folders = [each.resolve() for each in inputs if isinstance(each, Path) and each.is_dir()]
        return not hasattr(self, "force") and any(folder in path.resolve().parents for folder in folders)

    def save(self, name: str, content: Any) -> None:
        """Write a file atomically, if its option was given: bytes, a calibration as YAML, a picture in the format of
        the file's ending; or the result of a function that makes one of them.
        """
        path = getattr(self, name)
        if path is None:
            return
        made = content() if callable(content) else content
        with writing(f"{_option(name)} {path}"):
            if isinstance(made, bytes):
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


def length(text: str) -> tuple[float, float]:
    """An argument M:SIGMA, a length of a wrist camera's view and its standard deviation, m."""
    value, colon, sigma = text.partition(":")
    far = positive_number(value)
    if far > 2.0:
        raise argparse.ArgumentTypeError(f"{value} m is too far for a wrist camera (millimetres?); metres")
    if not colon:
        raise argparse.ArgumentTypeError(
            f"'{text}' has no standard deviation; M:SIGMA in metres, e.g. {text}:0.003 for 3 mm"
        )
    found = far, positive_number(sigma)
    if found[1] > 0.5 * found[0]:
        raise argparse.ArgumentTypeError(
            f"'{text}': the standard deviation is more than half of the length; a smaller one"
        )
    return found


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
    """The type of an argument within these bounds; ``wrong``: the error for any other text."""

    def convert(text: str) -> int:
        if not text.isdecimal() or not low <= int(text) <= high:
            raise argparse.ArgumentTypeError(f"'{text}' {wrong}")
        return int(text)

    return convert


port = whole_number(1, 65535, "isn't a TCP port; 1 to 65535")
PAGE_PORT = {"type": whole_number(0, 65535, "isn't a port; a whole number, 0 (any free one) to 65535"), "default": 0}
seed = whole_number(0, _LARGEST_SEED, f"isn't a seed; a whole number, 0 to {_LARGEST_SEED}")


def two_numbers(text: str, between: str = ":") -> tuple[float, float] | None:
    """Both numbers; None for any other text."""
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
    """Print notes on stderr, apart from the results."""
    for line in lines:
        print(line, file=sys.stderr)


def announcer(verb: str) -> Callable[[str], None]:
    """A function that prints the page's address."""
    key = "anyone with this address can use the page: keep it secret; Ctrl-C, or Done on the page, ends it"
    return lambda url: print(f"{verb} on this page: {url}\n{key}", flush=True)


def make_directory(path: Path, option: str = "--out") -> Path:
    """Create a directory for output, which ``option`` names."""
    try:
        return writable_folder(path)
    except InputError as error:
        raise InputError(f"{option} {error.wrong}") from None


def check_file(path: Path) -> None:
    """Refuse, before any work, a file that can't be written; it is created if missing, but not changed."""
    with writing(f"--out {path}"):
        path.open("ab").close()


@contextmanager
def progress_bar(total: int | None, unit: str) -> Iterator[Callable[..., None]]:
    """A context that yields a function to call once per step, with the total if that is known by then; it draws on
    stderr, and only on a terminal.
    """
    with _bar(total=total, unit=unit) as bar:

        def step(total: int | None = None) -> None:
            if bar is not None:
                bar.total = total or bar.total
                bar.update()

        yield step


@contextmanager
def reading_bar() -> Iterator[Callable[[int, int], None]]:
    """The same for bytes: the function takes the number read and the total."""
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
    """Within this context, the logger's messages on a terminal appear above the progress bar."""
    if not sys.stderr.isatty():
        return nullcontext()
    import logging

    from tqdm.contrib.logging import logging_redirect_tqdm

    return cast(AbstractContextManager[object], logging_redirect_tqdm([logging.getLogger(logger)]))
