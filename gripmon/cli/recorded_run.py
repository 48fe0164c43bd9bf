"""A recording as the input of ``gripmon replay``, and what is different from when it was recorded."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from gripmon.analyse.replay_differences import Differences
from gripmon.cli import common
from gripmon.model.errors import InputError

if TYPE_CHECKING:
    from gripmon.model.records import FrameRecord
    from gripmon.record.compared import ComparedRecorder


def is_recording(paths: list[Path]) -> bool:
    """Whether these are recordings, rather than images or a video; only recordings may be several."""
    from gripmon.record.read import recordings_below

    def holds(path: Path) -> bool:
        return bool(recordings_below(path)) if path.is_dir() else path.suffix.lower() == ".rrd"

    other = next((path for path in paths if not holds(path)), None)
    if other is not None and len(paths) > 1:
        raise InputError(f"{other}: is no .rrd file; one input, or several .rrd files of one run")
    return other is None


class RecordedRun:
    """A recorded run, and what is decided now beside what was then."""

    def __init__(self, paths: list[Path], config_path: str | None, opened: contextlib.ExitStack) -> None:
        """``config_path`` None: the recorded configuration.  What is opened is closed with ``opened``."""
        from gripmon.daemon import recorded_run
        from gripmon.daemon.replaying import Past

        given = None if config_path is None else common.load(config_path, check_source=False)
        self._run = run = recorded_run.RecordedRun(paths, given, opened)
        self.source, self.config, self.recorded_config = run.source, run.config, run.recorded_config
        self.past = Past(run.state, run.source.commands)
        self._differences, self._unbounded = Differences(), 0
        for note in run.notes:
            print(f"replay: {note}", file=sys.stderr)

    def compare(self, record: FrameRecord) -> None:
        """Count what is decided now, about the frame that the source gave last, against what was then."""
        from gripmon.daemon.recorded_run import as_recorded_before_bounds

        then = self.source.record
        assert then is not None, "every replayed frame has a record"
        unbounded = then.protection is None and record.protection is not None
        self._unbounded += unbounded
        self._differences.add(then, as_recorded_before_bounds(record) if unbounded else record)

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
        path = Path(name)
        if path.is_dir():
            raise InputError(f"--recording {path}: is a folder; a file")
        common.make_directory(path.parent, "--recording")
        with contextlib.ExitStack() as opened:
            try:
                recorder = opened.enter_context(self._run.compared_in(path))
            except OSError as error:
                raise common.not_writable(path, error, "--recording") from None
            yield recorder
