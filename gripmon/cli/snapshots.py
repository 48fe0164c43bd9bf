"""Snapshots as numbered files that other commands read, with a table of stamps and jaw openings."""

from __future__ import annotations

import re
from pathlib import Path

from gripmon.io.sources import SourceError
from gripmon.io.sources.files import COLUMNS, TIMESTAMPS_NAME, TableRow, read_table, table_of
from gripmon.model.atomic import write_atomically
from gripmon.model.errors import InputError
from gripmon.model.records import CommandReply, to_json

_SUFFIXES = {"png": ".png", "jpeg": ".jpg"}  # names received from the network must not become paths
_NUMBERED = re.compile(r"snapshot-([0-9]{1,9})\.(json|png|jpg)")


def check_table(out: Path) -> None:
    """Raises :class:`InputError` if no row can be added to the table in a folder."""
    path = out / TIMESTAMPS_NAME
    if not path.exists():
        return
    try:
        read_table(path)
    except SourceError as error:
        raise InputError(f"{out}: {error}", "out") from None
    header = path.read_text(encoding="utf-8-sig").partition("\n")[0]
    if tuple(cell.strip() for cell in header.split(",")) != COLUMNS:
        raise InputError(f"{out}: {path} has no column {COLUMNS[-1]}; another folder", "out")


def write(reply: CommandReply, image: bytes | None, out: Path) -> list[Path]:
    """``snapshot-<n>.png``, ``snapshot-<n>.json`` and a row in ``timestamps.csv``, as a source of kind ``folder`` and
    ``gripmon teach`` read them; n continues the numbers in the folder.  Each file is written whole or not at all.
    Raises :class:`InputError` if one can't be written.
    """
    number = 1 + max((int(found[1]) for p in out.iterdir() if (found := _NUMBERED.fullmatch(p.name))), default=0)
    files = {out / f"snapshot-{number}.json": to_json(reply) + b"\n"}
    snapshot = reply.snapshot
    suffix = None if snapshot is None or snapshot.image is None else _SUFFIXES.get(snapshot.image.encoding)
    try:
        if image is not None and snapshot is not None and suffix is not None:
            path, table, jaw_m = out / f"snapshot-{number}{suffix}", out / TIMESTAMPS_NAME, snapshot.jaw_reported_m
            # An opening below zero is a closed jaw with a small error, which a table can't have.
            jaw_m = jaw_m if jaw_m is not None and 0.0 <= jaw_m <= 1.0 else None
            row = TableRow(max(snapshot.record.stamp_ns, 0), jaw_m)
            rows = read_table(table) if table.exists() else {}
            # Written last, since it names the image.
            files = {path: image} | files | {table: table_of({**rows, path.name: row})}
        for path, data in files.items():
            write_atomically(path, data)
    except OSError as error:
        raise InputError(f"{path}: can't be written ({error.strerror or error}); a file", "out") from None
    return list(files)
