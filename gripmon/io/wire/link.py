"""A session that may open later, and those who wait for it."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from gripmon.io.wire.endpoints import endpoints
from gripmon.io.wire.files import said
from gripmon.io.wire.reach import missing
from gripmon.io.wire.session import open_session, zenoh_config
from gripmon.io.wire.settings import PublishSettings
from gripmon.io.wire.zenoh_errors import in_short

if TYPE_CHECKING:
    import zenoh

_log = logging.getLogger(__name__)

_LOOK_EVERY_S = 1.0


class Link:
    """The process's session.

    It is open when the constructor returns, except for a client: its router may come later, so it is opened in a thread
    that tries again with growing pauses.
    """

    def __init__(self, settings: PublishSettings, relative_to: Path = Path()) -> None:
        """``relative_to`` is the folder of the configuration file, from which a path in the settings counts.

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
        self._is_client = said(config, "mode") == "client"
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
        """Is there a session?  False only for a client that has not found its router yet."""
        return self._session is not None

    def fault(self) -> str:
        """Whom there is no connection to, in a few words for a person; empty if all is well.

        It may be asked all the time: once a second it looks.  A client needs one connection, a peer one to each
        endpoint that it is to connect to.
        """
        session, now_s = self._session, time.monotonic()
        if session is not None and now_s >= self._next_look_s:
            self._next_look_s = now_s + _LOOK_EVERY_S
            self._look(session)
        return self._fault

    def unconnected(self) -> str:
        """The same as of this moment: for a start, which waits for it."""
        self._next_look_s = 0.0
        return self.fault()

    def attach(self, declare: Callable[[zenoh.Session], None], leave: Callable[[], None] | None = None) -> None:
        """Call ``declare`` with the session: now, or in another thread when it opens; ``leave`` before it is closed.

        What is attached first is declared first and leaves last.
        """
        with self._lock:
            self._leave += [] if leave is None else [leave]
            if self._session is None:
                self._declare.append(declare)
            else:
                declare(self._session)

    def close(self) -> None:
        """Tell everyone attached, close the session and free its port.  Calling it twice does nothing more."""
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
            except zenoh.ZError as error:  # somebody who was stopped holds up what is being sent
                _log.warning("the Zenoh session could not be closed in order: %s", in_short(error))

    def _look(self, session: zenoh.Session) -> None:
        places = missing(session, self._endpoints, one_is_enough=self._is_client)
        fault = f"no connection to {places}, trying again" if places else ""
        if fault != self._fault:
            self._fault = fault
            _log.log(logging.WARNING if fault else logging.INFO, "Zenoh: %s", fault or "connected")

    def _adopt(self, session: zenoh.Session) -> bool:
        """Let everyone declare what they have; False if it came too late."""
        with self._lock:
            if self._closing.is_set():
                return False
            declare, self._declare = self._declare, []
            for each in declare:
                try:
                    each(session)
                except Exception as error:  # noqa: BLE001  one that can't be declared is no reason to drop the others
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
                if (text := f"no Zenoh session yet, trying again: {in_short(error)}") != self._fault:
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
