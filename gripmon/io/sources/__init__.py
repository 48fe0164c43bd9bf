"""Sources of frames: a folder of images, a video file, an episode of recorded messages or of a LeRobot dataset, a live
camera, one on the network or of ROS 2, a simulated one.

All are a :class:`Source`; :func:`open_source` makes one from its settings, and only then imports heavy packages.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from gripmon.io.sources.bags import BAG_SUFFIXES, BagSettings, BagSource, is_rosbag2
from gripmon.io.sources.base import READ_TIMEOUT_S, FullScale, OpenedSource, Source, SourceError, Waiting
from gripmon.io.sources.files import FolderSettings, FolderSource, VideoSettings, VideoSource
from gripmon.io.sources.lerobot import LeRobotSettings, LeRobotSource, is_lerobot
from gripmon.io.sources.live import LiveCamera, LiveSettings
from gripmon.io.sources.network import ArrivingCamera, NetworkCamera, NetworkSettings
from gripmon.io.sources.ros2 import Ros2Camera, Ros2CameraSettings
from gripmon.io.sources.simulated import SimulatedSettings, make_simulator, open_simulated
from gripmon.io.wire import Keys, Link

if TYPE_CHECKING:
    from gripmon.simulate import Rig

EpisodeSettings = BagSettings | LeRobotSettings
SourceSettings = (
    SimulatedSettings
    | FolderSettings
    | VideoSettings
    | EpisodeSettings
    | LiveSettings
    | NetworkSettings
    | Ros2CameraSettings
)

__all__ = [
    "READ_TIMEOUT_S",
    "ArrivingCamera",
    "BagSettings",
    "BagSource",
    "EpisodeSettings",
    "FolderSettings",
    "FolderSource",
    "FullScale",
    "LeRobotSettings",
    "LeRobotSource",
    "LiveCamera",
    "LiveSettings",
    "NetworkCamera",
    "NetworkSettings",
    "OpenedSource",
    "Ros2Camera",
    "Ros2CameraSettings",
    "SimulatedSettings",
    "Source",
    "SourceError",
    "SourceSettings",
    "VideoSettings",
    "VideoSource",
    "Waiting",
    "make_simulator",
    "open_source",
    "settings_for_path",
    "settings_for_text",
]

USUAL_FPS = 25.0


def open_source(
    settings: SourceSettings,
    relative_to: Path = Path(),
    *,
    scene: Rig | None = None,
    size_px: tuple[int, int] | None = None,
    link: Link | None = None,
    keys: Keys | None = None,
) -> Source:
    """Start a source; paths in its settings are relative to ``relative_to``, the folder of the configuration file.

    Only the simulator needs a ``scene``; a camera on the network needs the session, the monitor's keys and, as one of
    ROS 2, the size of the images: (width, height), by default that of the scene's camera.

    Raises :class:`SourceError` for a missing or empty folder, a malformed table of time stamps, a file that isn't a
    video, and a device of unknown form.  A camera that is absent at present is not an error: the source waits for it.
    """
    if size_px is None and scene is not None:
        size_px = scene.camera.width_px, scene.camera.height_px
    match settings:
        case SimulatedSettings():
            if scene is None:
                raise SourceError("kind: simulator has no scene here; a camera, a gripper and a calibration to render")
            return open_simulated(settings, scene, relative_to)
        case FolderSettings():
            return FolderSource(settings, relative_to)
        case VideoSettings():
            return VideoSource(settings, relative_to)
        case BagSettings():
            return BagSource(settings, str(relative_to))
        case LeRobotSettings():
            return LeRobotSource(settings, str(relative_to))
        case LiveSettings():
            return LiveCamera(settings)
        case NetworkSettings():
            if link is None or keys is None or size_px is None:
                raise SourceError("kind: zenoh has no session here; publish.enabled: true, and gripmon run")
            return NetworkCamera(settings, link, keys["image"], size_px)
        case Ros2CameraSettings():
            if size_px is None:
                raise SourceError("kind: ros2 needs the size of the images here; size_px, (width, height)")
            if scene is None:
                return Ros2Camera(settings, size_px)
            return Ros2Camera(settings, size_px, scene.camera, (scene.gripper.jaw_min_m, scene.gripper.jaw_max_m))


def settings_for_path(path: Path, fps: float | None = None) -> FolderSettings | VideoSettings | EpisodeSettings:
    """Settings for a recorded input given as text: a folder of images, a LeRobot dataset, a rosbag2 folder, an MCAP,
    .db3 or .bag file, otherwise a video file; ``fps`` (1/s) is used if the input has no time stamps.
    """
    if path.suffix.lower() in BAG_SUFFIXES or (path.is_dir() and is_rosbag2(str(path))):
        return BagSettings(path=str(path))
    if path.is_dir() and is_lerobot(str(path)):
        return LeRobotSettings(path=str(path))
    settings = FolderSettings(path=str(path)) if path.is_dir() else VideoSettings(path=str(path))
    return settings if fps is None else msgspec.structs.replace(settings, fps=fps)


def settings_for_text(text: str, fps: float | None = None) -> FolderSettings | LiveSettings | VideoSettings:
    """The same for an input that may also be a camera: a number, /dev/…, a URL or a GStreamer pipeline.  Raises
    :class:`SourceError` for any other text.
    """
    path = Path(text)
    if path.is_dir():
        return FolderSettings(path=text, fps=fps or USUAL_FPS)
    if path.is_file():
        return VideoSettings(path=text)
    if not (text.isdecimal() or text.startswith("/dev/") or "://" in text or "!" in text):
        right = "a folder of images, a video file, or a camera (0, /dev/video0, a URL, a GStreamer pipeline)"
        raise SourceError(f"there is no such folder or file; {right}")
    return LiveSettings(device=int(text) if text.isdecimal() else text, fps=fps)
