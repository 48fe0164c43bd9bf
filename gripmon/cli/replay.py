"""``gripmon replay``: recorded frames through the same core as the daemon's, one JSON line a frame."""

from __future__ import annotations

import argparse
import contextlib
import math
import sys
from collections import Counter
from collections.abc import Iterator, Sized
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from gripmon.cli import common, second_run
from gripmon.model.errors import InputError, NoResultError

if TYPE_CHECKING:
    from gripmon.daemon.config import Config, SecondConfig
    from gripmon.io.sources import Source
    from gripmon.model.records import FrameRecord

_DESCRIPTION = """\
Run recorded frames through the monitor and write one JSON line for every input frame, in input
order, refused ones included.  The same input gives the same bytes, except for latency_ns.

A recording of gripmon's brings its own configuration, the state that the monitor began with and the
commands that it got: without --config the same core decides again what it decided then, to the byte
where every frame was recorded as PNG (image_format: png and an image rate of every frame), else
closely.  With another --config one sees what that would have done; --recording then shows both, named
recorded and replayed, in one picture.  How many frames were judged otherwise is said at the end.

With the configuration of a second camera (a section laser) INPUT is a folder or a video, its pulses
are those of the table laser.pulses, and every pulse gets a line."""

_EXAMPLES = """\
  gripmon replay images/ --config configs/folder.yaml --out estimates.jsonl
  gripmon replay wrist.mp4 --config configs/live_camera.yaml --out - | head -1
  gripmon replay images/ --config configs/folder.yaml --out estimates.jsonl --recording story.rrd

  gripmon replay recordings/ --out again.jsonl                             all files of one run
  gripmon replay pulses/images --config second.yaml --out spots.jsonl      a second camera's pulses
  gripmon replay shift-0001.rrd --config tighter.yaml --out - --recording both.rrd > would_be.jsonl

exit codes: 0 done; 2 wrong usage or configuration; 3 no frame could be used, or writing failed (a
FILE.rrd from before stays then); 130 interrupted (what was done until then is in FILE)"""


