"""Tables of text, row by row, by their columns' names."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from pathlib import Path

from gripmon.model.errors import InputError


def csv_rows(
    path: Path, right: str, what: str = "row", needed: Sequence[str] = ()
) -> Iterator[tuple[str, dict[str, str]]]:
    """The place in a CSV file, for messages, and the values by column of each of its rows.  ``right``: what kind of
    table it should be; ``what``: what a row of it is; ``needed``: columns that stand in it once.
    :class:`~gripmon.model.errors.InputError` for anything else, and for a table without a row.
    """
    reader = csv.DictReader(io.StringIO(read_text(path, right), newline=""), skipinitialspace=True)
    place = ""
    try:
        header = [name.strip() for name in reader.fieldnames or ()]
        _refuse_columns(path, header, right, needed)
        for row in reader:
            place = f"line {reader.line_num}"
            values = [*row.values()]
            if None in row or None in values:
                count = len(header) + len(row.get(None, ())) - values.count(None)
                raise InputError(f"{path}: {place} has {count} values; {len(header)}, as the first line")
            yield place, {name.strip(): value.strip() for name, value in row.items()}
    except csv.Error as error:
        raise InputError(f"{path}: line {reader.line_num}: {error} (an open quote?); {right}") from None
    if not place:
        raise InputError(f"{path}: holds no {what}; a header line, then a line for each")


def _refuse_columns(path: Path, header: list[str], right: str, needed: Sequence[str]) -> None:
    separator = next((sign for sign in ";\t" if len(header) == 1 and sign in header[0]), None)
    if separator is not None:
        shown = {";": "semicolons", "\t": "tabs"}[separator]
        raise InputError(f"{path}: columns are separated by {shown}; commas, and points in numbers")
    for name in needed:
        if (count := header.count(name)) != 1:
            raise InputError(f"{path}: has {'several columns' if count else 'no column'} {name}; {right}")


def read_text(path: Path, right: str) -> str:
    """A file's text; ``right``: what kind of file it should be.  :class:`~gripmon.model.errors.InputError`."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file; {right}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not text; {right}") from None
    except OSError as error:
        raise InputError(f"{path}: can't be read ({error.strerror}); {right}") from None
