"""A recorded run as the input of a replay, and the recording of a replay in one file."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import math
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import msgspec

from gripmon.analyse.comparison import Differences
from gripmon.daemon.config import Config, ConfigError
from gripmon.daemon.config.recorded import from_recorded, to_recorded
from gripmon.model.atomic import writing
from gripmon.model.errors import InputError
from gripmon.model.records import FrameRecord, Limits, MonitorState
from gripmon.record.keeping import keep_whole
from gripmon.record.read import RecordedFrames, recording_files
from gripmon.record.recorder import RECORDING_PATIENCE_S, Recorder
from gripmon.record.write import open_recorder


class RecordedRun:
    """A recorded run, to be processed again with ``config``, starting from ``state`` (None: the configured reference).
    ``notes``, one line each: what is missing.
    """

    def __init__(self, paths: Sequence[Path], config: Config | None, opened: contextlib.ExitStack) -> None:
        """``config`` None: the recorded configuration.  What this opens is closed by ``opened``.

        Raises :class:`InputError`, :class:`NoResultError`.
        """
        self.source: RecordedFrames = RecordedFrames(recording_files(list(paths)))
        self.name = str(paths[0]) if len(paths) == 1 else f"{paths[0]} and {len(paths) - 1} more"
        self.recorded_config = self._recorded_config(opened)
        begin = config or self.recorded_config
        if begin is None:
            raise InputError(f"{self.name}: holds no configuration; the one to replay with", "config")
        self.notes: list[str] = []
        self._differences = Differences()
        self.config, self.state = self._begin(begin)
        self._note_what_is_missing()

    def compare(self, record: FrameRecord) -> None:
        """Compare the record of the frame that the source returned last with the recorded one."""
        then = self.source.record
        assert then is not None, "every replayed frame has a record"
        if then.since_reference is None:  # as versions without it recorded
            record = msgspec.structs.replace(record, since_reference=None)
        self._differences.add(then, record)

    def summary(self) -> str:
        """How the replay differs from the recording."""
        lost, damaged = self.source.passed_over, self.source.images_damaged
        unread = f"; {lost} more could no longer be read" if lost else ""
        unread += f"; the recorded images of {damaged} frames are damaged" if damaged else ""
        recorded = self.recorded_config
        from_jpeg = recorded is not None and recorded.settings.recording.image_format == "jpeg"
        return f"{self._differences.text(from_jpeg)}{unread}"

    def _recorded_config(self, opened: contextlib.ExitStack) -> Config | None:
        recorded = self.source.configuration
        if recorded is None:
            return None
        folder = Path(opened.enter_context(tempfile.TemporaryDirectory(prefix="gripmon-replay-")))
        try:
            return from_recorded(recorded, folder)
        except ConfigError as error:
            text = str(error).replace(f"{folder}/", "")
            wrong = f"its configuration can't be used ({text})"
            raise InputError(f"{self.name}: {wrong}; one of this version", "config") from None

    def _begin(self, config: Config) -> tuple[Config, MonitorState | None]:
        """Configuration and initial state of the monitor: the recorded state, if it is of the same calibration."""
        source = self.source
        state = None if source.configuration is None else source.configuration.start
        first, recorded = source.reference, self.recorded_config
        ours = recorded is not None and recorded.state_owner.calibration == config.state_owner.calibration
        if first is None or recorded is None or not ours:
            if recorded is not None:
                self.notes.append("the configuration has another calibration: the replay starts with its reference")
            return config, None
        began_with = recorded.reference if state is None else state.references[-1]
        if state is None and first.origin == began_with.origin:
            return dataclasses.replace(config, reference=first), None
        if state is not None and (first.reference_id, first.revision) == (began_with.reference_id, began_with.revision):
            return dataclasses.replace(config, reference=state.references[0]), state
        self.notes.append(
            f"the run's beginning isn't in {self.name}: the replay begins with the reference that was in force in the "
            f"first file, {first.reference_id}; the result is approximate"
        )
        return dataclasses.replace(config, reference=first), None

    def _note_what_is_missing(self) -> None:
        source = self.source
        self.notes += source.faults
        if source.frames_without_image:
            self.notes.append(
                f"{self.name} holds images of {len(source) - source.stand_ins} frames; "
                f"{source.frames_without_image} more were recorded without: the result is approximate"
            )
        if source.stand_ins:
            self.notes.append(
                f"{source.stand_ins} refused frames have no image in the recording; they are refused again as "
                "their records say"
            )


def _limits(config: Config | None) -> Limits | None:
    """The configured limits, without what a monitor learns from a stream."""
    if config is None:
        return None
    policy, nothing = config.settings.monitor.policy, (0.0,) * 6
    of_policy = policy.warn_m, policy.warn_rad, policy.limit_m, policy.limit_rad
    alert_limits = policy.alert_limit_m, policy.alert_limit_rad
    return Limits(*of_policy, nothing, None, None, None, nothing, nothing, *alert_limits)


@contextmanager
def one_recording(path: Path | None, config: Config, run: RecordedRun | None = None) -> Iterator[Recorder]:
    """A recorder into exactly one file, finished when the context ends; the null recorder without a path.  ``run``: the
    one that is replayed, which is drawn beside its replay.

    Raises :class:`InputError` if the file can't be created, :class:`NoResultError` at the end if writing failed; an
    earlier file then stays.
    """
    if path is None:
        yield Recorder()
        return
    source, state = (None, None) if run is None else (run.source, run.state)
    if source is not None and path.resolve() in {file.resolve() for file in source.paths}:
        raise InputError(f"{path}: is the replayed file; another file", "recording")
    # One file of any length.
    settings = msgspec.structs.replace(
        config.settings.recording, enabled=True, max_file_bytes=2**62, max_file_s=math.inf, budget_bytes=0
    )
    with contextlib.ExitStack() as opened:
        with writing(path, "recording"):
            scratch = opened.enter_context(tempfile.TemporaryDirectory(prefix=f".{path.stem}-", dir=path.parent))
        recorder = open_recorder(
            settings,
            robot=config.settings.robot,
            camera_name=config.settings.camera_name,
            camera=config.camera,
            gripper=config.gripper,
            reference=config.reference if state is None else state.references[-1],
            directory=Path(scratch),
            name=path.stem,
            patience_s=RECORDING_PATIENCE_S,
            configuration=to_recorded(config, state),
            replayed=source,
            limits_then=None if run is None else _limits(run.recorded_config),
        )
        opened.enter_context(_silent_recording())
        try:
            yield recorder
        finally:
            recorder.close(timeout_s=60.0)
            # After a temporary disk failure there is a complete file with only the later frames.
            missing = _missing(recorder)
            keep_whole(sorted(Path(scratch).glob("*.rrd")), path, recorder.failure or missing, whole=missing is None)


def _missing(recorder: Recorder) -> str | None:
    """What is missing from a recording that must be complete; None if nothing is."""
    if recorder.dropped:
        return f"{recorder.dropped} frames are missing"
    return f"{recorder.images_dropped} images are missing" if recorder.images_dropped else None


@contextmanager
def _silent_recording() -> Iterator[None]:
    """Suppress the recorder's log lines, which a replay replaces by one line at its end."""
    logger = logging.getLogger("gripmon.record")
    propagates, silent = logger.propagate, logging.NullHandler()
    logger.addHandler(silent)
    logger.propagate = False
    try:
        yield
    finally:
        logger.propagate = propagates
        logger.removeHandler(silent)
