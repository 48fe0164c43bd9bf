"""Whom a session should be connected to, and isn't."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import zenoh


_LOCATOR = re.compile(r"(?P<protocol>[^/]+)/(?P<address>[^?#]*)")
_PORT = re.compile(r"(?P<host>.*):(?P<port>\d+)")
_NUMERIC = re.compile(r"[\d.]+|\[[0-9a-fA-F:.%]+\]")


def missing(session: zenoh.Session, endpoints: Iterable[str], *, one_is_enough: bool) -> str:
    """Whom of these the session has no link to, in words; empty if that is as it should be.

    Takes some microseconds: the session only looks at what it knows.
    """
    far_ends = [link.dst for link in session.info.links()]
    if one_is_enough:
        return "" if far_ends else " or ".join(endpoints) or "a router"
    return ", ".join(endpoint for endpoint in endpoints if not any(is_at(far_end, endpoint) for far_end in far_ends))


def is_at(locator: str, endpoint: str) -> bool:
    """Can a link's far end be what this endpoint names?  A host's name isn't looked up: its port is enough."""
    far, named = _LOCATOR.match(locator), _LOCATOR.match(endpoint)
    if far is None or named is None or far["protocol"] != named["protocol"]:
        return False
    far_place, named_place = _PORT.fullmatch(far["address"]), _PORT.fullmatch(named["address"])
    if far_place is None or named_place is None:
        return far["address"] == named["address"]
    if far_place["port"] != named_place["port"]:
        return False
    return far_place["host"] == named_place["host"] or not _NUMERIC.fullmatch(named_place["host"])