_LATENCY_BIN = 0.02  # natural logarithm


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = common.add_command(
        commands,
        "replay",
        run,
        "recorded images or a video through the monitor, JSON lines out",
        _DESCRIPTION,
        _EXAMPLES,
    )
    parser.add_argument(
        "input",
        nargs="+",
        metavar="INPUT",
        help="a folder of images, taken in the order of their names, a video file, or a recording of ours: an .rrd "
        "file, all files of one run, or a folder of them with all below; a timestamps.csv may lie beside images, with "
        "the columns file,stamp_ns[,jaw_opening_m] (Unix ns, m)",
    )
    parser.add_argument(
        "--config",
        metavar="CONFIG",
        help="configuration (YAML), its source section is not used; left out for a recording: its own",
    )
    parser.add_argument("--out", required=True, metavar="FILE", help="JSON lines go here; - is standard output")
    parser.add_argument(
        "--recording",
        metavar="FILE.rrd",
        help="also write a rerun recording (open it with: gripmon view FILE.rrd); of a recording it shows both runs, "
        "recorded and replayed",
    )
    parser.add_argument(
        "--fps",
        type=common.positive_number,
        metavar="HZ",
        help="frames a second where the input has no time stamps (1/s)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon replay``."""
    import cv2

    from gripmon.cli.recorded_run import RecordedRun, is_recording
    from gripmon.daemon.forecast import limits_warning
    from gripmon.daemon.one_recording import one_recording
    from gripmon.daemon.replaying import NOTHING_BEFORE, replay
    from gripmon.model.records import to_json

    cv2.setNumThreads(1)
    paths = [Path(name) for name in arguments.input]
    _refuse_empty_folder(paths)
    second = None if arguments.config is None else second_run.load(arguments.config, check_source=False)
    if second is not None:
        return _run_second(arguments, second)
    with contextlib.ExitStack() as opened:
        recorded = RecordedRun(paths, arguments.config, opened) if is_recording(paths) else None
        config = recorded.config if recorded else _given_config(paths[0], arguments.config)
        source = recorded.source if recorded else _open_input(paths[0], arguments.fps)
        opened.callback(source.close)
        out = opened.enter_context(_output(arguments.out))
        overlaid = recorded.compared_in(arguments.recording) if recorded and arguments.recording else None
        recorder = opened.enter_context(overlaid or one_recording(_recording_path(arguments.recording), config))
        if (text := limits_warning(config)) is not None:
            _say(text)
        counts = _Counts()
        try:
            step = opened.enter_context(
                common.progress_bar(len(source) if isinstance(source, Sized) else None, "frame")
            )
            for record in replay(source, config, recorder, recorded.past if recorded else NOTHING_BEFORE, _say):
                out.write(to_json(record) + b"\n")
                counts.add(record)
                if recorded:
                    recorded.compare(record)
                step()
        finally:
            print(counts.summary(), file=sys.stderr)
            if recorded:
                print(recorded.summary(), file=sys.stderr)
    return common.EXIT_DONE if counts.usable else common.EXIT_FAILED


def _run_second(arguments: argparse.Namespace, config: SecondConfig) -> int:
    """The pulses of a second camera, on recorded frames."""
    from gripmon.cli import second_replay
    from gripmon.cli.recorded_run import is_recording

    path = Path(arguments.input[0])
    wrong = ""
    if config.settings.laser.pulses is None:
        wrong = f"{config.path}: laser.pulses: is missing; a table of the recorded pulses"
    elif arguments.recording:
        wrong = "replay: --recording is for wrist cameras; gripmon run with source: {kind: folder} and --out records"
    elif len(arguments.input) > 1 or is_recording([path]):
        wrong = f"{path}: no input for a second camera's configuration; one folder of images, or one video"
    if wrong:
        raise InputError(wrong)
    config = second_run.with_pulses(config)
    with contextlib.ExitStack() as opened:
        source = _open_input(path, arguments.fps)
        opened.callback(source.close)
        out = opened.enter_context(_output(arguments.out))
        step = opened.enter_context(common.progress_bar(len(source) if isinstance(source, Sized) else None, "frame"))
        return second_replay.run(config, source, out.write, step)


def _refuse_empty_folder(paths: list[Path]) -> None:
    """Before anything else is asked for, which would not help."""
    from gripmon.io.sources.files import IMAGE_SUFFIXES, TIMESTAMPS_NAME
    from gripmon.record.read import recordings_below

    for path in paths:
        if not path.is_dir() or recordings_below(path) or (path / TIMESTAMPS_NAME).exists():
            continue
        try:
            images = any(entry.suffix.lower() in IMAGE_SUFFIXES for entry in path.iterdir())
        except OSError as error:
            raise InputError(f"{path}: can't be read ({error.strerror})") from None
        if not images:
            right = ".rrd files, or images such as *.png, *.jpg, *.tif, *.pgm"
            raise InputError(f"{path}: no recordings and no images in it; {right}")


def _given_config(path: Path, name: str | None) -> Config:
    if name is None:
        raise InputError(f"{path}: only a recording brings its own configuration; --config CONFIG")
    return common.load(name, check_source=False)


class _Counts:
    """What became of the frames, in memory that does not grow with them."""

    def __init__(self) -> None:
        self.frames = 0
        self.usable = 0
        self._verdicts: Counter[str] = Counter()
        self._reasons: Counter[str] = Counter()  # why nothing was measured, by what comes before the colon
        self._first_failure = ""
        self._latencies: Counter[int] = Counter()  # logarithmic bins

    def add(self, record: FrameRecord) -> None:
        from gripmon.model.records import Origin

        self.frames += 1
        self.usable += record.source is not Origin.HELD
        self._verdicts[record.verdict] += 1
        if record.reason and not record.measured:
            kind = record.reason.partition(":")[0]
            self._reasons[kind] += 1
            if kind == "internal error":
                self._first_failure = self._first_failure or record.reason
        self._latencies[round(math.log(max(record.latency_ns, 1)) / _LATENCY_BIN)] += 1

    def summary(self) -> str:
        if not self.frames:
            return "replay: no frames: nothing in the input can be read as an image"
        verdicts = ", ".join(f"{count} {verdict}" for verdict, count in self._verdicts.most_common())
        text = f"replay: {self.frames} frames: {verdicts}; median {self._median_ms():.2f} ms a frame"
        if self._first_failure:
            text += f"; {self._reasons['internal error']} failed ({self._first_failure})"
        if not self.usable:
            reason = max(self._reasons, key=self._reasons.__getitem__, default="no measurement")
            text += f"; no frame could be used ({reason})"
        return text

    def _median_ms(self) -> float:
        """To one percent."""
        below = 0
        for index in sorted(self._latencies):
            below += self._latencies[index]
            if 2 * below > self.frames:
                return 1e-6 * math.exp(index * _LATENCY_BIN)
        return math.nan


def _open_input(path: Path, fps: float | None) -> Source:
    from gripmon.io.sources import SourceError, open_source, settings_for_path

    if not path.exists():
        raise InputError(f"{path}: there is no such file or folder; a folder of images, a video or an .rrd")
    try:
        return open_source(settings_for_path(path, fps))
    except SourceError as error:
        raise InputError(f"{path}: {error}") from None


def _say(text: str) -> None:
    print(f"replay: {text}", file=sys.stderr)


class _Lines:
    """A file whose faults end the command with one line and exit code 3."""

    def __init__(self, file: IO[bytes], name: str):
        self._file = file
        self._name = name

    def write(self, line: bytes) -> None:
        with self._said():
            self._file.write(line)

    def flush(self) -> None:
        with self._said():
            self._file.flush()

    @contextmanager
    def _said(self) -> Iterator[None]:
        try:
            yield
        except BrokenPipeError:
            raise  # a reader that has seen enough is no fault
        except OSError as error:
            raise NoResultError(f"--out {self._name}: writing failed ({error.strerror})") from None


@contextmanager
def _output(name: str) -> Iterator[_Lines]:
    if name == "-":
        lines = _Lines(sys.stdout.buffer, name)
        yield lines
        lines.flush()
        return
    path = Path(name)
    common.make_directory(path.parent)
    try:
        file = path.open("wb")
    except OSError as error:
        raise common.not_writable(path, error) from None
    lines = _Lines(file, name)
    try:
        yield lines
        lines.flush()
    finally:
        with contextlib.suppress(OSError):  # the same fault once more
            file.close()


def _recording_path(name: str | None) -> Path | None:
    if name is None:
        return None
    path = Path(name)
    if path.is_dir():
        raise InputError(f"--recording {path}: is a folder; a file")
    common.make_directory(path.parent, "--recording")
    return path
