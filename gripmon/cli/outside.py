"""What ``gripmon check`` says of what lies outside of the monitor: the network, the source, the recording, metrics."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from gripmon.cli import camera_source, common

if TYPE_CHECKING:
    from gripmon.daemon.config import Config, SecondConfig
    from gripmon.io.sources import LiveSettings

_PORTS = {"rtsp": 554, "http": 80, "https": 443, "rtmp": 1935}
_CONNECT_S = 2.0
_DOES = {"listen": "listens on", "connect": "connects to"}


def values(config: Config | SecondConfig) -> dict[str, Any]:
    """Where messages, recording and metrics go, as plain values for JSON."""
    settings, metrics = config.settings, config.settings.metrics
    return {
        "keys": f"gripmon/{settings.robot}/{settings.camera_name}/" if settings.publish.enabled else None,
        "recording": settings.recording.directory if settings.recording.enabled else None,
        "metrics": f"http://{metrics.address}:{metrics.port}/metrics" if metrics.enabled else None,
    }


def lines(report: dict[str, Any]) -> list[str]:
    """Those values in words, with the source and the network."""
    source = report["source"]
    said = {
        "source": f"{source['kind']}: {'NOT REACHABLE: ' if source['reachable'] is False else ''}{source['detail']}",
        "Zenoh": _zenoh_line(report["keys"], report["zenoh"]),
        "recording": report["recording"] or "off",
        "metrics": report["metrics"] or "off",
    }
    return [f"{name:<10} {text}" for name, text in said.items()]


def zenoh_values(config: Config | SecondConfig) -> dict[str, Any] | None:
    """How the monitor would join the network; what can't be ends the command."""
    from gripmon.daemon.config import ConfigError, SecondConfig, check_network, check_second_network

    try:
        found = check_second_network(config) if isinstance(config, SecondConfig) else check_network(config)
    except ConfigError as error:
        raise common.CommandFailedError(str(error), common.EXIT_USAGE) from None
    if found is None:
        return None
    return {**found._asdict(), "file": None if found.file is None else str(found.file)}


def source_report(config: Config | SecondConfig) -> dict[str, Any]:
    """Kind, whether frames can come from it now (None: only starting it would show), and a few words; ``odd`` where
    something about it is.
    """
    from gripmon.io.sources import LiveSettings, NetworkSettings, network_key
    from gripmon.io.wire import Keys

    source = config.settings.source
    kind = type(source).__struct_config__.tag
    if (recorded := camera_source.look_ahead(config)) is not None:
        return {"kind": kind, "reachable": True, **recorded._asdict()}
    if isinstance(source, LiveSettings):
        reachable, detail = _live_reachable(source)
        return {"kind": kind, "reachable": reachable, "detail": detail, "odd": None}
    if isinstance(source, NetworkSettings):
        key = network_key(source, Keys(config.settings.robot, config.settings.camera_name)["image"])
        detail = f"frames on {key}; only running it shows whether any arrive"
        return {"kind": kind, "reachable": None, "detail": detail, "odd": None}
    return {"kind": kind, "reachable": True, "detail": "made by this program", "odd": None}


def _live_reachable(source: LiveSettings) -> tuple[bool | None, str]:
    from gripmon.io.sources.live import shown_name

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


def _zenoh_line(keys: str | None, session: dict[str, Any] | None) -> str:
    if session is None:
        return "off"
    parts = [f"{keys}, {session['mode']}"]
    parts += [f"{does} {', '.join(session[key])}" for key, does in _DOES.items() if session[key]]
    return ", ".join(parts) + (f" (by {session['file']})" if session["file"] else "")
