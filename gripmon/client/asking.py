"""Asking a monitor what its clock shows."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable

import zenoh

from gripmon.io.wire import CLOCK_PARAMETER, steady_ns
from gripmon.model.records import ClockReading, MessageRefused, from_json

ASK_EVERY_S = 1.0
"""The bound grows by 1 ms meanwhile (:data:`gripmon.io.wire.MOST_DRIFT`); 200 bytes each way."""

_ASK_AGAIN_S = 0.1  # while nothing is known: a question may be lost
_ANSWER_WITHIN_S = 10.0  # a late answer is as true as a quick one, and says less


class ClockAsker:
    """Asks on a session, at most so often; called in Zenoh's threads, and answered there."""

    def __init__(self, key: str, answered: Callable[[ClockReading, int, int], None]) -> None:
        """``answered`` gets the answer, and when it was asked for and came by our steady clock, ns."""
        self._selector, self._answered = f"{key}?{CLOCK_PARAMETER}", answered
        self._session: zenoh.Session | None = None
        self._next_s = 0.0

    def use(self, session: zenoh.Session) -> None:
        self._session = session

    def ask(self, *, known: bool) -> None:
        """Ask if it is time; sooner if nothing is ``known`` yet."""
        session, now_s = self._session, time.monotonic()
        if session is None or now_s < self._next_s - (ASK_EVERY_S - _ASK_AGAIN_S) * (not known):
            return
        self._next_s = now_s + ASK_EVERY_S
        asked_ns = steady_ns()

        def take(reply: zenoh.Reply) -> None:
            self._take(reply, asked_ns)

        with contextlib.suppress(zenoh.ZError):  # the session is being closed
            session.get(
                self._selector,
                zenoh.handlers.Callback(take, indirect=False),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=_ANSWER_WITHIN_S,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.REAL_TIME,  # the answer's, too: not behind what is less urgent
                express=True,
            )

    def _take(self, reply: zenoh.Reply, asked_ns: int) -> None:
        answered_ns = steady_ns()
        if reply.ok is None:
            return
        try:
            reading = from_json(reply.ok.payload.to_bytes(), ClockReading)
        except MessageRefused:  # a monitor of a version that doesn't tell answers with its last transform
            return
        self._answered(reading, asked_ns, answered_ns)
