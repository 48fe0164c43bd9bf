"""What the functions that a program calls raise for what a person can mend.

``str()`` of either is one line: what (a file, a key, an option), what is wrong with it, what would be right.  The
command line prints that line and ends with the exit code.
"""

from __future__ import annotations


class InputError(ValueError):
    """What was given is wrong: a file, a table, a value.  The command line ends with this exit code.

    ``argument``: the function's argument that is wrong, where the text doesn't name it; the command line puts the
    option of that name in front.
    """

    exit_code = 2
    argument = ""

    def __init__(self, text: str, argument: str = "") -> None:
        super().__init__(f"{argument}: {text}" if argument else text)
        self.wrong, self.argument = text, argument or self.argument


class NoResultError(RuntimeError):
    """The input is sound, and yet there is no result: no usable frame, a calibration that is refused."""

    exit_code = 3


def one_line(error: BaseException) -> str:
    """What an exception of another library says, in one line; its type where it says nothing."""
    return " ".join(str(error).split()) or type(error).__name__


def in_short(error: BaseException) -> str:
    """Any exception in one line for a person, with its type: for what no one has foreseen."""
    return f"{type(error).__name__}: {one_line(error)}" if str(error).strip() else type(error).__name__
