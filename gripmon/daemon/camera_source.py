"""Where a configuration's frames come from, judged by ``check`` and ``run`` alike before a start, and opened."""

from __future__ import annotations

from collections.abc import Sized
from typing import TYPE_CHECKING, NamedTuple

from gripmon.cli import common

if TYPE_CHECKING:
    from gripmon.daemon.config import Config, SecondConfig
    from gripmon.io.sources import Source
    from gripmon.io.wire import Link
    from gripmon.model.records import Frame


class RecordedInput(NamedTuple):
    """What was found in a folder or a video: a few words, and what is odd about its beginning (None: nothing)."""

    detail: str
    odd: str | None


def open_source(config: Config | SecondConfig, link: Link | None = None) -> Source:
    """Start the configured source; one that can't start ends the command with exit code 2."""
    from gripmon.daemon.config import SecondConfig
    from gripmon.io.sources import FullScale, SourceError
    from gripmon.io.sources import open_source as started
    from gripmon.io.wire import Keys

    settings, size_px = config.settings, (config.camera.width_px, config.camera.height_px)
    scene = None if isinstance(config, SecondConfig) else config.scene
    keys = Keys(settings.robot, settings.camera_name)
    try:
        source = started(settings.source, config.directory, scene=scene, size_px=size_px, link=link, keys=keys)
    except SourceError as error:
        raise common.CommandFailedError(f"{config.path}: source.{error}", common.EXIT_USAGE) from None
    bit_depth = 16 if isinstance(config, SecondConfig) else config.settings.monitor.bit_depth
    return source if bit_depth == 16 else FullScale(source, bit_depth)


def look_ahead(config: Config | SecondConfig) -> RecordedInput | None:
    """Look at the beginning of recorded frames; None for a source of another kind.

    Frames that don't fit the camera end the command with exit code 2, and with 3 if none can be read.
    """
    from gripmon.io.sources import FolderSettings, VideoSettings

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
        raise common.CommandFailedError(
            f"{config.path}: {_camera_key(config)}: {camera.width_px} x {camera.height_px} px; "
            f"{frame.name} is {width_px} x {height_px}; the calibration that belongs to these images",
            common.EXIT_USAGE,
        )
    count = f"{len(source)} frames, " if isinstance(source, Sized) else ""
    detail = f"{count}first one {frame.name}, {width_px} x {height_px} px, {frame.image.dtype}"
    if not unreadable:
        return RecordedInput(detail, None)
    first, *more = unreadable
    others = f", nor can the next {len(more)}" if more else ""
    return RecordedInput(detail, f"its first frame can't be read ({first}){others}")


def _first_readable(config: Config | SecondConfig, source: Source) -> tuple[Frame, list[str]]:
    """The first frame with an image, and why those before it have none."""
    from gripmon.model.records import Frame

    unreadable: list[str] = []
    while isinstance(frame := source.read(), Frame):
        if frame.image is not None:
            return frame, unreadable
        unreadable.append(f"{frame.name}: {frame.fault}")
    why = unreadable[0] if unreadable else "it holds none"
    raise common.CommandFailedError(f"{config.path}: source.path: no frame of it can be read ({why}); readable images")


def _camera_key(config: Config | SecondConfig) -> str:
    """Which key the size of an image belongs to."""
    from gripmon.daemon.config import SecondConfig

    return "laser.calibration" if isinstance(config, SecondConfig) else "camera.width_px"
