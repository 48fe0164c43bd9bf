"""How clients join the network and leave it, and the names in keys."""

from __future__ import annotations

import os
import threading
import weakref
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple, Self, TypeVar

import zenoh

from gripmon.io.wire import Link, PublishError, PublishSettings
from gripmon.model.records import CommandFault

_T = TypeVar("_T")
FORKED = "this process was forked from the one that opened the client; open another one here"


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


class NotCarriedOut(Exception):
    """A command got no reply from the monitor: it isn't there, or it had no time; ``fault`` says which.

    A refusal is not an exception but a reply with ``CommandReply.done`` false.  A command that is sent again with the
    same ``request_id`` is not carried out twice.
    """

    def __init__(self, text: str, fault: CommandFault | None = None, request_id: str = "") -> None:
        super().__init__(text)
        self.fault, self.request_id = fault, request_id


class Joined:
    """Base of all clients: a context manager that joins the network when there is somebody to talk to, closes itself,
    and calls back in separate threads.

    Zenoh's threads don't survive a fork: in the child everything of a client says so, and nothing waits.
    """

    def __init__(self, connect: str | Sequence[str], zenoh_config_file: str | None) -> None:
        """``connect``: endpoints of a monitor or a router; a text is a single one; we don't listen.

        ``zenoh_config_file``: a Zenoh configuration file instead.  Raises :class:`gripmon.io.wire.PublishError`.
        """
        endpoints = (connect,) if isinstance(connect, str) else tuple(connect)
        settings = PublishSettings(listen=(), connect=endpoints)
        if zenoh_config_file is not None:
            settings = PublishSettings(zenoh_config=zenoh_config_file)
        self.where = " or ".join(endpoints) if zenoh_config_file is None else f"what {zenoh_config_file} names"
        self.forked = False
        self._threads: list[threading.Thread] = []
        self._session: zenoh.Session | None = None
        self._opened = threading.Event()
        try:
            self._link = Link(settings)
        except PublishError as error:  # name the argument instead of the daemon's configuration key
            argument = {"zenoh_config": "zenoh_config_file"}.get(error.key, error.key)
            raise PublishError(error.key, error.text, argument) from error
        _OPEN.add(self)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the network, and wait for running callbacks unless this is called from one."""
        if self.forked:
            return
        self._link.close()
        if threading.current_thread() not in self._threads:  # two callbacks that both close would wait for each other
            for thread in self._threads:
                thread.join()

    def fault(self) -> str:
        """Why there is no connection, in a few words; empty if there is one.  At any rate: it looks once a second."""
        if self.forked:
            return FORKED
        try:
            return self._link.fault()
        except zenoh.ZError:  # another thread is closing the session
            return "the client is being closed"

    def session(self, timeout_s: float = 0.0) -> zenoh.Session:
        """The session, once there is one.  Raises :class:`NotCarriedOut`."""
        if self.forked:
            raise NotCarriedOut(FORKED)
        self._opened.wait(timeout_s)
        if self._session is None:
            raise NotCarriedOut(f"there is no connection to {self.where}: {self._link.fault()}")
        return self._session

    def _join(self) -> None:
        """Join now, or in another thread when a router answers; a subclass calls it when it is complete."""

        def declare(session: zenoh.Session) -> None:
            self._session = session
            self._declared = self._declare(session)  # Zenoh undeclares what is no longer referenced
            self._opened.set()

        self._link.attach(declare)

    def _declare(self, session: zenoh.Session) -> Sequence[object]:
        """Subscribe; returns what has to be kept."""
        raise NotImplementedError

    def _after_fork(self) -> None:
        """In the child, which has only the thread that forked: locks may be held by threads that aren't there."""
        self.forked, self._threads = True, []

    def _call_back(self, callback: Callable[[_T], None], values: Iterable[_T]) -> None:
        def pump() -> None:
            for value in values:
                callback(value)

        self._threads.append(threading.Thread(target=pump, name="gripmon-client", daemon=True))
        self._threads[-1].start()


_OPEN: weakref.WeakSet[Joined] = weakref.WeakSet()


def _leave_all() -> None:
    for client in list(_OPEN):
        client._after_fork()


os.register_at_fork(after_in_child=_leave_all)
