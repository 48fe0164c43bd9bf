"""Replays images, a video or a recording through the monitor as the daemon drives it."""

from __future__ import annotations

import contextlib
import logging
import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence, Sized
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import msgspec

from gripmon.daemon.api import Monitor, open_source
from gripmon.daemon.config import Config, load_config
from gripmon.daemon.config.checks import reference_doubt
from gripmon.daemon.forecast import limits_warning
from gripmon.daemon.recorded_run import RecordedRun, one_recording
from gripmon.daemon.watch import is_refused
from gripmon.io.sources import (
    BagSettings,
    EpisodeSettings,
    FolderSettings,
    LeRobotSettings,
    Source,
    SourceError,
    VideoSettings,
    settings_for_path,
)
from gripmon.io.sources import open_source as start
from gripmon.io.sources.camera_info import lens_fault
from gripmon.io.sources.files import TIMESTAMPS_NAME
from gripmon.model.coverage import too_few
from gripmon.model.errors import InputError, in_short
from gripmon.model.images import IMAGE_SUFFIXES
from gripmon.model.records import (
    Command,
    Frame,
    FrameRecord,
    MonitorState,
    Origin,
    RecordedCommand,
    unmeasured_record,
)
from gripmon.monitor import warm_up
from gripmon.record.read import RecordedFrames, recordings_below
from gripmon.record.recorder import Recorder

_log = logging.getLogger(__name__)
_LATENCY_BIN = 0.02  # natural logarithm


class RecordedInputs(NamedTuple):
    """What affected a monitor besides its frames."""

    state: MonitorState | None = None
    """Its initial state; None: the configured reference."""
    commands: tuple[RecordedCommand, ...] = ()
    """In order; each came after the frame that it names."""


NOTHING_BEFORE = RecordedInputs()


def replay(
    source: str | Path | Source,
    config: Config,
    recorder: Recorder | None = None,
    past: RecordedInputs = NOTHING_BEFORE,
    warn: Callable[[str], None] = _log.warning,
) -> Iterator[FrameRecord]:
    """Process every frame of a source that isn't live: one record each, in order; the same input gives the same
    records, except for ``latency_ns``.

    ``source``: a folder of images or a video file, or the result of :func:`gripmon.open_source`, which the caller
    closes.  Searches and the cause analysis beside recorded frames count from the frames on that they counted from.
    ``recorder`` records the replay; ``past``: initial state and commands; ``warn`` is called with a line of text if
    something other than a frame is wrong.

    Raises :class:`SourceError` for a source that can't be read.  An unusable frame gives a record with a reason.
    """
    if isinstance(source, str | Path):
        with open_source(source) as opened:
            yield from replay(opened, config, recorder, past, warn)
        return
    recorder = Recorder() if recorder is None else recorder
    monitor = Monitor(config, past.state)
    waiting = deque(past.commands)
    revision = monitor.reference.revision
    ignored = False
    while (frame := source.read()) is not None:
        assert isinstance(frame, Frame), "only a live source waits"
        while waiting and waiting[0].seq < frame.seq:
            recorder.event(_repeated(monitor, waiting.popleft()))
        if not ignored and monitor.ignores_opening(frame):
            ignored = True
            warn("the frames have jaw openings, but jaw.source is fixed: they are not used")
        frame = monitor.with_opening(frame)
        # Where frames are missing, so may be the one in which a search's result counted.
        then = source.record if isinstance(source, RecordedFrames) and not source.frames_without_image else None
        start_ns = time.perf_counter_ns()
        try:
            record = monitor.process(frame, None if then is None else then.beside)
        except Exception as error:  # noqa: BLE001  reported in the record and in the summary
            record = unmeasured_record(frame, monitor.reference, f"internal error: {in_short(error)}")
        took_ns = time.perf_counter_ns() - start_ns
        record = msgspec.structs.replace(record, latency_ns=took_ns, beside=monitor.beside)
        if monitor.reference.revision != revision:
            revision = monitor.reference.revision
            recorder.event(monitor.reference)
        recorder.frame(frame, record, monitor.trace, monitor.notes)
        yield record


def _repeated(monitor: Monitor, then: RecordedCommand) -> RecordedCommand:
    """Repeat a recorded command at the same time; returns it with its result now."""
    try:
        answer = monitor.command(Command(then.name, then.argument), then.stamp_ns)
    except Exception as error:  # noqa: BLE001  like the daemon
        return msgspec.structs.replace(then, done=False, text=f"internal error: {in_short(error)}")
    return msgspec.structs.replace(then, done=answer.done, text=answer.text)


