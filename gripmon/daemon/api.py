"""What programs and notebooks begin with: a monitor and a source of frames, without network and without files."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from gripmon import monitor
from gripmon.daemon.camera_source import open_source as open_configured
from gripmon.daemon.config import Config
from gripmon.io.sources import OpenedSource, SourceSettings, settings_for_path
from gripmon.io.sources import open_source as start
from gripmon.judge.references import Keep
from gripmon.model.records import Frame, FrameRecord, MonitorState


class Monitor(monitor.Monitor):
    """The per-frame method of a configuration: frames in, records out, nothing else."""

    def __init__(self, config: Config, state: MonitorState | None = None, keep: Keep = lambda _: "") -> None:
        """``state`` and ``keep``: see :class:`gripmon.monitor.Monitor`.  Raises ValueError for a state that doesn't
        hold together.
        """
        super().__init__(
            config.camera, config.gripper, config.settings.monitor, config.reference, config.taught_edges, state, keep
        )
        self._config = config
        self._has_jaw = config.gripper.has_jaw
        self._fixed = config.settings.jaw.source == "fixed"

    def process(self, frame: Frame) -> FrameRecord:
        """One frame in, one record out; with ``jaw.source: fixed`` at the configuration's jaw opening.  Never raises
        for a bad frame: that is a record with a reason.
        """
        return super().process(self.with_opening(frame))

    def with_opening(self, frame: Frame) -> Frame:
        """The frame with the opening that the monitor takes it at."""
        if not self._fixed or frame.jaw_opening_m == self._config.jaw_opening_m:
            return frame
        return dataclasses.replace(frame, jaw_opening_m=self._config.jaw_opening_m)

    def ignores_opening(self, frame: Frame) -> bool:
        """Whether the frame brings an opening that ``jaw.source: fixed`` overrules."""
        return self._fixed and self._has_jaw and frame.jaw_opening_m not in (None, self._config.jaw_opening_m)


def open_source(source: str | Path | SourceSettings | Config, fps: float | None = None) -> OpenedSource:
    """Frames to iterate over: of a folder of images or a video file, of a source's settings, or a configuration's own.

    ``fps``: frames a second where a folder or a video has no time stamps (1/s).  It is a context manager, too.  Raises
    :class:`SourceError`: nothing there, or nothing that can be read.
    """
    if isinstance(source, Config):
        return OpenedSource(open_configured(source))
    if isinstance(source, str | Path):
        source = settings_for_path(Path(source), fps)
    return OpenedSource(start(source))
