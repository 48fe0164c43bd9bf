"""The errors that public functions raise for what a user can fix.

``str()`` of either is one line: what (a file, a key, an option), what is wrong with it, what would be right.  The
command line prints that line and exits with the exit code.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager


class InputError(ValueError):
    """An input is wrong: a file, a table, a value.  The command line exits with this exit code.

    ``argument``: the function's argument that is wrong, if the text doesn't name it; the command line puts the option
    of that name in front.
    """

    exit_code = 2
    argument = ""

    def __init__(self, text: str, argument: str = "") -> None:
        super().__init__(f"{argument}: {text}" if argument else text)
        self.wrong, self.argument = text, argument or self.argument


class NoResultError(RuntimeError):
    """The input is sound, but there is no result: no usable frame, or a calibration that is rejected.

    ``details``: what doesn't fit into the line; the command line prints them before it, a line each.
    """

    exit_code = 3

    def __init__(self, text: str = "", details: Sequence[str] | None = None) -> None:
        super().__init__(text)
        self.details = None if details is None else tuple(details)


@contextmanager
def input_errors(what: str) -> Iterator[None]:
    """A ValueError in it is an :class:`InputError` about ``what``; an InputError stays as it is."""
    try:
        yield
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{what}: {error}") from None


def one_line(error: BaseException) -> str:
    """The message of another library's exception in one line; its type if it has no message."""
    return " ".join(str(error).split()) or type(error).__name__


def in_short(error: BaseException) -> str:
    """Any unexpected exception in one line for a person, with its type."""
    return f"{type(error).__name__}: {one_line(error)}" if str(error).strip() else type(error).__name__
