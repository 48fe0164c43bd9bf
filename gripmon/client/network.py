"""How clients join the network, and the names in keys."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple, Self, TypeVar

from gripmon.io.wire import PublishError, PublishSettings

_ARGUMENTS = {"zenoh_config": "zenoh_config_file"}
_T = TypeVar("_T")


class MonitorName(NamedTuple):
    """The second and third part of every key."""

    robot: str
    camera: str

    def __str__(self) -> str:
        return f"{self.robot}/{self.camera}"


class Start(NamedTuple):
    """One start of a monitor, which is one process; versions before ids have an empty one."""

    monitor: MonitorName
    monitor_id: str

    def __str__(self) -> str:
        return f"{self.monitor} ({self.monitor_id or 'of an earlier version'})"


def start_of(key: object) -> Start:
    """The start that owns the liveliness token ``gripmon/<robot>/<camera>/alive/<id>``."""
    return Start(monitor_name(key), str(key).rpartition("/")[2])


def monitor_name(key: object) -> MonitorName:
    """The sender of a message on the key ``gripmon/<robot>/<camera>/…``."""
    _, robot, camera, *_ = str(key).split("/")
    return MonitorName(robot, camera)


def reader_settings(connect: str | Sequence[str], zenoh_config_file: str | None) -> PublishSettings:
    """Connect to these endpoints (a text is a single one) without listening; or as a Zenoh file says."""
    if zenoh_config_file is not None:
        return PublishSettings(zenoh_config=zenoh_config_file)
    return PublishSettings(listen=(), connect=(connect,) if isinstance(connect, str) else tuple(connect))


def where_of(settings: PublishSettings) -> str:
    """The endpoints that a reader connects to, for messages."""
    file = settings.zenoh_config
    return " or ".join(settings.connect) if file is None else f"what {file} names"


@contextmanager
def named_as_arguments() -> Iterator[None]:
    """Make a :class:`PublishError` name a client's argument instead of the daemon's configuration key."""
    try:
        yield
    except PublishError as error:
        raise PublishError(error.key, error.text, _ARGUMENTS.get(error.key, error.key)) from error


class Listener:
    """Base of all clients: a context manager that closes itself, with callbacks in separate threads."""

    def __init__(self) -> None:
        self._threads: list[threading.Thread] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Wait for running callbacks, unless this is called from one."""
        if threading.current_thread() not in self._threads:  # two callbacks that both close would wait for each other
            for thread in self._threads:
                thread.join()

    def _call_back(self, callback: Callable[[_T], None], values: Iterable[_T]) -> None:
        def pump() -> None:
            for value in values:
                callback(value)

        self._threads.append(threading.Thread(target=pump, name="gripmon-client", daemon=True))
        self._threads[-1].start()
