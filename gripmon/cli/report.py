"""``gripmon report``: after a failed shift, what moved, when, how far, why, and what is affected."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gripmon.cli import common
from gripmon.model.errors import InputError

_DESCRIPTION = """\
Says what happened in recordings: when the camera moved, how far the tool centre point (TCP) went
with it, what did it, whether it is still so, and which times are affected. The answer in one
paragraph is printed; FILE.html shows it with plots, pictures and tables, in one file that needs no
network. Recordings of several runs and robots go on one time axis."""

_EXAMPLES = """\
  gripmon demo --out demo && gripmon report demo/*.rrd --out demo/report.html
  gripmon report recordings/ --limit-mm 0.5      what is off by less than 0.5 mm doesn't matter
  gripmon report recordings/ --json - | jq .recordings[].affected

exit codes: 0 done, if only a part could be used, too (stderr says which); 2 wrong usage, no such file,
or no recording; 3 nothing in them can be used; 130 interrupted"""

_DEFAULT_PAGE = "report.html"


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = common.add_command(
        commands, "report", run, "what happened: when did the camera move, what is affected", _DESCRIPTION, _EXAMPLES
    )
    parser.add_argument(
        "recordings",
        nargs="+",
        metavar="RECORDING",
        help=".rrd files, folders of them with all below, or estimates.jsonl",
    )
    parser.add_argument(
        "--out", metavar="FILE.html", help=f"the page (default: {_DEFAULT_PAGE}; none if there is only --json)"
    )
    parser.add_argument("--json", metavar="FILE", help="the same as data (SI units); - for stdout")
    parser.add_argument(
        "--limit-mm",
        type=common.positive_number,
        metavar="MM",
        help="a calibration that is off by more at the TCP counts as affected (mm; default: what the recording's "
        "configuration calls worth a warning, monitor.policy.warn_m)",
    )
    parser.add_argument(
        "--limit-deg", type=common.positive_number, metavar="DEG", help="likewise for its turn (degrees; warn_rad)"
    )


def run(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon report``."""
    page_path = _page_path(arguments)
    json_path = None if arguments.json in (None, "-") else Path(arguments.json)
    for path, option in ((page_path, "--out"), (json_path, "--json")):
        _check_folder(path, option)
    from gripmon.analyse.api import report
    from gripmon.model.atomic import write_atomically

    millimetres, degrees = arguments.limit_mm, arguments.limit_deg
    with ReadingBar() as progress:
        found = report(
            arguments.recordings,
            limit_m=None if millimetres is None else 1e-3 * millimetres,
            limit_rad=None if degrees is None else math.radians(degrees),
            progress=progress,
        )
    for fault in found.faults:
        print(f"report: {fault}", file=sys.stderr)
    if arguments.json == "-":
        print(found.json().decode())
    elif json_path is not None:
        _write(write_atomically, json_path, found.json() + b"\n", "--json")
    if page_path is not None:
        with common.progress_bar(len(found.analysed), "recording") as step:
            data = found.html(step)
        _write(write_atomically, page_path, data, "--out")
    if arguments.json != "-":
        print(found.report.summary)
        print("\n".join(f"written: {path}" for path in (page_path, json_path) if path is not None))
    return common.EXIT_DONE


def _page_path(arguments: argparse.Namespace) -> Path | None:
    if arguments.out is None:
        return Path(_DEFAULT_PAGE) if arguments.json is None else None
    return Path(arguments.out)


def _check_folder(path: Path | None, option: str) -> None:
    """Before any work; the file itself stays as it is until the new one is whole."""
    if path is None:
        return
    if path.is_dir():
        raise InputError(f"{option} {path}: is a folder; a file")
    common.make_directory(path.parent, option)


def _write(write: Any, path: Path, data: bytes, option: str) -> None:
    try:
        write(path, data)
    except OSError as error:
        raise common.not_writable(path, error, option) from None


class ReadingBar:
    """A progress bar on stderr of the bytes that are read, for a person; its context gives the function to call."""

    def __enter__(self) -> Callable[[int, int], None]:
        if not sys.stderr.isatty():
            return lambda _done, _total: None
        from tqdm import tqdm

        self._bar = tqdm(unit="B", unit_scale=True, file=sys.stderr, dynamic_ncols=True, desc="reading", leave=False)
        return self._show

    def __exit__(self, *_exception: object) -> None:
        if hasattr(self, "_bar"):
            self._bar.close()

    def _show(self, done: int, total: int) -> None:
        self._bar.total = total
        self._bar.update(done - self._bar.n)
