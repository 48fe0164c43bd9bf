"""Commands on what was recorded: ``gripmon report``, ``view``, ``replay``, ``correct``, ``export`` and ``dataset``."""

from __future__ import annotations

import argparse
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

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
    whole_number,
)
from gripmon.model.atomic import writing
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
2 wrong usage, or a folder that may not be written; 3 nothing in it could be used, or writing failed"""

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
    arguments.check_outputs("out", *(() if to_stdout else ("json",)), page="out")
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


_REPLAY_OPTIONS = """
INPUT...              a folder of images, in the order of their names, a video file, or a gripmon recording: an .rrd
                      file, all files of one run, or a folder of them (searched recursively); an .mcap or .bag file, a
                      rosbag2 folder or a LeRobot dataset; a folder of images may contain a timestamps.csv with the
                      columns file,stamp_ns[,jaw_opening_m] (Unix ns, m)
--config CONFIG       configuration (YAML); its source section is used only for the camera and opening of an .mcap, a
                      rosbag2 or a LeRobot dataset; without it a recording's own configuration is used
--out FILE            file for the JSON lines; - is standard output
--recording FILE.rrd  also write a rerun recording (open it with: gripmon view FILE.rrd); for a recording it shows both
                      runs, recorded and replayed
--camera NAME         which images: topic of an .mcap or rosbag2, feature of a LeRobot dataset (default: the only one)
--episode N           which episode of a LeRobot dataset (default: the only one)
--fps HZ              frames per second if the input has no time stamps (1/s)
"""

_REPLAY_EXAMPLES = """\
  gripmon replay images/ --config configs/folder.yaml --out estimates.jsonl
  gripmon replay wrist.mp4 --config configs/live_camera.yaml --out - | head -1
  gripmon replay images/ --config configs/folder.yaml --out estimates.jsonl --recording story.rrd

  gripmon replay recordings/ --out again.jsonl                             all files of one run
  gripmon replay set/ --episode 12 --config wrist.yaml --out 12.jsonl      of a LeRobot dataset
  gripmon replay shift-0001.rrd --config tighter.yaml --out - --recording both.rrd > would_be.jsonl

exit codes: 0 done; 2 wrong usage or configuration; 3 no frame could be used, or writing failed (an
existing FILE.rrd is kept then); 130 interrupted (FILE has the lines so far)"""


@Command(
    _REPLAY_OPTIONS, _REPLAY_EXAMPLES, out=REQUIRED,
    fps=positive_number, episode=whole_number(0, 10**9, "isn't an episode; its number, from 0"),
)  # fmt: skip
def replay(arguments: Arguments) -> int:
    """Run recorded frames through the monitor and write one JSON line for every input frame, in input
    order, refused ones included.  The same input gives the same bytes, except for latency_ns.

    A gripmon recording contains its configuration, the monitor's initial state and the commands received:
    without --config the replay reproduces the decisions, to the byte if every frame was recorded as PNG
    (image_format: png and image_every: 1), otherwise closely.  Another --config shows what it would have
    changed; --recording then shows both runs, recorded and replayed, in one view.  The last line reports
    how many frames were judged differently.

    """
    import cv2

    from gripmon.daemon.replaying import open_replay
    from gripmon.model.records import to_json

    cv2.setNumThreads(1)
    with open_replay(
        arguments.input, arguments.config, arguments.fps, _say, camera=arguments.camera, episode=arguments.episode
    ) as replayed:
        recording = replayed.recorded_in(arguments.recording)
        arguments.check_outputs("recording")
        with _output(arguments) as write, recording, progress_bar(replayed.length, "frame") as step:
            try:
                for record in replayed.records(step):
                    write(to_json(record) + b"\n")
            except NoResultError:
                raise  # a summary of what isn't written would say that there were no frames
            except BaseException:
                _say(*replayed.summary())
                raise
            _say(*replayed.summary())
        return EXIT_DONE if replayed.usable else EXIT_FAILED


def _say(*lines: str) -> None:
    note(f"replay: {line}" for line in lines)


@contextmanager
def _output(arguments: Arguments) -> Iterator[Callable[[bytes], None]]:
    """A function that writes a line; a fault ends the command with one line and exit code 3."""
    path: Path = arguments.out
    if path == Path("-"):
        file: Any = sys.stdout.buffer
    else:
        arguments.check_outputs("out")
        with writing(f"--out {path}"):
            file = path.open("wb")

    def put(act: Callable[..., object], *values: bytes) -> None:
        try:
            act(*values)
        except BrokenPipeError:
            raise  # a reader that closes the pipe isn't a fault
        except OSError as error:
            raise NoResultError(f"--out {path}: writing failed ({error.strerror})") from None

    try:
        yield lambda line: put(file.write, line)
        put(file.flush)
    finally:
        if file is not sys.stdout.buffer:
            with suppress(OSError):  # the same fault again
                file.close()


_DATASET_OPTIONS = """
DATASET          folder or URL; all episodes below it are measured
--config CONFIG  configuration (YAML) with gripper, camera and a rough reference; its source section gives the opening
--out DIR        folder for the results; created if missing
--camera NAME...  a topic of .mcap and rosbag2, a feature of LeRobot; may be repeated (default: the only one)
--own-lens       use the configuration's camera calibration even if a file contains one
--engine NAME    local (processes on this machine, the default) or ray (a Ray cluster)
--workers N      processes of --engine local (default: the number of cores)
--address HOST   address of the Ray cluster, as for ray.init (default: the one that Ray finds, or this machine)
--level P        probability that any stretch is separated from its mounting by chance (default 0.01)
--tolerance-mm MM    transforms within this and --tolerance-deg share a mounting, whatever their covariances (mm)
--tolerance-deg DEG  the same for the rotation (degrees)
"""

_DATASET_EXAMPLES = """\
  gripmon dataset set/ --config wrist.yaml --out extrinsics --camera observation.images.wrist
  gripmon dataset s3://lab/episodes --config wrist.yaml --out extrinsics --camera /wrist/image_raw/compressed
  gripmon dataset set/ --config wrist.yaml --out extrinsics --engine ray --address auto

