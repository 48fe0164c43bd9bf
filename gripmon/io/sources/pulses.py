"""A table of a laser's pulses, beside recorded frames."""

from __future__ import annotations

import csv
from pathlib import Path

from gripmon.io.sources.base import SourceError
from gripmon.laser.matching import Told, of_rows

COLUMNS = "stamp_ns,until_ns,tx_m,ty_m,tz_m,qx,qy,qz,qw"


def read_pulses(path: Path) -> list[Told]:
    """The pulses of a table (CSV with a header), by their stamps; poses as in the tables of ``calibrate laser``.

    Raises :class:`SourceError`: "file: line: what is wrong; what would be right".
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise SourceError(f"there is no file {path}; a table {COLUMNS}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"{path}: can't be read ({error}); a table in UTF-8") from None
    reader = csv.DictReader(text.splitlines(), skipinitialspace=True)
    try:
        return _of_table(path, reader)
    except csv.Error as error:
        raise SourceError(f"{path}: line {reader.line_num}: {error} (an open quote?); {COLUMNS}") from None


def _of_table(path: Path, reader: csv.DictReader[str]) -> list[Told]:
    rows, places = [], []
    for row in reader:
        if None in row or None in row.values():
            count = len(reader.fieldnames or ())
            raise SourceError(
                f"{path}: line {reader.line_num} has another number of fields than the header; {count}: {COLUMNS}"
            )
        rows.append({str(key).strip(): value.strip() for key, value in row.items()})
        places.append(f"line {reader.line_num}")
    try:
        return of_rows(rows, places)
    except ValueError as error:
        raise SourceError(f"{path}: {error}") from None
