"""What a person may set about metrics."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta


class MetricsSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where Prometheus finds the metrics: ``http://<address>:<port>/metrics``."""

    enabled: Annotated[bool, Meta(description="true: metrics for Prometheus over HTTP")] = False
    address: Annotated[
        str,
        Meta(min_length=1, description="where to listen; whoever reaches it may read, 0.0.0.0 is every network"),
    ] = "127.0.0.1"
    port: Annotated[int, Meta(ge=1, le=65535, description="TCP port, one for each monitor of a machine (no unit)")] = (
        9464
    )
