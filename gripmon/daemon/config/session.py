"""What a configuration needs beside itself to join the network: files of Zenoh's, possible endpoints, packages."""

from __future__ import annotations

from pathlib import Path

from gripmon.daemon.config.settings import Settings
from gripmon.daemon.config.typed import Fault
from gripmon.io.metrics import MetricsSettings, package_fault
from gripmon.io.ros2.names import network_of
from gripmon.io.ros2.node import Ros2Missing, typestore
from gripmon.io.sources import NetworkSettings, SourceError, SourceSettings
from gripmon.io.sources.network import PayloadDecoder
from gripmon.io.wire import Joining, PublishError, PublishSettings, joining
from gripmon.model.camera import Camera


def joined_or_fault(settings: Settings, camera: Camera, directory: Path) -> Joining | Fault | None:
    """How the network would be joined, or why it can't be; None if it won't.  Paths count from ``directory``."""
    if (missing := package_fault(settings.metrics)) is not None:
        return Fault(*missing)
    if not settings.publish.enabled:
        return None
    try:
        found = joining(network_of(settings.publish, settings.ros2), directory)
    except PublishError as error:
        return _fault(str(error))
    return _package_fault(settings, camera) or found


def second_joined_or_fault(
    source: SourceSettings, publish: PublishSettings, metrics: MetricsSettings, camera: Camera, directory: Path
) -> Joining | Fault | None:
    """The same for a second camera."""
    if (missing := package_fault(metrics)) is not None:
        return Fault(*missing)
    if not publish.enabled:
        return None
    try:
        found = joining(publish, directory)
    except PublishError as error:
        return _fault(str(error))
    return _source_fault(source, camera) or found


def _package_fault(settings: Settings, camera: Camera) -> Fault | None:
    """A package that is missing, at the key that asks for it."""
    for key, wanted in (
        ("jaw.source", settings.jaw.source == "ros2_joint_state"),
        ("ros2.enabled", settings.ros2.enabled),
    ):
        try:
            _ = wanted and typestore()
        except Ros2Missing as error:
            return _fault(f"{key}: {error}")
    return _source_fault(settings.source, camera)


def _source_fault(source: SourceSettings, camera: Camera) -> Fault | None:
    if isinstance(source, NetworkSettings):
        try:
            PayloadDecoder(source.format, (camera.width_px, camera.height_px))
        except SourceError as error:
            return _fault(f"source.{error}")
    return None


def _fault(text: str) -> Fault:
    key, _, rest = text.partition(": ")
    wrong, _, right = rest.partition("; ")
    return Fault(key, wrong, right)