exit codes: 0 done, failures are rows with a reason; 2 wrong usage or configuration; 3 no episode gave a
transform; 130 interrupted (call again to continue)"""


def _probability(text: str) -> float:
    value = positive_number(text)
    if value >= 1.0:
        raise argparse.ArgumentTypeError(f"{text} isn't a small probability; below 1")
    return value


@Command(
    _DATASET_OPTIONS, _DATASET_EXAMPLES,
    config=REQUIRED, out=REQUIRED, engine={"choices": ("local", "ray")},
    workers=whole_number(1, 4096, "isn't a number of processes; 1 or more"),
    level=_probability, tolerance_mm=positive_number, tolerance_deg=positive_number, dataset=str, address=str,
)  # fmt: skip
def dataset(arguments: Arguments) -> int:
    """Where was the wrist camera in each episode of a dataset?  For every episode and camera: cam_T_grip with
    its covariance and protection level, whether the camera moved within it (when, how far, why), which
    episodes share one mounting, and which fraction of the frames is usable.  DATASET is a folder or a URL
    (s3://bucket/folder) with LeRobot datasets, .mcap and .bag files, rosbag2 folders, folders of images or videos,
    and is never modified.  Below DIR:

      stretches/camera=NAME/part-0.parquet   a row for each stretch without motion, failures included
      report.html                            mountings over time, failures, the worst episodes
      episodes-…/                            a file for each measured episode: a new call measures only the rest
    """
    from gripmon.daemon.dataset import measure_dataset
    from gripmon.monitor import warm_up

    if (arguments.tolerance_mm is None) != (arguments.tolerance_deg is None):
        raise InputError("--tolerance-mm and --tolerance-deg belong together; both, or neither")
    warm_up()  # before all workers do
    with progress_bar(None, "episode") as step:
        found = measure_dataset(
            arguments.dataset,
            arguments.out,
            arguments.config,
            cameras=arguments.camera or (),
            lens="config" if arguments.own_lens else "file",
            engine=arguments.engine or "local",
            workers=arguments.workers,
            address=arguments.address,
            level=arguments.level or 0.01,
            tolerance_m=arguments.metres("tolerance_mm") or 0.0,
            tolerance_rad=arguments.radians("tolerance_deg") or 0.0,
            step=step,
        )
    good = found.episodes - found.failed
    counts = f"{found.episodes} episodes, {found.measured} measured now, {found.failed} without a transform"
    note([f"dataset: {counts}; {found.table}, {found.report}"])
    return EXIT_DONE if good else EXIT_FAILED
