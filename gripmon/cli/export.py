"""``gripmon export``: recordings as Parquet."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from gripmon.cli import common
from gripmon.cli.report import ReadingBar

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
    from gripmon.record.export import export
    from gripmon.record.read import recording_files

    recording_files([Path(name) for name in arguments.recordings])  # before a folder is made
    out = common.make_directory(Path(arguments.out))
    with ReadingBar() as progress:
        done = export(arguments.recordings, out, progress=progress)
    for fault in done.faults:
        print(f"export: {fault}", file=sys.stderr)
    rows = ", ".join(f"{table} {count}" for table, count in done.rows.items() if count)
    print(f"{out}: {rows or 'no rows yet'}, from {done.files} file{'s' * (done.files != 1)}")
    return common.EXIT_DONE
