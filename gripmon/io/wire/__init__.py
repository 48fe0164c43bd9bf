"""The one Zenoh session of a process, its settings, and the names of the keys: shared by everything on the
network.
"""

from __future__ import annotations

from gripmon.io.wire.link import Link, in_zenohs_thread
from gripmon.io.wire.router import Router
from gripmon.io.wire.session import (
    CLOCK_PARAMETER,
    DEFAULT_ENDPOINT,
    MOST_DRIFT,
    Joining,
    Keys,
    PublishError,
    PublishSettings,
    ZenohFileError,
    check_name,
    joining,
    open_session,
    steady_ns,
    zenoh_config,
)

__all__ = [
    "CLOCK_PARAMETER",
    "DEFAULT_ENDPOINT",
    "MOST_DRIFT",
    "Joining",
    "Keys",
    "Link",
    "PublishError",
    "PublishSettings",
    "Router",
    "ZenohFileError",
    "check_name",
    "in_zenohs_thread",
    "joining",
    "open_session",
    "steady_ns",
    "zenoh_config",
]
