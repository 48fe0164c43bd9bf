"""The one Zenoh session of a process, its settings, and the names of the keys: what everyone who talks to the network
shares.
"""

from __future__ import annotations

from gripmon.io.wire.files import ZenohFileError
from gripmon.io.wire.link import Link
from gripmon.io.wire.router import Router
from gripmon.io.wire.session import Joining, joining, open_session, zenoh_config
from gripmon.io.wire.settings import DEFAULT_ENDPOINT, Keys, PublishError, PublishSettings, check_name
from gripmon.io.wire.steady import CLOCK_PARAMETER, MOST_DRIFT, steady_ns

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
    "joining",
    "open_session",
    "steady_ns",
    "zenoh_config",
]
