"""The one Zenoh session of a process, its settings, and the names of the keys: what everyone who talks to the network
shares.
"""

from __future__ import annotations

from gripmon.wire.files import ZenohFileError
from gripmon.wire.link import Link
from gripmon.wire.router import Router
from gripmon.wire.session import Joining, joining, open_session, zenoh_config
from gripmon.wire.settings import DEFAULT_ENDPOINT, Keys, PublishError, PublishSettings, check_name
from gripmon.wire.steady import CLOCK_PARAMETER, MOST_DRIFT, steady_ns

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
