"""A recording as the input of ``gripmon replay``: with what the monitor ran then, or with another configuration."""

from __future__ import annotations

import contextlib
import dataclasses
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from gripmon.analyse.replay_differences import Differences
from gripmon.cli import common
from gripmon.cli.one_recording import keep
from gripmon.daemon.replaying import Past

if TYPE_CHECKING:
    from gripmon.daemon.config import Config
    from gripmon.model.records import FrameRecord, Limits
    from gripmon.record.read.replayed import RecordedFrames
    from gripmon.record.write.compared import ComparedRecorder

_ENDING = ".rrd"


def is_recording(paths: list[Path]) -> bool:
    """Whether these are recordings, rather than images or a video; only recordings may be several."""
    if all(_holds_recordings(path) for path in paths):
        return True
    if len(paths) > 1:
        other = next(path for path in paths if not _holds_recordings(path))
        raise common.CommandFailedError(
            f"{other}: is no {_ENDING} file; one input, or several {_ENDING} files of one run", common.EXIT_USAGE
        )
    return False


def recording_files(paths: list[Path]) -> list[Path]:
    """The files that are meant; a folder stands for those in it and below."""
    from gripmon.record.read import recordings_below

    files: list[Path] = []
    for path in paths:
        found = recordings_below(path) if path.is_dir() else [path]
        missing = path if not path.exists() else None if found else path
        if missing is not None:
            raise common.CommandFailedError(f"{path}: there is no recording; an {_ENDING} file", common.EXIT_USAGE)
        files += found
    return list(dict.fromkeys(files))


