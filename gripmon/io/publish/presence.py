"""Which start of a monitor this is, and who else speaks under its name."""

from __future__ import annotations

import logging
import os
import re
import secrets
import socket
import threading
import time

import zenoh

from gripmon.io.wire import Keys, Link

_log = logging.getLogger(__name__)

VANISHES_WITHIN_S = 20.0
"""A monitor that hangs, or lost its power or its line, stays visible for Zenoh's lease, 10 s by default, and until that
is looked at: 14.5 s after a SIGSTOP were measured.
"""

_CONNECTED_WITHIN_S = 2.0  # a router that isn't there yet is no reason to wait longer
_LOOK_EVERY_S = 0.5
_NOT_IN_A_KEY = re.compile(r"[^A-Za-z0-9.]+")
_LONGEST_HOST = 32


def new_monitor_id() -> str:
    """The id of a start: the machine and the process for a person who looks for it, and what makes it unique."""
    host = _NOT_IN_A_KEY.sub("_", socket.gethostname())[:_LONGEST_HOST] or "host"
    return f"{host}-{os.getpid()}-{secrets.token_hex(4)}"


class Presence:
    """One start of a monitor on a link: its id, and the ids of others of the same robot and camera.

    Each shows a liveliness token ``…/alive/<id>``, which its publisher declares.
    """

    def __init__(self, link: Link, keys: Keys) -> None:
        self.monitor_id = new_monitor_id()
        self._link, self._keys = link, keys
        self._others: frozenset[str] = frozenset()
        self._lock = threading.Lock()  # guards it against Zenoh's other threads
        self._session: zenoh.Session | None = None
        self._declared: object = None  # Zenoh undeclares what nobody refers to
        link.attach(self._attach, self._leave)

    def others(self) -> tuple[str, ...]:
        """The ids of other monitors of this name that are there now, in order; asked once a frame."""
        return tuple(sorted(self._others)) if self._others else ()

    def wait_alone(self, timeout_s: float = VANISHES_WITHIN_S) -> tuple[str, ...]:
        """Before the own token is shown: who has the name and keeps it for ``timeout_s``; mostly nobody, at once.

        A predecessor that was killed vanishes meanwhile.  An empty id is that of a version of gripmon without ids.
        Nobody is found while there is no connection: then :meth:`others` says it later.
        """
        if not self._connected():
            return ()
        end_s, said = time.monotonic() + timeout_s, False
        while others := self._look():
            if time.monotonic() >= end_s:
                return others
            if not said:
                said = True
                _log.warning("%s; waiting up to %g s for it to vanish", in_words(others), timeout_s)
            time.sleep(_LOOK_EVERY_S)
        return ()

    def _connected(self) -> bool:
        """Is there a session that is connected as it should be, or soon?"""
        end_s = time.monotonic() + _CONNECTED_WITHIN_S
        while self._session is None or self._link.unconnected():
            if time.monotonic() >= end_s:
                return self._session is not None
            time.sleep(0.02)
        return True

    def _look(self) -> tuple[str, ...]:
        """Who is there by their tokens, asked for just now."""
        session = self._session
        if session is None:
            return ()
        if (found := self._ids(session)) == {""}:
            # Zenoh answers at first without the tokens that our subscriber of ids waits for: look twice
            time.sleep(_LOOK_EVERY_S)
            found = self._ids(session)
        # a monitor with an id shows the token without one, too: "" counts only alone
        return tuple(sorted(found - {""} or found))

    def _ids(self, session: zenoh.Session) -> set[str]:
        replies = session.liveliness().get(self._keys["alive/**"], timeout=_CONNECTED_WITHIN_S)
        return {_id_in(reply.ok.key_expr) for reply in replies if reply.ok is not None}

    def _attach(self, session: zenoh.Session) -> None:
        take = zenoh.handlers.Callback(self._take, indirect=False)
        self._declared = session.liveliness().declare_subscriber(self._keys["alive/*"], take, history=True)
        self._session = session

    def _leave(self) -> None:
        self._session = None

    def _take(self, token: zenoh.Sample) -> None:
        its_id = _id_in(token.key_expr)
        if its_id == self.monitor_id:
            return
        with self._lock:
            there = token.kind == zenoh.SampleKind.PUT
            self._others = self._others | {its_id} if there else self._others - {its_id}


def in_words(others: tuple[str, ...]) -> str:
    """That they are there, for a person."""
    names = ", ".join(other or "one of an earlier version of gripmon" for other in others)
    return f"another monitor of this robot and camera is on the network: {names}"


def _id_in(key: object) -> str:
    """The id in a token's key; empty for the token without one."""
    return str(key).partition("/alive")[2].lstrip("/")
