"""Looking at a running monitor: settings."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

LOOPBACK = "127.0.0.1"


class ViewSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How ``gripmon run --view`` serves viewers: on this machine only."""

    port: Annotated[int, Meta(ge=1, le=65535, description="TCP port on 127.0.0.1 for rerun viewers (no unit)")] = 9876
    web_port: Annotated[
        int, Meta(ge=1, le=65535, description="TCP port on 127.0.0.1 of the page with the web viewer (no unit)")
    ] = 9090
    memory_limit_bytes: Annotated[
        int,
        Meta(
            ge=10_000_000,
            le=64_000_000_000,
            description="what is kept for viewers that join late or fall behind; the oldest goes (bytes)",
        ),
    ] = 300_000_000

    @property
    def stream_url(self) -> str:
        """What a viewer connects to."""
        return f"rerun+http://{LOOPBACK}:{self.port}/proxy"