class RecordedRun:
    """What was recorded, and how a monitor is to go through it again."""

    def __init__(self, paths: list[Path], config_path: str | None, opened: contextlib.ExitStack) -> None:
        """``config_path`` None: the recorded configuration.  What is opened is closed with ``opened``."""
        from gripmon.record.read.replayed import RecordedFrames, SeveralRunsError, UnusableError

        try:
            self.source: RecordedFrames = RecordedFrames(recording_files(paths))
        except SeveralRunsError as error:
            raise common.CommandFailedError(f"replay: {error}", common.EXIT_USAGE) from None
        except UnusableError as error:
            raise common.CommandFailedError(f"replay: {error}") from None
        self.name = str(paths[0]) if len(paths) == 1 else f"{paths[0]} and {len(paths) - 1} more"
        self.recorded_config = self._recorded_config(opened)
        if config_path is not None:
            self.config = common.load(config_path, check_source=False)
        elif self.recorded_config is not None:
            self.config = self.recorded_config
        else:
            raise common.CommandFailedError(
                f"{self.name}: holds no configuration; the one to replay with, by --config", common.EXIT_USAGE
            )
        self.config, self.past = self._begin(self.config)
        self._differences, self._unbounded = Differences(), 0
        self._say_what_is_missing()

    def compare(self, record: FrameRecord) -> None:
        """Count what is decided now, about the frame that the source gave last, against what was then."""
        then = self.source.record
        assert then is not None, "every replayed frame has a record"
        said_less = then.protection is None and record.protection is not None
        self._unbounded += said_less
        self._differences.add(then, as_recorded_before_bounds(record) if said_less else record)

    def summary(self) -> str:
        """What is otherwise than it was then."""
        lost, damaged = self.source.passed_over, self.source.images_damaged
        unread = f"; {lost} more could no longer be read" if lost else ""
        unread += f"; the recorded images of {damaged} frames are damaged" if damaged else ""
        if self._unbounded:
            unread += f"; {self._unbounded} frames were recorded by a version without protection levels"
        recorded = self.recorded_config
        from_jpeg = recorded is not None and recorded.settings.recording.image_format == "jpeg"
        return f"replay: {self._differences.text(from_jpeg)}{unread}"

    @contextlib.contextmanager
    def compared_in(self, name: str) -> Iterator[ComparedRecorder]:
        """A recorder into one file that shows what was recorded and what is replayed, overlaid."""
        from gripmon.daemon.config.recorded import to_recorded
        from gripmon.record.write.compared import ComparedRecorder
        from gripmon.record.write.wire import make_scene

        path, config = Path(name), self.config
        if path.is_dir():
            raise common.CommandFailedError(f"--recording {path}: is a folder; a file", common.EXIT_USAGE)
        common.make_directory(path.parent, "--recording")
        if path.resolve() in {source.resolve() for source in self.source.paths}:
            raise common.CommandFailedError(f"--recording {path}: is what is replayed; another file", common.EXIT_USAGE)
        part = path.with_name(f".{path.name}.part")
        settings, reference = config.settings, config.reference
        if self.past.state is not None:
            reference = self.past.state.references[-1]
        scene = make_scene(
            settings.recording, str(path.parent), path.stem, settings.robot, settings.camera_name, config.camera,
            config.gripper, reference, configuration=to_recorded(config, self.past.state),
        )  # fmt: skip
        try:
            recorder = ComparedRecorder(part, scene, self.source, _limits(self.recorded_config))
        except OSError as error:
            raise common.not_writable(path, error, "--recording") from None
        try:
            yield recorder
        finally:
            recorder.close()
            keep([part], path, recorder.failure, whole=recorder.failure is None)

    def _recorded_config(self, opened: contextlib.ExitStack) -> Config | None:
        from gripmon.daemon.config import ConfigError
        from gripmon.daemon.config.recorded import from_recorded

        recorded = self.source.configuration
        if recorded is None:
            return None
        folder = Path(opened.enter_context(tempfile.TemporaryDirectory(prefix="gripmon-replay-")))
        try:
            return from_recorded(recorded, folder)
        except ConfigError as error:
            text = str(error).replace(f"{folder}/", "")
            right = "one of this version, by --config"
            raise common.CommandFailedError(
                f"{self.name}: its configuration can't be used ({text}); {right}", common.EXIT_USAGE
            ) from None

    def _begin(self, config: Config) -> tuple[Config, Past]:
        """Where the monitor starts from: the state then, if that was about this calibration."""
        source = self.source
        state = None if source.configuration is None else source.configuration.start
        first, recorded = source.reference, self.recorded_config
        ours = recorded is not None and recorded.state_owner.calibration == config.state_owner.calibration
        if first is None or recorded is None or not ours:
            if recorded is not None:
                print("replay: --config has another calibration: it begins with that one's reference", file=sys.stderr)
            return config, Past(None, source.commands)
        began_with = recorded.reference if state is None else state.references[-1]
        if state is None and first.origin == began_with.origin:
            return dataclasses.replace(config, reference=first), Past(None, source.commands)
        if state is not None and (first.reference_id, first.revision) == (began_with.reference_id, began_with.revision):
            return dataclasses.replace(config, reference=state.references[0]), Past(state, source.commands)
        print(
            f"replay: the run's beginning isn't in {self.name}: it begins with the reference that was in force in the "
            f"first file, {first.reference_id}; the result comes close only",
            file=sys.stderr,
        )
        return dataclasses.replace(config, reference=first), Past(None, source.commands)

    def _say_what_is_missing(self) -> None:
        source = self.source
        for fault in source.faults:
            print(f"replay: {fault}", file=sys.stderr)
        if source.frames_without_image:
            print(
                f"replay: {self.name} holds images of {len(source) - source.stand_ins} frames; "
                f"{source.frames_without_image} more were recorded without: the result comes close only",
                file=sys.stderr,
            )
        if source.stand_ins:
            print(
                f"replay: {source.stand_ins} refused frames have no image in the recording; they are refused again as "
                "their records say",
                file=sys.stderr,
            )


def as_recorded_before_bounds(record: FrameRecord) -> FrameRecord:
    """The record as a version wrote it that stated no bounds, and a reason only where nothing was measured."""
    import msgspec

    return msgspec.structs.replace(record, protection=None, reason=None if record.measured else record.reason)


def _limits(config: Config | None) -> Limits | None:
    """Those that a configuration sets; what a monitor learns of a stream is not among them."""
    from gripmon.model.records import Limits

    if config is None:
        return None
    policy, nothing = config.settings.monitor.policy, (0.0,) * 6
    of_policy = policy.warn_m, policy.warn_rad, policy.limit_m, policy.limit_rad
    alert_limits = policy.alert_limit_m, policy.alert_limit_rad
    return Limits(*of_policy, nothing, None, None, None, nothing, nothing, *alert_limits)


def _holds_recordings(path: Path) -> bool:
    if path.is_dir():
        from gripmon.record.read import recordings_below

        return bool(recordings_below(path))
    return path.suffix.lower() == _ENDING
