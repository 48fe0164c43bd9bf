"""From settings to an open Zenoh session, with errors that name the key; the names of the keys, and a clock for
bounding a message's age.
"""

from __future__ import annotations

import math
import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec

from gripmon.model.errors import InputError

if TYPE_CHECKING:
    import zenoh

_SEND_BUFFER_BYTES = 8192
"""Linux allocates twice this, including its overhead: three or four transforms of 2.7 kB.  With half of it, fewer than
two, each transform would wait for the acknowledgement of the previous one.
"""


def zenoh_config(settings: PublishSettings, relative_to: Path = Path()) -> zenoh.Config:
    """Zenoh's own configuration for these settings; a path in them is relative to ``relative_to``.

    Raises :class:`PublishError`.
    """
    import zenoh

    defaults = PublishSettings()
    if settings.zenoh_config is not None:
        for key in ("mode", "listen", "connect", "multicast_scouting"):
            if getattr(settings, key) != getattr(defaults, key):
                raise PublishError(key, "has no effect beside publish.zenoh_config; set it in that file")
        path = relative_to / settings.zenoh_config
        try:
            config = load_file(path)
        except ZenohFileError as error:
            raise PublishError("zenoh_config", str(error)) from error
        return config
    if settings.mode == "client" and not (settings.connect or settings.multicast_scouting):
        raise PublishError("connect", "a client needs a router; give its endpoint, e.g. tcp/192.168.1.2:7447")
    for key in ("listen", "connect"):
        for endpoint in getattr(settings, key):
            if wrong := endpoint_fault(endpoint):
                raise PublishError(key, wrong)
    config = zenoh.Config()
    listen = settings.listen if settings.mode == "peer" else ()
    entries = {
        "mode": settings.mode,
        "listen/endpoints": listen,
        "listen/exit_on_failure": True,
        "connect/endpoints": settings.connect,
        # Also when a router restarts: Zenoh's default pauses, up to 4 s, would mean seconds without a transform.
        "connect/retry": {
            "period_init_ms": math.ceil(1e3 * settings.retry_first_s),
            "period_max_ms": math.ceil(1e3 * settings.retry_longest_s),
            "period_increase_factor": 2,
        },
        "scouting/multicast/enabled": settings.multicast_scouting,
        # An endless message must not fill the memory; an image of 20 megapixels passes.
        "transport/link/rx/max_message_size": 64 << 20,
        # Images gain by shared memory; transforms, 3 KiB, don't, and each sender costs its reader a pool of 16 MiB.
        "transport/shared_memory/transport_optimization/message_size_threshold": 64 << 10,
        # On a link that can't carry the rate, queued data makes every transform old: keep a few messages, not
        # megabytes, and drop the rest.  On loopback it costs no latency; a snapshot of 10 MB still takes 0.1 s.
        "transport/link/tcp/so_sndbuf": _SEND_BUFFER_BYTES,
        "transport/link/tls/so_sndbuf": _SEND_BUFFER_BYTES,
        # For an endpoint that accepts the connection and stays silent: closing waits for the pending attempt.
        "transport/unicast/open_timeout": 3000,
    }
    for key, value in entries.items():
        try:
            config.insert_json5(key, msgspec.json.encode(value).decode())
        except zenoh.ZError as error:
            raise PublishError(key.split("/")[0], zenohs_words(error)) from error
    return config


class Joining(msgspec.Struct, frozen=True):
    """How a session would join the network: its mode, its endpoints, and the Zenoh file that defines them, if any."""

    mode: str
    listen: tuple[str, ...]
    connect: tuple[str, ...]
    file: str | None


def joining(settings: PublishSettings, relative_to: Path = Path()) -> Joining:
    """The result of :func:`zenoh_config`, without a session.  Raises :class:`PublishError`."""
    config = zenoh_config(settings, relative_to)
    file = None if settings.zenoh_config is None else str(relative_to / settings.zenoh_config)
    return Joining(str(value_of(config, "mode")), endpoints(config, "listen"), endpoints(config, "connect"), file)


def open_session(config: zenoh.Config, settings: PublishSettings) -> zenoh.Session:
    """Open a session.  Raises :class:`PublishError` that names the key."""
    import zenoh

    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        keys = [key for key in ("listen", "connect") if getattr(settings, key)]
        if settings.zenoh_config is not None:
            keys = ["zenoh_config"]
        said = zenohs_words(error)
        right = _ANOTHER_PORT if "Address already in use" in said else ""
        raise PublishError(" or publish.".join(keys), f"can't open a Zenoh session: {said}{right}") from error


DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
_ANOTHER_PORT = (
    "; each monitor on this computer listens on a port of its own, such as tcp/127.0.0.1:7448, or all connect to a "
    "router (gripmon router, publish.mode: client)"
)
_ENDPOINT_PATTERN = (
    r"^((tcp|udp|tls|quic|ws)/(\[[^\]\s]+\]|[^:/\[\]\s]+):(?P<port>\d{1,5})([?#]\S*)?"
    r"|(serial|unixsock-stream|unixpipe|vsock)/\S+)(?![\s\S])"
)
_NAME = re.compile(r"[^/*$#?@\s][^/*$#?\s]*")
KEY_PATTERN = r"^[^/*$#?\s]+(/[^/*$#?\s]+)*(?![\s\S])"
"""A key as one may put on it: no wildcards, no blanks."""

Endpoint = Annotated[
    str, msgspec.Meta(pattern=_ENDPOINT_PATTERN, description="a Zenoh endpoint, e.g. tcp/127.0.0.1:7447")
]


class PublishError(InputError):
    """The session can't be opened as configured; the text is ``key: what is wrong; what would be right``.

    ``key`` is the one of the section ``publish``; ``text`` what follows it, for those who call it by another name.
    """

    def __init__(self, key: str, text: str, name: str = "") -> None:
        super().__init__(f"{name or f'publish.{key}'}: {text}")
        self.key, self.text, self._name = key, text, name

    def __reduce__(self) -> tuple[type[PublishError], tuple[str, str, str]]:
        return PublishError, (self.key, self.text, self._name)  # what was wrong also reaches another process


class PublishSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How to join the network.  The default is a peer that listens on loopback only and does not look for others."""

    enabled: Annotated[bool, msgspec.Meta(description="false: nothing is published")] = True
    mode: Annotated[
        Literal["peer", "client"],
        msgspec.Meta(description="peer: listens and connects; client: connects to a router, and waits for it"),
    ] = "peer"
    listen: Annotated[tuple[Endpoint, ...], msgspec.Meta(description="where a peer listens; empty: nowhere")] = (
        DEFAULT_ENDPOINT,
    )
    connect: Annotated[tuple[Endpoint, ...], msgspec.Meta(description="peers or routers to connect to")] = ()
    commands: Annotated[
        bool, msgspec.Meta(description="true: anyone on the network may send commands (gripmon send)")
    ] = True
    multicast_scouting: Annotated[bool, msgspec.Meta(description="discover peers by UDP multicast")] = False
    zenoh_config: Annotated[
        str | None,
        msgspec.Meta(description="path of a Zenoh configuration file (json5, yaml) that replaces the keys above"),
    ] = None
    retry_first_s: Annotated[
        float, msgspec.Meta(gt=0.0, description="first pause before an attempt to connect again (s)")
    ] = 0.1
    retry_longest_s: Annotated[
        float, msgspec.Meta(gt=0.0, description="longest such pause; each is twice the one before (s)")
    ] = 1.0
    jaw_max_age_s: Annotated[
        float,
        msgspec.Meta(gt=0.0, description="time since its arrival after which a jaw opening is no longer used (s)"),
    ] = 1.0


@dataclass(frozen=True, slots=True)
class Keys:
    """The keys of one monitor: ``Keys("arm", "wrist")["state"]``.  For readers a name may be ``*``: any."""

    robot: str
    camera: str

    def __post_init__(self) -> None:
        for role, name in (("robot", self.robot), ("camera", self.camera)):
            if name != "*":
                check_name(role, name)

    def __getitem__(self, leaf: str) -> str:
        return f"gripmon/{self.robot}/{self.camera}/{leaf}"


def endpoint_fault(endpoint: object) -> str:
    """What is wrong with an endpoint's form, and what would be right; empty if nothing is."""
    form = re.match(_ENDPOINT_PATTERN, endpoint) if isinstance(endpoint, str) else None
    if form is None or int(form["port"] or 0) > _LARGEST_PORT:
        return f"{endpoint!r} is not an endpoint; protocol/host:port, e.g. {DEFAULT_ENDPOINT}"
    return ""


_LARGEST_PORT = 65535


def check_name(role: str, name: str) -> str:
    """The name; raises ValueError unless it can be one chunk of a Zenoh key."""
    if not _NAME.fullmatch(name):
        raise ValueError(
            f"{role} name {name!r} can't be part of a Zenoh key; give at least one character, none of them a space or "
            "one of / * $ # ?, and no @ in front"
        )
    return name


