"""Commands on recordings: ``gripmon report``, ``export``, ``correct`` and ``view``."""

from __future__ import annotations

import threading
from contextlib import ExitStack
from pathlib import Path

from gripmon.cli.common import (
    REQUIRED,
    Arguments,
    Command,
    make_directory,
    note,
    port,
    positive_number,
    progress_bar,
    reading_bar,
)
from gripmon.model.errors import InputError, NoResultError
from gripmon.model.stopping import EXIT_DONE, EXIT_FAILED, signals_exit

_REPORT_OPTIONS = """
RECORDING...     .rrd files, folders of them (searched recursively), or estimates.jsonl
--out FILE.html  the page (default: report.html; none with --json alone)
--json FILE      the same as data (SI units); - for stdout
--limit-mm MM    offset of the TCP above which a calibration counts as affected (mm; default: the recorded
                 configuration's limit for a warning, monitor.policy.warn_m)
--limit-deg DEG  the same for the rotation (degrees; warn_rad)
"""

_REPORT_EXAMPLES = """\
  gripmon demo --out demo && gripmon report demo/*.rrd --out demo/report.html
  gripmon report recordings/ --limit-mm 0.5      offsets below 0.5 mm don't matter
  gripmon report recordings/ --json - | jq .recordings[].affected

exit codes: 0 done, also if only a part could be used (stderr says which); 2 wrong usage, no such file,
or no recording; 3 nothing in them can be used; 130 interrupted"""

_EXPORT_OPTIONS = """
RECORDING...  recordings (.rrd), folders of them (searched recursively), or estimates.jsonl
--out DIR     folder for the tables; created if missing
"""

_EXPORT_EXAMPLES = """\
  gripmon export recordings/ --out fleet
  gripmon export recordings/arm1-*.rrd recordings/arm2-*.rrd --out fleet

exit codes: 0 done, also if a part of a recording could not be used (one line each on stderr);
2 wrong usage; 3 nothing in it could be used, or the folder could not be written"""

_CORRECT_OPTIONS = """
RECORDING...       recordings (.rrd), folders of them (searched recursively), or estimates.jsonl
--out FILE         FILE.jsonl, FILE.parquet or FILE.rrd
--stamps FILE.csv  give the transform at these capture times instead of the frames': a column stamp_ns (Unix ns)
"""

_CORRECT_EXAMPLES = """\
  gripmon correct recordings/arm1-0001.rrd --out corrected.jsonl
  gripmon correct recordings/ --out corrected.parquet
  gripmon correct estimates.jsonl --out corrected.jsonl --stamps shots.csv

exit codes: 0 done; 2 wrong usage; 3 nothing measured in the recordings; 130 interrupted"""

_VIEW_OPTIONS = """
RECORDING...  .rrd files, or folders of them (searched recursively)
--web         as a page; the default without a display
| --native    in a window; the default with a display
--port N      TCP port of the page (default 9090, or another if that is in use)
"""

_VIEW_EXAMPLES = """\
  gripmon view recordings/
  gripmon view arm1-wrist-20260101T060000Z-000*.rrd --web
  gripmon view shift.rrd --web --port 9091

To view the page on another machine: ssh -L, for the page's port and the data port in its address.

exit codes: 0 the window was closed; 2 wrong usage or no such recording; 3 no viewer could be started;
130 Ctrl-C"""

_PORT = 9090
_TO_STDOUT = Path("-")


@Command(
    _REPORT_OPTIONS, _REPORT_EXAMPLES,
    limit_mm=positive_number, limit_deg=positive_number,
)  # fmt: skip
def report(arguments: Arguments) -> None:
    """Report what happened in recordings: when the camera moved, how far the tool centre point (TCP) moved
    with it, the cause, whether it has returned, and which times are affected. One paragraph is printed;
    FILE.html adds plots, pictures and tables, in one file that needs no network. Recordings of several
    runs and robots are shown on one time axis.
    """
    data_path, to_stdout = arguments.json, arguments.json == _TO_STDOUT
    if arguments.out is None and data_path is None:
        arguments.out = Path("report.html")
    arguments.check_outputs("out", *(() if to_stdout else ("json",)))
    from gripmon.analyse.api import report

    limits = {"limit_m": arguments.metres("limit_mm"), "limit_rad": arguments.radians("limit_deg")}
    with reading_bar() as progress:
        found = report(arguments.recording, **limits, progress=progress)
    note(f"report: {fault}" for fault in found.faults)
    if to_stdout:
        print(found.json().decode())
    elif data_path is not None:
        arguments.save("json", found.json() + b"\n")
    if arguments.out is not None:
        with progress_bar(len(found.analysed), "recording") as step:
            data = found.html(step)
        arguments.save("out", data)
    if not to_stdout:
        print(found.report.summary)
        print("\n".join(f"written: {path}" for path in (arguments.out, data_path) if path is not None))