class Counts:
    """Statistics of the frames, in memory that doesn't grow with them."""

    def __init__(self) -> None:
        self.frames = 0
        self.usable = 0
        self._refused = 0
        self._verdicts: Counter[str] = Counter()
        self._reasons: Counter[str] = Counter()  # why nothing was measured, by the text before the colon
        self._examples: dict[str, str] = {}  # the first reason of each kind, whole
        self._latencies: Counter[int] = Counter()  # logarithmic bins

    def add(self, record: FrameRecord) -> None:
        """Count one frame."""
        self.frames += 1
        self.usable += record.source is not Origin.HELD
        self._refused += is_refused(record)
        self._verdicts[record.verdict] += 1
        if record.reason and not record.measured:
            kind = record.reason.partition(":")[0]
            self._reasons[kind] += 1
            self._examples.setdefault(kind, record.reason)
        self._latencies[round(math.log(max(record.latency_ns, 1)) / _LATENCY_BIN)] += 1

    def caution(self) -> list[str]:
        """A line that comes first, if too little was measured."""
        text = too_few(self.usable, refused=self._refused, unseen=self.frames - self.usable - self._refused)
        return [text] if text and self.usable else []

    def summary(self) -> str:
        """One line."""
        if not self.frames:
            return "no frames: nothing in the input can be read as an image"
        verdicts = ", ".join(f"{count} {verdict}" for verdict, count in self._verdicts.most_common())
        text = f"{self.frames} frames: {verdicts}; median {self._median_ms():.2f} ms a frame"
        if failed := self._reasons["internal error"]:
            text += f"; {failed} failed ({self._examples['internal error']})"
        if not self.usable:
            reason = max(self._reasons, key=self._reasons.__getitem__, default="")
            text += f"; no frame could be used ({self._examples.get(reason, 'no measurement')})"
        return text

    def _median_ms(self) -> float:
        """The median latency, ms, to one per cent."""
        below = 0
        for index in sorted(self._latencies):
            below += self._latencies[index]
            if 2 * below > self.frames:
                return 1e-6 * math.exp(index * _LATENCY_BIN)
        return math.nan


class FrameReplay:
    """A replay of a wrist camera: call :meth:`records` once, then :meth:`summary`."""

    def __init__(
        self, source: Source, config: Config, recorded: RecordedRun | None, warn: Callable[[str], None]
    ) -> None:
        self._source, self._config, self._recorded, self._warn = source, config, recorded, warn
        self._recorder: Recorder = Recorder()
        self._counts = Counts()
        self.length = len(source) if isinstance(source, Sized) else None

    @contextmanager
    def recorded_in(self, path: Path | None) -> Iterator[None]:
        """Also record the replay (None: don't); for recorded frames together with the recorded run."""
        with one_recording(path, self._config, self._recorded) as self._recorder:
            yield

    def records(self, step: Callable[[], None]) -> Iterator[FrameRecord]:
        """One record per frame; ``step`` is called after each."""
        recorded = self._recorded
        past = NOTHING_BEFORE if recorded is None else RecordedInputs(recorded.state, recorded.source.commands)
        for record in replay(self._source, self._config, self._recorder, past, self._warn):
            yield record
            self._counts.add(record)
            if recorded is not None:
                recorded.compare(record)
            step()

    def summary(self) -> list[str]:
        """A summary of the frames, and of the differences from the recorded run."""
        compared = [] if self._recorded is None else [self._recorded.summary()]
        return [*self._counts.caution(), self._counts.summary(), *compared]

    @property
    def usable(self) -> bool:
        """Whether any frame was usable."""
        return self._counts.usable > 0


@contextmanager
def open_replay(
    paths: Sequence[Path],
    config_path: Path | None,
    fps: float | None = None,
    warn: Callable[[str], None] = _log.warning,
    *,
    camera: str | None = None,
    episode: int | None = None,
) -> Iterator[FrameReplay]:
    """Open a folder of images, a video, an episode, or recordings of one run for a replay with a configuration (None:
    the recorded one); ``fps`` as for :func:`gripmon.open_source`.  ``camera`` and ``episode`` select one of several
    (None: as in the configuration's source).  ``warn`` is called with one line for each oddity.

    Raises :class:`InputError` and :class:`NoResultError`.
    """
    first = paths[0]
    _refuse_empty_folders(paths)
    recorded = _are_recordings(paths)
    if not recorded and not first.exists():
        right = "a folder of images, a video, an .mcap, a rosbag, a LeRobot dataset or an .rrd"
        raise InputError(f"{first}: there is no such file or folder; {right}")
    with contextlib.ExitStack() as opened:
        given = None if config_path is None else load_config(config_path, check_source=False)
        run = RecordedRun(paths, given, opened) if recorded else None
        config = given if run is None else run.config
        if config is None:
            raise InputError(f"{first} isn't a recording, which alone brings its own configuration; name one", "config")
        source = _open_input(first, fps, config, camera, episode, warn) if run is None else run.source
        opened.callback(source.close)
        for note in [] if run is None else run.notes:
            warn(note)
        if (text := limits_warning(config)) is not None:
            warn(text)
        if given is not None and (text := reference_doubt(given.settings)) is not None:
            warn(f"{given.path}: {text}")
        warm_up()
        yield FrameReplay(source, config, run, warn)