def check_key(key: str) -> str:
    """The key; raises ValueError if it is invalid or a pattern, which might match several monitors' keys."""
    if not re.match(KEY_PATTERN, key):
        raise ValueError(f"key {key!r} isn't a key; names with / between them, none empty, without * $ # ? or blanks")
    return key


MOST_DRIFT = 1e-3
"""Largest relative drift of two such clocks: 500 ppm each.  NTP can't correct more (``MAXFREQ`` of Linux), so such a
machine could not keep time.  Quartz has some 50 ppm.
"""

CLOCK_PARAMETER = "clock"
"""A query for ``…/transform?clock`` returns a reading of the monitor's steady clock."""


def steady_ns() -> int:
    """Nanoseconds since an arbitrary time, the same for all processes of a machine until it restarts.

    Nobody sets it, NTP and PTP don't slew it (``CLOCK_BOOTTIME`` they do, by up to 8 % with chrony), and it goes on
    while the machine is suspended (in which ``CLOCK_MONOTONIC_RAW`` stands still).
    """
    read, awake, all_time = time.clock_gettime_ns, time.CLOCK_MONOTONIC, time.CLOCK_BOOTTIME
    # Read one after the other, these two differ by too little if the process is interrupted between them.
    asleep_ns = max(read(all_time) - read(awake), read(all_time) - read(awake), read(all_time) - read(awake))
    return read(time.CLOCK_MONOTONIC_RAW) + asleep_ns


_TLS = "transport/link/tls"
_TLS_FILES = (
    "root_ca_certificate",
    "listen_private_key",
    "listen_certificate",
    "connect_private_key",
    "connect_certificate",
)
_SECRETS = ("listen_private_key", "connect_private_key")


class ZenohFileError(InputError):
    """The file can't be used; the text is one line, ``file: key: what is wrong; what would be right``."""


def load_file(path: Path, default_mode: str = "peer") -> zenoh.Config:
    """The configuration in a json5 or yaml file.

    Its TLS files are relative to its folder.  By default Zenoh would listen on all interfaces and scout by multicast;
    with gripmon it does neither.  Raises :class:`ZenohFileError`.
    """
    import zenoh

    if not path.is_file():
        raise ZenohFileError(f"no file {path}; give a json5 or yaml file of Zenoh's")
    try:
        config = zenoh.Config.from_file(path)
    except zenoh.ZError as error:
        raise ZenohFileError(f"{path}: {zenohs_words(error)}; a file of Zenoh's, as in configs/zenoh") from error
    if value_of(config, "mode") is None:
        config.insert_json5("mode", _json(default_mode))
    if value_of(config, "listen/endpoints") == value_of(zenoh.Config(), "listen/endpoints"):
        config.insert_json5("listen/endpoints", "[]")
    if value_of(config, "scouting/multicast/enabled") is None:
        config.insert_json5("scouting/multicast/enabled", "false")
    _find_tls_files(config, path)
    return config


def value_of(config: zenoh.Config, key: str) -> object:
    """The value of a key, as plain Python values."""
    return msgspec.json.decode(config.get_json(key))


def _find_tls_files(config: zenoh.Config, path: Path) -> None:
    for name in _TLS_FILES:
        key = f"{_TLS}/{name}"
        value = value_of(config, key)
        if not isinstance(value, str):
            continue
        file = path.parent / value
        if not file.is_file():
            raise ZenohFileError(f"{path}: {key}: no file {file}; docs/howto/security.md shows how to make it")
        if name in _SECRETS and file.stat().st_mode & 0o077:
            raise ZenohFileError(f"{path}: {key}: others may read {file}; chmod 600 {file}")
        config.insert_json5(key, _json(str(file.resolve())))


def _json(value: str) -> str:
    return msgspec.json.encode(value).decode()


_SOURCE_PLACE = re.compile(r"\s+at \S+\.rs:\d+\.?")


def zenohs_words(error: zenoh.ZError) -> str:
    """Zenoh's message on one line, without the places in its source files."""
    return " ".join(_SOURCE_PLACE.sub("", str(error)).split())


def endpoints(config: zenoh.Config, which: str) -> tuple[str, ...]:
    """The endpoints that a session of this configuration has, of ``listen`` or ``connect``."""
    listed = value_of(config, f"{which}/endpoints")
    if isinstance(listed, dict):  # a list for each mode
        listed = listed.get(value_of(config, "mode") or "peer")
    # Zenoh also allows an object here: {"endpoints": [...], "policy": ...}; only Zenoh interprets it.
    return tuple(each for each in listed if isinstance(each, str)) if isinstance(listed, list) else ()
