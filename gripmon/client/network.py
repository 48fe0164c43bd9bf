"""How those who only read join the network."""

from __future__ import annotations

from collections.abc import Sequence

from gripmon.wire import PublishSettings


def reader_settings(connect: Sequence[str], zenoh_config_file: str | None) -> PublishSettings:
    """Connects to these endpoints and listens nowhere; or as a file of Zenoh's says."""
    if zenoh_config_file is not None:
        return PublishSettings(zenoh_config=zenoh_config_file)
    return PublishSettings(listen=(), connect=tuple(connect))
