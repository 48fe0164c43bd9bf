"""Where a configuration's frames come from, judged by ``check`` and ``run`` alike before a start, and opened."""

from __future__ import annotations

from collections.abc import Sized
from typing import NamedTuple

from gripmon.daemon.config import Config, ConfigError, SecondConfig
from gripmon.io.sources import FolderSettings, FullScale, Source, SourceError, VideoSettings
from gripmon.io.sources import open_source as start
from gripmon.io.wire import Keys, Link
from gripmon.model.errors import NoResultError
from gripmon.model.records import Frame


class RecordedInput(NamedTuple):
    """What was found in a folder or a video: a few words, and what is odd about its beginning (None: nothing)."""

    detail: str
    odd: str | None


def open_source(config: Config | SecondConfig, link: Link | None = None) -> Source:
    """Start the configured source, on the network through ``link``.  Raises :class:`ConfigError` if it can't start."""
    settings, size_px = config.settings, (config.camera.width_px, config.camera.height_px)
    scene = None if isinstance(config, SecondConfig) else config.scene
    keys = Keys(settings.robot, settings.camera_name)
    try:
        source = start(settings.source, config.directory, scene=scene, size_px=size_px, link=link, keys=keys)
    except SourceError as error:
        raise ConfigError(config.path, "", f"source.{error}") from None
    bit_depth = 16 if isinstance(config, SecondConfig) else config.settings.monitor.bit_depth
    return source if bit_depth == 16 else FullScale(source, bit_depth)


def look_ahead(config: Config | SecondConfig) -> RecordedInput | None:
    """Look at the beginning of recorded frames; None for a source of another kind.

    Raises :class:`ConfigError` for frames that don't fit the camera, and :class:`NoResultError` if none can be read.
    """
    if not isinstance(config.settings.source, FolderSettings | VideoSettings):
        return None
    source = open_source(config)
    try:
        frame, unreadable = _first_readable(config, source)
    finally:
        source.close()
    assert frame.image is not None
    height_px, width_px = frame.image.shape[:2]
    camera = config.camera
    if (width_px, height_px) != (camera.width_px, camera.height_px):
        key = "laser.calibration" if isinstance(config, SecondConfig) else "camera.width_px"
        wrong = f"{camera.width_px} x {camera.height_px} px; {frame.name} is {width_px} x {height_px}"
        raise ConfigError(config.path, key, wrong, "the calibration that belongs to these images")
    count = f"{len(source)} frames, " if isinstance(source, Sized) else ""
    detail = f"{count}first one {frame.name}, {width_px} x {height_px} px, {frame.image.dtype}"
    if not unreadable:
        return RecordedInput(detail, None)
    first, *more = unreadable
    others = f", nor can the next {len(more)}" if more else ""
    return RecordedInput(detail, f"its first frame can't be read ({first}){others}")


def _first_readable(config: Config | SecondConfig, source: Source) -> tuple[Frame, list[str]]:
    """The first frame with an image, and why those before it have none."""
    unreadable: list[str] = []
    while isinstance(frame := source.read(), Frame):
        if frame.image is not None:
            return frame, unreadable
        unreadable.append(f"{frame.name}: {frame.fault}")
    why = unreadable[0] if unreadable else "it holds none"
    raise NoResultError(f"{config.path}: source.path: no frame of it can be read ({why}); readable images")
