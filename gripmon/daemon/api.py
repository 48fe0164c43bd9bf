"""The Python API for programs and notebooks: a monitor and a source of frames, without network and files.

Also the functions for configured sources that ``check`` and ``run`` use.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sized
from pathlib import Path

from gripmon import monitor
from gripmon.daemon.config import Config, ConfigError
from gripmon.daemon.config.typed import faults_of
from gripmon.io.sources import (
    EpisodeSettings,
    FolderSettings,
    FullScale,
    OpenedSource,
    SimulatedSettings,
    Source,
    SourceSettings,
    VideoSettings,
    settings_for_path,
)
from gripmon.io.sources import open_source as start
from gripmon.io.wire import Keys, Link
from gripmon.judge.references import Keep
from gripmon.model.errors import NoResultError
from gripmon.model.records import Beside, Frame, FrameRecord, Image, MonitorState
from gripmon.model.response import likely_linear


class Monitor(monitor.Monitor):
    """The per-frame method with a configuration: frames in, records out, nothing else."""

    def __init__(
        self, config: Config, state: MonitorState | None = None, keep: Keep = lambda _: "", shadow: bool = False
    ) -> None:
        """``state``, ``keep`` and ``shadow``: see :class:`gripmon.monitor.Monitor`.  Raises ValueError for an
        inconsistent state.
        The very first frame on a machine takes a minute, in which the per-frame code is compiled, unless
        :func:`gripmon.monitor.warm_up` has done so before, in all cores.
        """
        settings = config.settings.monitor
        super().__init__(
            config.camera, config.gripper, settings, config.reference, config.taught_edges, state, keep, shadow
        )
        self._config = config
        self._has_jaw = config.gripper.has_jaw
        self._fixed = config.settings.jaw.source == "fixed"

    def process(self, frame: Frame, then: Beside | None = None) -> FrameRecord:
        """One frame in, one record out; with ``jaw.source: fixed`` at the configuration's jaw opening.  A bad frame
        never raises, but gives a record with a reason.  ``then``: ``beside`` of its record, to replay a live run.
        """
        return super().process(self.with_opening(frame), then)

    def with_opening(self, frame: Frame) -> Frame:
        """The frame with the jaw opening that the monitor uses."""
        if not self._fixed or frame.jaw_opening_m == self._config.jaw_opening_m:
            return frame
        return dataclasses.replace(frame, jaw_opening_m=self._config.jaw_opening_m)

    def ignores_opening(self, frame: Frame) -> bool:
        """Whether the frame has an opening that ``jaw.source: fixed`` overrides."""
        return self._fixed and self._has_jaw and frame.jaw_opening_m not in (None, self._config.jaw_opening_m)


def open_source(source: str | Path | SourceSettings | Config, fps: float | None = None) -> OpenedSource:
    """Frames to iterate over, from a folder of images, a video file, an MCAP file, a rosbag2 or a LeRobot dataset of
    one episode, from a source's settings, or a configuration's own source.

    ``fps``: frame rate if a folder or a video has no time stamps (1/s).  The result is also a context manager.  Raises
    :class:`SourceError` if there is nothing, or nothing that can be read.
    """
    if isinstance(source, Config):
        return OpenedSource(open_configured(source))
    if isinstance(source, str | Path):
        source = settings_for_path(Path(source), fps)
    return OpenedSource(start(source))


def open_configured(config: Config, link: Link | None = None) -> Source:
    """Start the configured source, on the network through ``link``.  Raises :class:`ConfigError` if it can't start."""
    settings, size_px = config.settings, (config.camera.width_px, config.camera.height_px)
    keys = Keys(settings.robot, settings.camera_name)
    scene = config.scene if isinstance(settings.source, SimulatedSettings) else None  # others don't need its packages
    with faults_of(config.path, "source."):
        source = start(settings.source, config.directory, scene=scene, size_px=size_px, link=link, keys=keys)
    bit_depth = settings.monitor.bit_depth
    return source if bit_depth == 16 else FullScale(source, bit_depth)


ROUNDED_OPENING_M = 1e-6
"""By how much an opening in a table differs from the same one in a configuration at most, m: both are written with six
digits."""


def look_ahead(config: Config) -> tuple[str, str | None] | None:
    """A description of the first recorded frame, and what is odd about it (None: nothing); None for a source that isn't
    recorded.

    Raises :class:`ConfigError` for frames that don't fit the camera, and :class:`NoResultError` if none can be read.
    """
    if not isinstance(config.settings.source, FolderSettings | VideoSettings | EpisodeSettings):
        return None
    source = open_configured(config)
    try:
        frame, unreadable = _first_readable(config, source)
    finally:
        source.close()
    assert frame.image is not None
    height_px, width_px = frame.image.shape[:2]
    camera = config.camera
    if (width_px, height_px) != (camera.width_px, camera.height_px):
        wrong = f"{camera.width_px} x {camera.height_px} px; {frame.name} is {width_px} x {height_px}"
        raise ConfigError(config.path, "camera.width_px", wrong, "the calibration that belongs to these images")
    count = f"{len(source)} frames, " if isinstance(source, Sized) else ""
    detail = f"{count}first one {frame.name}, {width_px} x {height_px} px, {frame.image.dtype}"
    if unreadable:
        first, *more = unreadable
        others = f", nor can the next {len(more)}" if more else ""
        return detail, f"its first frame can't be read ({first}){others}"
    odd = [each for each in (unlike_light(config, frame.image), _unused_opening(config, frame)) if each]
    return detail, "; ".join(odd) or None


def unlike_light(config: Config, image: Image) -> str | None:
    """What is odd about an image's grey levels: a colour camera's, of which neither the configuration, a taught model
    nor the reference says how they follow the light.
    """
    if config.knows_response or config.settings.taught is not None or likely_linear([image]):
        return None
    return "nothing says how the grey levels of this colour camera follow the light: gripmon teach finds it"


def _unused_opening(config: Config, frame: Frame) -> str | None:
    """Whether a recorded frame tells another jaw opening than the one that is taken to be fixed."""
    fixed_m, told_m, settings = config.jaw_opening_m, frame.jaw_opening_m, config.settings
    if settings.jaw.source != "fixed" or fixed_m is None or told_m is None:
        return None
    if abs(told_m - fixed_m) <= max(settings.monitor.jaw_sigma_m, ROUNDED_OPENING_M):
        return None
    told = f"its frames come with jaw openings, the first with {1e3 * told_m:g} mm"
    return f"{told}, which jaw.source: fixed doesn't use: it takes them to be {1e3 * fixed_m:g} mm; jaw.source: frames"


def _first_readable(config: Config, source: Source) -> tuple[Frame, list[str]]:
    """The first frame with an image, and why those before it have none."""
    unreadable: list[str] = []
    while isinstance(frame := source.read(), Frame):
        if frame.image is not None:
            return frame, unreadable
        unreadable.append(f"{frame.name}: {frame.fault}")
    why = unreadable[0] if unreadable else "it holds none"
    raise NoResultError(f"{config.path}: source.path: no frame of it can be read ({why}); readable images")