@Command(_EXPORT_OPTIONS, _EXPORT_EXAMPLES, out=REQUIRED)
def export(arguments: Arguments) -> None:
    """Write recordings as Parquet, partitioned by robot, camera and day (UTC), so that any query engine can
    evaluate months of a whole fleet:

      DIR/frames/robot=arm1/camera=wrist/date=2026-03-14/RUN-0000.parquet

    and likewise alerts, states and commands; references by robot and camera.  Columns, units and one
    query each for DuckDB and Polars: docs/howto/export.md.  Exporting a file again replaces its rows; this
    may be done every hour, also while the monitor writes.  Images stay in the recording.
    """
    from gripmon.record.export import export
    from gripmon.record.read import recording_files

    recording_files(arguments.recording)  # before a folder is made
    out = make_directory(arguments.out)
    with reading_bar() as progress:
        done = export(arguments.recording, out, progress=progress)
    note(f"export: {fault}" for fault in done.faults)
    rows = ", ".join(f"{table} {count}" for table, count in done.rows.items() if count)
    print(f"{out}: {rows or 'no rows yet'}, from {done.files} file{'s' * (done.files != 1)}")


@Command(
    _CORRECT_OPTIONS, _CORRECT_EXAMPLES,
    out=REQUIRED,
)  # fmt: skip
def correct(arguments: Arguments) -> None:
    """Estimate cam_T_grip for every frame of a recording again, from all frames before and after it: for
    data that was recorded with a stale calibration.  A step is not smoothed, and is localised to its
    frame.  FILE's suffix decides the format:

      .jsonl    one line about the recordings and the change points, then one line per frame
      .parquet  the same as a table, with units in the columns' names
      .rrd      a track of transforms that a viewer overlays on the recording (open both); several runs
                get a file each, FILE-1.rrd and so on

    Covariances include reported variance that averaging can't reduce.
    """
    if arguments.out.suffix.lower() == ".rrd" and arguments.stamps is not None:
        raise InputError("--stamps: a track in an .rrd has only its frames' times; .jsonl or .parquet")
    arguments.check_outputs("out")
    from gripmon.analyse.api import correct

    done = correct(arguments.recording, arguments.out, stamps=arguments.stamps, progress=progress_bar)
    note(f"correct: {fault}" for fault in done.faults)
    print("\n".join([*(run.summary() for run in done.runs), *(f"written: {path}" for path in done.written)]))


@Command(_VIEW_OPTIONS, _VIEW_EXAMPLES, port=port)
def view(arguments: Arguments) -> int:
    """Show recordings in rerun's viewer: in a window if there is a display, otherwise as a page for a browser
    on this machine, whose address is printed.  The files of one run appear as one recording.  The command
    ends with Ctrl-C, or when the window is closed, and leaves nothing running.
    """
    from gripmon.record.read import rrd_files
    from gripmon.record.viewer import NativeViewer, ViewerError, WebPage, free_port, has_display, is_free

    files = rrd_files(arguments.recording)
    if arguments.port is not None and not is_free(arguments.port):
        raise InputError(f"--port {arguments.port}: is in use on 127.0.0.1; another port, or none for any")
    try:
        with signals_exit(), ExitStack() as opened:
            if arguments.native or (has_display() and not arguments.web):
                viewer = NativeViewer([str(path) for path in files], tied=True)
                opened.callback(viewer.close)
                return EXIT_FAILED if viewer.wait() else EXIT_DONE
            page = WebPage(arguments.port or free_port(_PORT), [str(path) for path in files])
            opened.callback(page.close)
            print(f"{page.url}\n(stop with Ctrl-C)", flush=True)
            threading.Event().wait()
    except ViewerError as error:
        raise NoResultError(f"view: {error}") from None
    return EXIT_DONE
