"""What lies outside of the monitor, looked at before a start: the network, the source, the recording, metrics."""

from __future__ import annotations

import socket
from pathlib import Path
from urllib.parse import urlsplit

import msgspec

from gripmon.daemon.api import look_ahead
from gripmon.daemon.config import Config, SecondConfig, check_network
from gripmon.io.sources import LiveSettings, NetworkSettings, network_key
from gripmon.io.sources.live import shown_name
from gripmon.io.wire import Keys

_PORTS = {"rtsp": 554, "http": 80, "https": 443, "rtmp": 1935}
_CONNECT_S = 2.0


class Joined(msgspec.Struct, frozen=True):
    """How the monitor would join the network; ``file``: the one of Zenoh's that says so."""

    mode: str
    listen: tuple[str, ...]
    connect: tuple[str, ...]
    file: str | None


class SourceReport(msgspec.Struct, frozen=True):
    """Whether frames can come from the source now (``reachable`` None: only starting it would show); ``odd``: what is
    strange about it.
    """

    kind: str
    reachable: bool | None
    detail: str
    odd: str | None = None


class Surroundings(msgspec.Struct, frozen=True):
    """Where messages, recording and metrics go, and where frames come from; None: nowhere."""

    keys: str | None
    recording: str | None
    metrics: str | None
    zenoh: Joined | None
    source: SourceReport


def surroundings(config: Config | SecondConfig) -> Surroundings:
    """Look at what the configuration names; nothing is joined or started but a connection to a camera's address.

    Raises :class:`ConfigError` for what can't be joined or doesn't fit, and :class:`NoResultError` if no recorded frame
    can be read.
    """
    settings, metrics = config.settings, config.settings.metrics
    joining, joined = check_network(config), None
    if joining is not None:
        file = None if joining.file is None else str(joining.file)
        joined = Joined(joining.mode, joining.listen, joining.connect, file)
    return Surroundings(
        keys=f"gripmon/{settings.robot}/{settings.camera_name}/" if settings.publish.enabled else None,
        recording=settings.recording.directory if settings.recording.enabled else None,
        metrics=f"http://{metrics.address}:{metrics.port}/metrics" if metrics.enabled else None,
        zenoh=joined,
        source=_source(config),
    )


def _source(config: Config | SecondConfig) -> SourceReport:
    source = config.settings.source
    kind = str(type(source).__struct_config__.tag)
    if (recorded := look_ahead(config)) is not None:
        return SourceReport(kind, True, recorded.detail, recorded.odd)
    if isinstance(source, LiveSettings):
        return SourceReport(kind, *_live_reachable(source))
    if isinstance(source, NetworkSettings):
        key = network_key(source, Keys(config.settings.robot, config.settings.camera_name)["image"])
        return SourceReport(kind, None, f"frames on {key}; only running it shows whether any arrive")
    return SourceReport(kind, True, "made by this program")


def _live_reachable(source: LiveSettings) -> tuple[bool | None, str]:
    device = source.device
    if isinstance(device, int) or device.isdecimal():
        device = f"/dev/video{device}"
    if device.startswith("/dev/"):
        exists = Path(device).exists()
        return exists, device if exists else f"{device} is not there now; run keeps trying"
    address = urlsplit(device)
    if address.scheme in _PORTS and address.hostname:
        where = (address.hostname, address.port or _PORTS[address.scheme])
        try:
            with socket.create_connection(where, timeout=_CONNECT_S):
                return True, f"{where[0]}:{where[1]} answers"
        except OSError as error:
            return False, f"{where[0]}:{where[1]} does not answer ({error.strerror or error}); run keeps trying"
    return None, f"{shown_name(device)}; only running it shows whether it delivers"
