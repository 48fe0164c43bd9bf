"""What a person may set about the network, and the names of the keys."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated, Literal

import msgspec

from gripmon.model.errors import InputError

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
_ENDPOINT_PATTERN = r"^(tcp|udp|tls|quic|ws|serial|unixsock-stream|unixpipe|vsock)/\S+$"
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
        self.key, self.text = key, text


class PublishSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How to join the network.  The default is a peer that listens on loopback only and looks for nobody."""

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
        bool, msgspec.Meta(description="true: whoever reaches the network may send commands (gripmon send)")
    ] = True
    multicast_scouting: Annotated[bool, msgspec.Meta(description="look for others by UDP multicast")] = False
    zenoh_config: Annotated[
        str | None, msgspec.Meta(description="path of a file of Zenoh's (json5, yaml) instead of the keys above")
    ] = None
    retry_first_s: Annotated[
        float, msgspec.Meta(gt=0.0, description="whom to connect to isn't there, or is gone: first pause (s)")
    ] = 0.1
    retry_longest_s: Annotated[float, msgspec.Meta(gt=0.0, description="longest such pause; they double (s)")] = 1.0
    jaw_max_age_s: Annotated[
        float, msgspec.Meta(gt=0.0, description="a jaw opening received longer ago than this is not used (s)")
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


def form_fault(endpoint: object) -> str:
    """What is wrong with an endpoint's form, and what would be right; empty if it can be one."""
    if not isinstance(endpoint, str) or not re.fullmatch(_ENDPOINT_PATTERN.rstrip("$"), endpoint):
        return f"{endpoint!r} is no endpoint; protocol/address, e.g. {DEFAULT_ENDPOINT}"
    return ""


def check_name(role: str, name: str) -> str:
    """The name; raises ValueError unless it can be one chunk of a Zenoh key."""
    if not _NAME.fullmatch(name):
        raise ValueError(
            f"{role} name {name!r} can't be part of a Zenoh key; give at least one character, none of them a space or "
            "one of / * $ # ?, and no @ in front"
        )
    return name


def check_key(key: str) -> str:
    """The key; raises ValueError unless it is one that can be put on: a pattern might be many monitors' keys."""
    if not re.match(KEY_PATTERN, key):
        raise ValueError(f"key {key!r} is none; names with / between them, none empty, without * $ # ? or blanks")
    return key
