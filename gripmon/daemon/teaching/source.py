"""A camera named by a text: for a configuration to be written, and to open it before there is one."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec

from gripmon.daemon.config.typed import to_settings
from gripmon.io.sources import (
    LiveSettings,
    NetworkCamera,
    NetworkSettings,
    OpenedSource,
    Ros2CameraSettings,
    SourceError,
    SourceSettings,
    VideoSettings,
    open_source,
    settings_for_text,
)
from gripmon.io.wire import Keys, Link
from gripmon.io.wire.session import PublishSettings, check_key

_NETWORK = re.compile(r"(zenoh|ros2):(\d{1,5})x(\d{1,5})(?::(.+))?")
_RIGHT = (
    "a folder of images, a video file, a camera (0, /dev/video0, a URL, a GStreamer pipeline), or one on the network: "
    "zenoh:WIDTHxHEIGHT[:KEY], ros2:WIDTHxHEIGHT:TOPIC"
)


def named_source(text: str, size_px: tuple[int, int] | None = None) -> SourceSettings:
    """The settings of a source; ``size_px``: image size requested from a live camera (None: its own).

    ``zenoh:1280x720`` is the monitor's own key for images, ``zenoh:1280x720:KEY`` another key,
    ``ros2:1280x720:/camera/image_raw`` a topic.  Raises :class:`~gripmon.io.sources.SourceError`.
    """
    found = _NETWORK.fullmatch(text)
    if found is not None:
        given = int(found[2]), int(found[3])
        if size_px is not None and given != size_px:
            wrong = f"{given[0]} x {given[1]} px; the camera's calibration has {size_px[0]} x {size_px[1]} px"
            raise SourceError(f"{text}: {wrong}")
        try:
            return _on_network(found[1], found[4])
        except ValueError as error:
            raise SourceError(f"{text}: {error}; {_RIGHT}") from None
    if not text or text.startswith(("zenoh:", "ros2:")):
        raise SourceError(f"'{text}' names no camera; {_RIGHT}")
    try:
        settings = settings_for_text(text)
    except SourceError as error:
        raise SourceError(f"{text}: {str(error).partition(';')[0]}; {_RIGHT}") from None
    if isinstance(settings, VideoSettings):
        return msgspec.structs.replace(settings, path=str(Path(text).resolve()))
    if isinstance(settings, LiveSettings) and size_px is not None:
        return msgspec.structs.replace(settings, width_px=size_px[0], height_px=size_px[1])
    return settings


def _on_network(kind: str, name: str | None) -> NetworkSettings | Ros2CameraSettings:
    if kind == "zenoh":
        return NetworkSettings(key=None if name is None else check_key(name))
    return to_settings({"kind": "ros2", "image": name or ""}, Ros2CameraSettings)


def open_named(text: str, robot: str, camera_name: str) -> OpenedSource:
    """Open the source.  One on the network is received as the monitor will receive it, which must not run meanwhile.

    Raises :class:`~gripmon.model.errors.InputError`.
    """
    settings = named_source(text)
    found = _NETWORK.fullmatch(text)
    size_px = None if found is None else (int(found[2]), int(found[3]))
    if not isinstance(settings, NetworkSettings):
        try:
            return OpenedSource(open_source(settings, size_px=size_px))
        except SourceError as error:  # the error names a configuration key
            raise SourceError(f"{str(error).removeprefix('path: ').partition(';')[0]}; {_RIGHT}") from None
    assert size_px is not None, "named_source has seen that it is of this form"
    return _Networked(settings, size_px, Keys(robot, camera_name))


class _Networked(OpenedSource):
    """A camera on the network, with its own session."""

    def __init__(self, settings: NetworkSettings, size_px: tuple[int, int], keys: Keys) -> None:
        self._link = Link(PublishSettings())
        try:
            super().__init__(NetworkCamera(settings, self._link, keys["image"], size_px))
        except BaseException:
            self._link.close()
            raise

    def close(self) -> None:
        super().close()
        self._link.close()
