"""``gripmon replay``: recorded frames through the daemon's core, one JSON line per frame."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from gripmon.cli.common import REQUIRED, Arguments, Command, note, positive_number, progress_bar, whole_number, writing
from gripmon.model.errors import NoResultError
from gripmon.model.stopping import EXIT_DONE, EXIT_FAILED

_OPTIONS = """
INPUT...              a folder of images, in the order of their names, a video file, or a gripmon recording: an .rrd
                      file, all files of one run, or a folder of them (searched recursively); an .mcap file, a rosbag2
                      folder or a LeRobot dataset; a folder of images may contain a timestamps.csv with the columns
                      file,stamp_ns[,jaw_opening_m] (Unix ns, m)
--config CONFIG       configuration (YAML); its source section is used only for the camera and opening of an .mcap, a
                      rosbag2 or a LeRobot dataset; without it a recording's own configuration is used
--out FILE            file for the JSON lines; - is standard output
--recording FILE.rrd  also write a rerun recording (open it with: gripmon view FILE.rrd); for a recording it shows both
                      runs, recorded and replayed
--camera NAME         which images: topic of an .mcap or rosbag2, feature of a LeRobot dataset (default: the only one)
--episode N           which episode of a LeRobot dataset (default: the only one)
--fps HZ              frames per second if the input has no time stamps (1/s)
"""

_EXAMPLES = """\
  gripmon replay images/ --config configs/folder.yaml --out estimates.jsonl
  gripmon replay wrist.mp4 --config configs/live_camera.yaml --out - | head -1
  gripmon replay images/ --config configs/folder.yaml --out estimates.jsonl --recording story.rrd

  gripmon replay recordings/ --out again.jsonl                             all files of one run
  gripmon replay set/ --episode 12 --config wrist.yaml --out 12.jsonl      of a LeRobot dataset
  gripmon replay shift-0001.rrd --config tighter.yaml --out - --recording both.rrd > would_be.jsonl

exit codes: 0 done; 2 wrong usage or configuration; 3 no frame could be used, or writing failed (an
existing FILE.rrd is kept then); 130 interrupted (FILE has the lines so far)"""


@Command(
    _OPTIONS, _EXAMPLES, out=REQUIRED,
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
            finally:
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
        with writing(path):
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
