"""How those who only read join the network."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from gripmon.io.wire import PublishError, PublishSettings

_ARGUMENTS = {"zenoh_config": "zenoh_config_file"}


def reader_settings(connect: str | Sequence[str], zenoh_config_file: str | None) -> PublishSettings:
    """Connects to these endpoints, a text being one of them, and listens nowhere; or as a file of Zenoh's says."""
    if zenoh_config_file is not None:
        return PublishSettings(zenoh_config=zenoh_config_file)
    return PublishSettings(listen=(), connect=(connect,) if isinstance(connect, str) else tuple(connect))


@contextmanager
def named_as_arguments() -> Iterator[None]:
    """A :class:`PublishError` names the argument of a client, not the key of the daemon's configuration."""
    try:
        yield
    except PublishError as error:
        raise PublishError(error.key, error.text, _ARGUMENTS.get(error.key, error.key)) from error
