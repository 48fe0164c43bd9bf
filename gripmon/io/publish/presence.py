"""The id of this monitor process, detection of others with the same name, and the threads that answer queries."""

from __future__ import annotations

import logging
import os
import re
import secrets
import socket
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait

import zenoh

from gripmon.io.wire import Keys, Link, in_zenohs_thread

_log = logging.getLogger(__name__)

VANISHES_WITHIN_S = 20.0
"""Longest time for which a monitor that hangs, or lost power or network, stays visible, s: Zenoh's lease, 10 s by
default, plus the time until Zenoh checks it; 14.5 s were measured after a SIGSTOP.
"""

_CONNECTED_WITHIN_S = 2.0  # don't wait longer for a router that isn't there yet
_LOOK_EVERY_S = 0.5
_LOOKS_FOR_AN_ID = 4  # on a busy machine one query isn't enough
_NOT_IN_A_KEY = re.compile(r"[^A-Za-z0-9.]+")
_LONGEST_HOST = 32


def new_monitor_id() -> str:
    """Return a new process id for the network: host and pid, for a person who looks for it, and a random suffix."""
    host = _NOT_IN_A_KEY.sub("_", socket.gethostname())[:_LONGEST_HOST] or "host"
    return f"{host}-{os.getpid()}-{secrets.token_hex(4)}"


class Presence:
    """One monitor process on a link: its id, and the ids of other monitors of the same robot and camera.

    Each monitor has a liveliness token ``…/alive/<id>``, which its publisher declares.
    """

    def __init__(self, link: Link, keys: Keys) -> None:
        self.monitor_id = new_monitor_id()
        self._link, self._keys = link, keys
        self._others: frozenset[str] = frozenset()
        self._lock = threading.Lock()  # guards the set against Zenoh's other threads
        self._session: zenoh.Session | None = None
        self._declared: object = None  # kept, because Zenoh undeclares an object that is no longer referenced
        link.attach(self._attach, self._leave)

    def others(self) -> tuple[str, ...]:
        """The sorted ids of other monitors of this name that are present now; called once per frame."""
        return tuple(sorted(self._others)) if self._others else ()

    def wait_alone(self, timeout_s: float = VANISHES_WITHIN_S) -> tuple[str, ...]:
        """Before declaring our own token, wait until no other monitor has this name; return the ids that are still
        there after ``timeout_s``.  Usually there are none, and it returns immediately.

        A killed predecessor vanishes within that time.  An empty id stands for a gripmon version without ids.
        Without a connection it returns no ids; :meth:`others` reports them later.
        """
        if not self._connected():
            return ()
        end_s, logged = time.monotonic() + timeout_s, False
        while others := self._look():
            if time.monotonic() >= end_s:
                return others
            if not logged:
                logged = True
                _log.warning("%s; waiting up to %g s for it to vanish", in_words(others), timeout_s)
            time.sleep(_LOOK_EVERY_S)
        return ()

    def _connected(self) -> bool:
        """Wait up to ``_CONNECTED_WITHIN_S`` for the configured connections; False only if there is no session then."""
        end_s = time.monotonic() + _CONNECTED_WITHIN_S
        while self._session is None or self._link.unconnected():
            if time.monotonic() >= end_s:
                return self._session is not None
            time.sleep(0.02)
        return True

    def _look(self) -> tuple[str, ...]:
        """The ids of the monitors present, from a new query for their tokens."""
        session = self._session
        if session is None:
            return ()
        found = self._ids(session)
        for _ in range(_LOOKS_FOR_AN_ID):
            if found != {""}:
                break
            # Zenoh's first answer lacks the tokens that our subscriber of ids is still waiting for
            time.sleep(_LOOK_EVERY_S)
            found = self._ids(session)
        # a monitor with an id also has the token without one, so "" counts only if it is the only one
        return tuple(sorted(found - {""} or found))

    def _ids(self, session: zenoh.Session) -> set[str]:
        replies = session.liveliness().get(self._keys["alive/**"], timeout=_CONNECTED_WITHIN_S)
        return {_id_in(reply.ok.key_expr) for reply in replies if reply.ok is not None}

    def _attach(self, session: zenoh.Session) -> None:
        take, tokens = in_zenohs_thread(self._take), session.liveliness()
        self._declared = tokens.declare_subscriber(self._keys["alive/*"], take, history=True)
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
    """A message for a person that these monitors are present."""
    names = ", ".join(other or "one of an earlier version of gripmon" for other in others)
    return f"another monitor of this robot and camera is on the network: {names}"


def _id_in(key: object) -> str:
    """The id in a token's key; empty for a token without id."""
    return str(key).partition("/alive")[2].lstrip("/")


_AT_ONCE = 2
_WAITING_MOST = 64
_REFUSED_MOST = 4096
"""Queries beyond the waiting ones that still get a "too many" reply: seconds of a flood, at some bytes each."""
CLOSE_WITHIN_S = 1.0


class Answers:
    """A few threads that send replies.

    In Zenoh the client chooses how long a reply waits on a congested link.  By default it waits until the link is
    given up: a client that was suspended costs 5 to 10 s, too long for the loop and for Zenoh's own threads.
    """

    def __init__(self, name: str, busy: Callable[[zenoh.Query], None] | None = None) -> None:
        """``busy`` replies that too many queries wait; without it an excess query ends unanswered."""
        # The threads end with the process even without close(), but never in the middle of a call into Zenoh.
        self._pool = ThreadPoolExecutor(_AT_ONCE, thread_name_prefix=f"gripmon-{name}")
        self._busy = busy
        self._refusals = ThreadPoolExecutor(1, thread_name_prefix=f"gripmon-{name}-busy")
        self._refused: set[Future[None]] = set()
        self._lock = threading.Lock()
        self._under_way: set[Future[None]] = set()
        self._closed = False

    def send(self, query: zenoh.Query, reply: Callable[[zenoh.Query], None]) -> None:
        """Schedule ``reply`` for the query; if too many wait, ``busy`` replies instead.  Once closed, run it here."""
        future: Future[None] | None = None
        with self._lock:
            closed = self._closed
            if not closed and len(self._under_way) < _WAITING_MOST:
                future = self._pool.submit(send_now, query, reply)
                self._under_way.add(future)
            elif not closed and self._busy is not None and len(self._refused) < _REFUSED_MOST:
                future = self._refusals.submit(send_now, query, self._busy)
                self._refused.add(future)
        if future is not None:
            future.add_done_callback(self._done)
        elif closed:
            send_now(query, reply)
        else:
            query.drop()

    def close(self) -> None:
        """Wait up to a second for replies being sent."""
        with self._lock:
            self._closed, under_way = True, set(self._under_way)
        wait(under_way, CLOSE_WITHIN_S)
        self._pool.shutdown(wait=False)
        self._refusals.shutdown(wait=False)

    def _done(self, future: Future[None]) -> None:
        with self._lock:
            self._under_way.discard(future)
            self._refused.discard(future)


def send_now(query: zenoh.Query, reply: Callable[[zenoh.Query], None]) -> None:
    """Run ``reply`` for the query in this thread, however long it takes."""
    try:
        reply(query)
    except Exception as error:  # noqa: BLE001  mostly the asker, or the session, is gone
        _log.debug("no answer on %s", query.key_expr, exc_info=error)
    finally:
        query.drop()