def _are_recordings(paths: Sequence[Path]) -> bool:
    """Whether the paths are recordings, of which there may be several, rather than images or a video."""
    other = next((p for p in paths if not (recordings_below(p) if p.is_dir() else p.suffix.lower() == ".rrd")), None)
    if other is not None and len(paths) > 1:
        raise InputError(f"{other}: isn't an .rrd file; one input, or several .rrd files of one run")
    return other is None


def _refuse_empty_folders(paths: Sequence[Path]) -> None:
    """Refuse folders without input, before asking for anything else."""
    for path in paths:
        if not path.is_dir() or recordings_below(path) or (path / TIMESTAMPS_NAME).exists():
            continue
        if not isinstance(settings_for_path(path), FolderSettings):
            continue
        try:
            images = any(entry.suffix.lower() in IMAGE_SUFFIXES for entry in path.iterdir())
        except OSError as error:
            raise InputError(f"{path}: can't be read ({error.strerror})") from None
        if not images:
            right = ".rrd files, or images such as *.png, *.jpg, *.tif, *.pgm; a video, .mcap or .bag by its own name"
            raise InputError(f"{path}: no recordings and no images in it; {right}")


def _open_input(
    path: Path,
    fps: float | None,
    config: Config | None,
    camera: str | None,
    episode: int | None,
    warn: Callable[[str], None] = _log.warning,
) -> Source:
    settings = settings_for_path(path, fps)
    if isinstance(settings, EpisodeSettings):
        settings = as_configured(settings, config, camera, episode)
    elif camera is not None or episode is not None:
        raise InputError(f"--{'camera' if camera else 'episode'}: {path} has one camera and one episode; leave it out")
    elif fps is None:
        settings = _at_configured_rate(settings, config, warn)
    try:
        source = start(settings)
    except SourceError as error:
        raise InputError(f"{path}: {error}") from None
    try:
        lens = None if config is None else getattr(source, "camera", None)
    except SourceError as error:  # fatal to nobody who brings his own
        warn(f"the frames' own camera calibration can't be used ({error}); the configuration's is used")
        return source
    if config is not None and lens is not None and (off := lens_fault(lens, config.settings.camera)) is not None:
        warn(off)
    return source


def _at_configured_rate(
    settings: FolderSettings | VideoSettings, config: Config | None, warn: Callable[[str], None]
) -> FolderSettings | VideoSettings:
    """The settings with the rate of the configuration's source, if that is of the same kind; images that have neither
    times nor a rate are told how they count: stills as a video's frames would seem to follow each other at once.
    """
    given = None if config is None else config.settings.source
    if isinstance(given, FolderSettings | VideoSettings) and type(given) is type(settings):
        settings = msgspec.structs.replace(settings, fps=given.fps)
    usual = FolderSettings(path=settings.path)
    if settings == usual and not (Path(settings.path) / TIMESTAMPS_NAME).exists():
        how = f"its images count as {usual.fps:g} a second; --fps HZ says else"
        warn(f"{settings.path}: has no {TIMESTAMPS_NAME}: {how}")
    return settings


def as_configured(
    settings: EpisodeSettings, config: Config | None, camera: str | None, episode: int | None
) -> EpisodeSettings:
    """The settings of an episode with the camera and the opening of the configuration's source, if that is of the same
    kind; ``camera`` and ``episode`` override them.
    """
    given = None if config is None else config.settings.source
    if isinstance(settings, BagSettings):
        if episode is not None:
            raise InputError(f"--episode: {settings.path} is one episode; leave it out")
        known = given if isinstance(given, BagSettings) else settings
        return BagSettings(path=settings.path, camera=camera or known.camera, opening=known.opening)
    known_set = given if isinstance(given, LeRobotSettings) else settings
    number = known_set.episode if episode is None else episode
    chosen = camera or known_set.camera
    return LeRobotSettings(path=settings.path, camera=chosen, episode=number, opening=known_set.opening)
