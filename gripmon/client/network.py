"""How those who listen join the network, and whose messages they hear."""

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
    """One start of a monitor: the process that speaks under its name; without an id from a version before ids."""

    monitor: MonitorName
    monitor_id: str

    def __str__(self) -> str:
        return f"{self.monitor} ({self.monitor_id or 'of an earlier version'})"


def start_of(key: object) -> Start:
    """Which start shows the liveliness token ``gripmon/<robot>/<camera>/alive/<id>``."""
    return Start(monitor_name(key), str(key).rpartition("/")[2])


def monitor_name(key: object) -> MonitorName:
    """Who a message on this key, ``gripmon/<robot>/<camera>/…``, is from."""
    _, robot, camera, *_ = str(key).split("/")
    return MonitorName(robot, camera)


def reader_settings(connect: str | Sequence[str], zenoh_config_file: str | None) -> PublishSettings:
    """Connects to these endpoints, a text being one of them, and listens nowhere; or as a file of Zenoh's says."""
    if zenoh_config_file is not None:
        return PublishSettings(zenoh_config=zenoh_config_file)
    return PublishSettings(listen=(), connect=(connect,) if isinstance(connect, str) else tuple(connect))


def where_of(settings: PublishSettings) -> str:
    """Whom a reader connects to, for a person."""
    file = settings.zenoh_config
    return " or ".join(settings.connect) if file is None else f"what {file} names"


@contextmanager
def named_as_arguments() -> Iterator[None]:
    """A :class:`PublishError` names the argument of a client, not the key of the daemon's configuration."""
    try:
        yield
    except PublishError as error:
        raise PublishError(error.key, error.text, _ARGUMENTS.get(error.key, error.key)) from error


class Listener:
    """What every client has: it is closed at the end of a ``with`` statement, and calls back in threads of its own."""

    def __init__(self) -> None:
        self._threads: list[threading.Thread] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Wait for callbacks that are at work, unless this is called in one."""
        if threading.current_thread() not in self._threads:  # two callbacks that close would wait for each other
            for thread in self._threads:
                thread.join()

    def _call_back(self, callback: Callable[[_T], None], values: Iterable[_T]) -> None:
        def pump() -> None:
            for value in values:
                callback(value)

        self._threads.append(threading.Thread(target=pump, name="gripmon-client", daemon=True))
        self._threads[-1].start()
