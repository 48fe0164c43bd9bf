"""What the functions that a program calls raise for what a person can mend.

``str()`` of either is one line: what (a file, a key, an option), what is wrong with it, what would be right.  The
command line prints that line and ends with the exit code.
"""

from __future__ import annotations


class InputError(ValueError):
    """What was given is wrong: a file, a table, a value.  The command line ends with this exit code."""

    exit_code = 2


class NoResultError(RuntimeError):
    """The input is sound, and yet there is no result: no usable frame, a calibration that is refused."""

    exit_code = 3
