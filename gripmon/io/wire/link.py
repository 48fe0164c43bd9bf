"""A session that may open later, with its waiting users; which of its connections are missing."""

from __future__ import annotations

import logging
import re
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from gripmon.io.wire.session import (
    PublishSettings,
    endpoints,
    open_session,
    value_of,
    zenoh_config,
    zenohs_words,
)

if TYPE_CHECKING:
    import zenoh

_log = logging.getLogger(__name__)
_T = TypeVar("_T")

_LOOK_EVERY_S = 1.0


class Link:
    """The process's session.

    It is open when the constructor returns, except for a client: its router may start later, so it is opened in a
    thread that retries with growing pauses.
    """

    def __init__(self, settings: PublishSettings, relative_to: Path = Path()) -> None:
        """``relative_to`` is the folder of the configuration file, to which a path in the settings is relative.

        Raises :class:`PublishError` for a configuration that can't work or an address that is already taken.
        """
        self.settings = settings
        self._lock = threading.RLock()  # guards what follows against the opening thread
        self._session: zenoh.Session | None = None
        self._declare: list[Callable[[zenoh.Session], None]] = []
        self._leave: list[Callable[[], None]] = []
        self._fault = ""
        self._closing = threading.Event()
        self._opener: threading.Thread | None = None
        self._next_look_s = 0.0
        config = zenoh_config(settings, relative_to)
        self._opening_s = 1e-3 * float(config.get_json("transport/unicast/open_timeout"))
        self._is_client = value_of(config, "mode") == "client"
        self._endpoints = endpoints(config, "connect")
        if self._is_client:
            self._fault = "no Zenoh session yet"
            self._opener = threading.Thread(
                target=self._open_until_it_works, args=(config,), name="zenoh-open", daemon=True
            )
            self._opener.start()
        else:
            self._session = open_session(config, settings)

    @property
    def connected(self) -> bool:
        """Whether there is a session; False only for a client that has not found its router yet."""
        return self._session is not None

    def fault(self) -> str:
        """Which connections are missing, in a few words for people; empty if none.

        It may be called at any rate: it checks once a second.  A client needs one connection, a peer one to each
        endpoint that it is to connect to.
        """
        session, now_s = self._session, time.monotonic()
        if session is not None and now_s >= self._next_look_s:
            self._next_look_s = now_s + _LOOK_EVERY_S
            self._look(session)
        return self._fault

    def unconnected(self) -> str:
        """The same, checked now: for the start, which waits for it."""
        self._next_look_s = 0.0
        return self.fault()

    def attach(self, declare: Callable[[zenoh.Session], None], leave: Callable[[], None] | None = None) -> None:
        """Call ``declare`` with the session: now, or in another thread when it opens; ``leave`` before it is closed.

        The first one attached is declared first and leaves last.
        """
        with self._lock:
            self._leave += [] if leave is None else [leave]
            if self._session is None:
                self._declare.append(declare)
            else:
                declare(self._session)

    def close(self) -> None:
        """Call all ``leave``, close the session and free its port.  Calling it twice does nothing more."""
        import zenoh

        self._closing.set()
        if self._opener is not None:
            # A process that ended with this thread inside Zenoh would be aborted by the interpreter.
            self._opener.join(timeout=self._opening_s + 1.0)
        with self._lock:
            session, self._session = self._session, None
            leave, self._leave = self._leave, []
            self._declare.clear()
        for last_word in reversed(leave):
            last_word()
        if session is not None:
            try:
                session.close()
            except zenoh.ZError as error:  # a stopped process blocks what is being sent
                _log.warning("the Zenoh session could not be closed in order: %s", zenohs_words(error))

    def _look(self, session: zenoh.Session) -> None:
        places = missing(session, self._endpoints, one_is_enough=self._is_client)
        fault = f"no connection to {places}, trying again" if places else ""
        if fault != self._fault:
            self._fault = fault
            _log.log(logging.WARNING if fault else logging.INFO, "Zenoh: %s", fault or "connected")

    def _adopt(self, session: zenoh.Session) -> bool:
        """Let all attached users declare; False if it came too late."""
        with self._lock:
            if self._closing.is_set():
                return False
            declare, self._declare = self._declare, []
            for each in declare:
                try:
                    each(session)
                except Exception as error:  # noqa: BLE001  one that can't be declared must not affect the others
                    _log.error("something could not be declared on the Zenoh session: %s", error)
            self._session, self._fault = session, ""
            self._next_look_s = time.monotonic() + _LOOK_EVERY_S
        return True

    def _open_until_it_works(self, config: zenoh.Config) -> None:
        import zenoh

        pause_s = self.settings.retry_first_s
        while not self._closing.is_set():
            try:
                session = zenoh.open(config)
            except zenoh.ZError as error:
                if (text := f"no Zenoh session yet, trying again: {zenohs_words(error)}") != self._fault:
                    _log.warning("%s", text)
                    self._fault = text
                self._closing.wait(pause_s)
                pause_s = min(2.0 * pause_s, self.settings.retry_longest_s)
                continue
            if self._adopt(session):
                _log.info("Zenoh session open")
            else:
                session.close()
            return


def in_zenohs_thread(take: Callable[[_T], None]) -> zenoh.handlers.Callback[_T]:
    """A callback in Zenoh's own threads: a Python thread would keep a process without ``close()`` from ending."""
    import zenoh

    return zenoh.handlers.Callback(take, indirect=False)


_LOCATOR = re.compile(r"(?P<protocol>[^/]+)/(?P<address>[^?#]*)")
_PORT = re.compile(r"(?P<host>.*):(?P<port>\d+)")
_NUMERIC = re.compile(r"[\d.]+|\[[0-9a-fA-F:.%]+\]")


def missing(session: zenoh.Session, endpoints: Iterable[str], *, one_is_enough: bool) -> str:
    """The endpoints to which the session has no link, in words; empty if none is missing.

    Takes some microseconds, without any network traffic.
    """
    far_ends = [link.dst for link in session.info.links()]
    if one_is_enough:
        return "" if far_ends else " or ".join(endpoints) or "a router"
    return ", ".join(endpoint for endpoint in endpoints if not any(is_at(far_end, endpoint) for far_end in far_ends))


def is_at(locator: str, endpoint: str) -> bool:
    """Whether a link's far end may be this endpoint.  A host's name isn't resolved: its port is enough."""
    far, named = _LOCATOR.match(locator), _LOCATOR.match(endpoint)
    if far is None or named is None or far["protocol"] != named["protocol"]:
        return False
    far_place, named_place = _PORT.fullmatch(far["address"]), _PORT.fullmatch(named["address"])
    if far_place is None or named_place is None:
        return far["address"] == named["address"]
    if far_place["port"] != named_place["port"]:
        return False
    return far_place["host"] == named_place["host"] or not _NUMERIC.fullmatch(named_place["host"])
