"""Endpoints that can't be listened on or connected to: Zenoh says of them neither which nor why, or tries for ever."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from gripmon.io.wire.files import said

if TYPE_CHECKING:
    import zenoh

_ADDRESS = re.compile(r"(?P<protocol>[^/]+)/(?P<address>[^?#]*)")
_WITH_PORT = ("tcp", "udp", "tls", "quic", "ws")
_WITH_CERTIFICATE = ("tls", "quic")
_LARGEST_PORT = 65535
_TLS = "transport/link/tls"


def endpoints(config: zenoh.Config, which: str) -> tuple[str, ...]:
    """The endpoints that a session of this configuration has, of ``listen`` or ``connect``."""
    listed = said(config, f"{which}/endpoints")
    if isinstance(listed, dict):  # a list for each mode
        listed = listed.get(said(config, "mode") or "peer")
    # Zenoh allows an object in place of a text: {"endpoints": [...], "policy": ...}; what it means, only Zenoh knows.
    return tuple(each for each in listed if isinstance(each, str)) if isinstance(listed, list) else ()


def endpoint_fault(endpoint: str, *, listens: bool = False) -> str:
    """What is wrong with an endpoint by itself, ``what is wrong; what would be right``; empty if nothing is.

    A host's name isn't looked up, and other protocols than those of IP aren't judged.
    """
    parts = _ADDRESS.match(endpoint)
    if parts is None or parts["protocol"] not in _WITH_PORT:
        return ""
    host, colon, port = parts["address"].rpartition(":")
    if not host or (host.startswith("[") and not host.endswith("]")):
        missing = "host" if colon and not host else "port"
        return f"{endpoint} has no {missing}; host and port, e.g. {parts['protocol']}/127.0.0.1:7447"
    first = 0 if listens else 1  # 0: any that is free
    if not re.fullmatch(r"[0-9]+", port) or not first <= int(port[:9]) <= _LARGEST_PORT:
        return f"{endpoint}: {port or 'nothing'} can't be a port; a whole number, {first} to {_LARGEST_PORT}"
    return ""


def endpoints_fault(config: zenoh.Config) -> tuple[str, str] | None:
    """``listen`` or ``connect``, and what is wrong with one of these endpoints; None if nothing is."""
    for which in ("listen", "connect"):
        for endpoint in endpoints(config, which):
            if fault := endpoint_fault(endpoint, listens=which == "listen"):
                return which, fault
    for endpoint in endpoints(config, "listen"):
        if endpoint.partition("/")[0] in _WITH_CERTIFICATE and not _has_certificate(config):
            right = (
                f"listen_certificate and listen_private_key of {_TLS} in a file of Zenoh's (see gripmon certificates)"
            )
            return "listen", f"{endpoint} needs a certificate; {right}"
    return None


def _has_certificate(config: zenoh.Config) -> bool:
    names = ("listen_private_key", "listen_certificate")
    # The last two forms hold the thing itself instead of a file's name.
    return all(any(said(config, f"{_TLS}/{name}{form}") for form in ("", "_base64")) for name in names)
