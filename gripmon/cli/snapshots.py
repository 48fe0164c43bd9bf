"""Snapshots as numbered files that other commands read, with a table of stamps and jaw openings."""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path

from gripmon.io.sources import SourceError
from gripmon.io.sources.files import COLUMNS, TIMESTAMPS_NAME, read_table
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
            path, table = out / f"snapshot-{number}{suffix}", out / TIMESTAMPS_NAME
            files = {path: image} | files
            # Written last, since it names the image.
            files[table] = _with_row(table, path.name, snapshot.record.stamp_ns, snapshot.jaw_reported_m)
        for path, data in files.items():
            write_atomically(path, data)
    except OSError as error:
        raise InputError(f"{path}: can't be written ({error.strerror or error}); a file", "out") from None
    return list(files)


def _with_row(table: Path, name: str, stamp_ns: int, jaw_m: float | None) -> bytes:
    text = io.StringIO()
    lines = csv.writer(text, lineterminator="\n")
    before = table.read_text(encoding="utf-8-sig") if table.exists() else ",".join(COLUMNS)
    # An opening below zero is a closed jaw with a small error, which a table can't have.
    lines.writerow((name, max(stamp_ns, 0), repr(jaw_m) if jaw_m is not None and 0.0 <= jaw_m <= 1.0 else ""))
    return f"{before.rstrip()}\n{text.getvalue()}".encode()
