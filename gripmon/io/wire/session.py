"""From settings to an open Zenoh session, with errors that name the key."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import msgspec

from gripmon.io.wire.endpoints import endpoints, endpoints_fault
from gripmon.io.wire.files import ZenohFileError, load_file, said
from gripmon.io.wire.settings import PublishError, PublishSettings, form_fault
from gripmon.io.wire.zenoh_errors import in_short

if TYPE_CHECKING:
    import zenoh

_SEND_BUFFER_BYTES = 8192
"""Linux takes twice this, with its own overhead: three or four transforms of 2.7 kB.  Half of it would be less than
two, so that each waits for the far end's word that it has the one before.
"""


def zenoh_config(settings: PublishSettings, relative_to: Path = Path()) -> zenoh.Config:
    """Zenoh's own configuration for these settings; a path in them counts from ``relative_to``.

    Raises :class:`PublishError`.
    """
    import zenoh

    defaults = PublishSettings()
    if settings.zenoh_config is not None:
        for key in ("mode", "listen", "connect", "multicast_scouting"):
            if getattr(settings, key) != getattr(defaults, key):
                raise PublishError(key, "has no effect beside publish.zenoh_config; say it in that file")
        path = relative_to / settings.zenoh_config
        try:
            config = load_file(path)
        except ZenohFileError as error:
            raise PublishError("zenoh_config", str(error)) from error
        if fault := endpoints_fault(config):
            raise PublishError("zenoh_config", f"{path}: {fault[0]}/endpoints: {fault[1]}")
        return config
    if settings.mode == "client" and not (settings.connect or settings.multicast_scouting):
        raise PublishError("connect", "a client needs a router; give its endpoint, e.g. tcp/192.168.1.2:7447")
    for key in ("listen", "connect"):
        for endpoint in getattr(settings, key):
            if wrong := form_fault(endpoint):
                raise PublishError(key, wrong)
    config = zenoh.Config()
    listen = settings.listen if settings.mode == "peer" else ()
    entries = {
        "mode": settings.mode,
        "listen/endpoints": listen,
        "listen/exit_on_failure": True,
        "connect/endpoints": settings.connect,
        # Also when a router restarts: Zenoh's own pauses, up to 4 s, would be several seconds without a transform.
        "connect/retry": {
            "period_init_ms": math.ceil(1e3 * settings.retry_first_s),
            "period_max_ms": math.ceil(1e3 * settings.retry_longest_s),
            "period_increase_factor": 2,
        },
        "scouting/multicast/enabled": settings.multicast_scouting,
        # Somebody's endless message must not fill the memory; an image of 20 megapixels passes.
        "transport/link/rx/max_message_size": 64 << 20,
        # Images gain by shared memory; transforms, 3 KiB, don't, and each sender costs its reader a pool of 16 MiB.
        "transport/shared_memory/transport_optimization/message_size_threshold": 64 << 10,
        # Where a link can't carry the rate, what waits here makes every transform old: a few messages and not
        # megabytes, the rest is dropped.  On loopback it costs no latency; a snapshot of 10 MB still takes 0.1 s.
        "transport/link/tcp/so_sndbuf": _SEND_BUFFER_BYTES,
        "transport/link/tls/so_sndbuf": _SEND_BUFFER_BYTES,
        # An endpoint that takes the connection and says nothing: closing waits for the attempt under way.
        "transport/unicast/open_timeout": 3000,
    }
    for key, value in entries.items():
        try:
            config.insert_json5(key, msgspec.json.encode(value).decode())
        except zenoh.ZError as error:
            raise PublishError(key.split("/")[0], in_short(error)) from error
    if fault := endpoints_fault(config):
        raise PublishError(*fault)
    return config


class Joining(NamedTuple):
    """How a session would join the network: its mode, its endpoints, and the file of Zenoh's that says so, if any."""

    mode: str
    listen: tuple[str, ...]
    connect: tuple[str, ...]
    file: Path | None


def joining(settings: PublishSettings, relative_to: Path = Path()) -> Joining:
    """What :func:`zenoh_config` comes to, without a session.  Raises :class:`PublishError`."""
    config = zenoh_config(settings, relative_to)
    file = None if settings.zenoh_config is None else relative_to / settings.zenoh_config
    return Joining(str(said(config, "mode")), endpoints(config, "listen"), endpoints(config, "connect"), file)


def open_session(config: zenoh.Config, settings: PublishSettings) -> zenoh.Session:
    """Raises :class:`PublishError` that names the key."""
    import zenoh

    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        keys = [key for key in ("listen", "connect") if getattr(settings, key)]
        if settings.zenoh_config is not None:
            keys = ["zenoh_config"]
        if taken := re.search(r"bound to ([^\s#]+)\S*: .*Address already in use", str(error)):
            remedy = "stop the program that has it, or choose another port"
            raise PublishError(keys[0], f"{taken[1]} is already in use; {remedy}") from error
        text = f"can't open a Zenoh session: {in_short(error)}"
        raise PublishError(" or publish.".join(keys), text) from error
