"""``gripmon export``: recordings as Parquet."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import common

if TYPE_CHECKING:
    from gripmon.record.export import Exporter

_DESCRIPTION = """\
Write what recordings hold as Parquet, partitioned by robot, camera and day (UTC), so that months of
a whole fleet can be asked by any engine:

  DIR/frames/robot=arm1/camera=wrist/date=2026-03-14/RUN-0000.parquet

and likewise alerts, states and commands; references by robot and camera.  Columns, units and one
query each for DuckDB and Polars: docs/howto/export.md.  A file that is exported again replaces its rows;
it may be done every hour, also while the monitor writes.  Images stay in the recording."""

_EXAMPLES = """\
  gripmon export recordings/ --out fleet
  gripmon export recordings/arm1-*.rrd recordings/arm2-*.rrd --out fleet

exit codes: 0 done, also where a part of a recording could not be used (one line each on stderr);
2 wrong usage; 3 nothing in it could be used, or the folder could not be written"""

_MEGABYTE = 1_000_000
_FAULTS_SAID = 5  # in one line


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = common.add_command(
        commands, "export", run, "write recordings as Parquet, by robot and day", _DESCRIPTION, _EXAMPLES
    )
    parser.add_argument(
        "recordings",
        metavar="RECORDING",
        nargs="+",
        help="recordings (.rrd), folders of them with all below, or estimates.jsonl",
    )
    parser.add_argument("--out", required=True, metavar="DIR", help="where the tables go; made if it is missing")


def run(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon export``."""
    files = _files([Path(text) for text in arguments.recordings])
    out = common.make_directory(Path(arguments.out))
    from gripmon.record.export import SCHEMAS, Exporter

    exporter = Exporter(out)
    faults = _export(exporter, files)
    if not exporter.parts:
        more = f"; and {len(faults) - _FAULTS_SAID} more" if len(faults) > _FAULTS_SAID else ""
        raise common.CommandFailedError(f"export: {'; '.join(faults[:_FAULTS_SAID]) or 'nothing was recorded'}{more}")
    for fault in faults:
        print(f"export: {fault}", file=sys.stderr)
    rows = ", ".join(f"{table} {exporter.rows[table]}" for table in SCHEMAS if exporter.rows[table])
    print(f"{out}: {rows or 'no rows yet'}, from {_count(exporter.parts, 'file')}")
    return common.EXIT_DONE


def _files(paths: Sequence[Path]) -> list[Path]:
    """The files that are meant, each once; what isn't there ends the command."""
    from gripmon.record.read import recordings_below

    files: list[Path] = []
    for path in paths:
        found = recordings_below(path) if path.is_dir() else [path] * path.is_file()
        if not found:
            wrong = "no .rrd file in it" if path.is_dir() else "there is no such file"
            raise common.CommandFailedError(
                f"{path}: {wrong}; recordings of gripmon run, or their folder", common.EXIT_USAGE
            )
        files += found
    return list({file.resolve(): file for file in files}.values())


def _export(exporter: Exporter, files: Sequence[Path]) -> list[str]:
    """Export file by file, so that memory holds one of them; what could not be used, one line each."""
    from gripmon.record.read import open_recordings

    faults: list[str] = []
    sizes = [file.stat().st_size for file in files]
    with common.progress_bar(sum(sizes) // _MEGABYTE, "MB") as step:
        bar = _Megabytes(step)
        for file, size in zip(files, sizes, strict=True):
            found = open_recordings([file], bar.reach)
            bar.begin_behind(size)
            faults += found.faults
            for recording in found.recordings:
                faults += recording.file_faults
                try:
                    exporter.add(recording, file)
                except OSError as error:
                    reason = error.strerror or error
                    raise common.CommandFailedError(
                        f"{exporter.out}: can't be written ({reason}), at {file}; what stands there is whole"
                    ) from None
    return faults + exporter.faults


class _Megabytes:
    """Steps of a bar out of bytes behind, file after file."""

    def __init__(self, step: Callable[[], None]) -> None:
        self._step = step
        self._behind = 0
        self._drawn = 0

    def begin_behind(self, size: int) -> None:
        """A file of so many bytes is done."""
        self._behind += size

    def reach(self, done: int, _: int) -> None:
        """So much of the present file is done."""
        while self._drawn < (self._behind + done) // _MEGABYTE:
            self._drawn += 1
            self._step()


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"
