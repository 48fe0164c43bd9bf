"""Replies to queries, sent beside whoever has them."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait

import zenoh

_log = logging.getLogger(__name__)

_AT_ONCE = 2
_WAITING_MOST = 64
_REFUSED_MOST = 4096
"""Queries beyond the waiting ones that are told that too many wait: seconds of a flood, at some bytes each."""
_CLOSE_WITHIN_S = 1.0


class Answers:
    """A few threads that send replies.

    How long a reply waits for a congested link is the asker's choice in Zenoh.  By default it waits until the link is
    given up: an asker that was stopped costs 5 to 10 s, which neither the loop nor Zenoh's own threads have.
    """

    def __init__(self, name: str, busy: Callable[[zenoh.Query], None] | None = None) -> None:
        """``busy`` tells an asker that too many wait; without it such a query ends unanswered."""
        # Its threads end with the process, also if nobody closes it, but none in the middle of a call into Zenoh.
        self._pool = ThreadPoolExecutor(_AT_ONCE, thread_name_prefix=f"gripmon-{name}")
        self._busy = busy
        self._refusals = ThreadPoolExecutor(1, thread_name_prefix=f"gripmon-{name}-busy")
        self._refused: set[Future[None]] = set()
        self._lock = threading.Lock()
        self._under_way: set[Future[None]] = set()
        self._closed = False

    def send(self, query: zenoh.Query, reply: Callable[[zenoh.Query], None]) -> None:
        """Let ``reply`` answer the query, soon; where too many wait, it is told so instead.  Once closed: at once."""
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
        """Give what is under way a second."""
        with self._lock:
            self._closed, under_way = True, set(self._under_way)
        wait(under_way, _CLOSE_WITHIN_S)
        self._pool.shutdown(wait=False)
        self._refusals.shutdown(wait=False)

    def _done(self, future: Future[None]) -> None:
        with self._lock:
            self._under_way.discard(future)
            self._refused.discard(future)


def send_now(query: zenoh.Query, reply: Callable[[zenoh.Query], None]) -> None:
    """Let ``reply`` answer the query in this thread, however long it takes."""
    try:
        reply(query)
    except Exception as error:  # noqa: BLE001  mostly the asker, or the session, is gone
        _log.debug("no answer on %s", query.key_expr, exc_info=error)
    finally:
        query.drop()
