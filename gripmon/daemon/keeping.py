"""Writing the monitor's state in another thread, which alone waits for the disk."""

from __future__ import annotations

import threading

import msgspec

from gripmon.io.publish.presence import CLOSE_WITHIN_S
from gripmon.judge.statefile import StateFile
from gripmon.model.records import MonitorState, ReferenceRecord

RETRY_S = 1.0
"""Pause before a failed write of the state is retried."""
ANSWER_WITHIN_S = 0.25
"""How long the loop waits for what messages depend on: a frame or a few, once for each new reference.  A disk that
needs longer is at fault."""
_SLOW = "state not kept: the disk doesn't answer"


class StateKeeper:
    """Writes states, of which the newest wins.  Without a sink (None) nothing is written."""

    def __init__(self, sink: StateFile | None) -> None:
        self._sink = sink
        self._changed = threading.Condition()  # guards what follows
        self._newest: MonitorState | None = None  # passed to this keeper
        self._asked = self._taken = self._written = 0  # numbers of states: passed, being written, written or refused
        self._done = True  # the last one written was
        self._once = False  # the newest isn't retried
        self._slow = False
        self._closing = False
        self._thread: threading.Thread | None = None

    @property
    def failure(self) -> str:
        """Why the state can't be written at present; empty if it can."""
        if self._sink is None:
            return ""
        return self._sink.failure or (_SLOW if self._slow else "")

    def now(self, state: MonitorState) -> None:
        """Write a state before this returns, if the disk answers within :data:`ANSWER_WITHIN_S`.  A fault is in
        :attr:`failure`, and the write is retried.
        """
        self._wait(self._pass(state))

    def soon(self, state: MonitorState) -> None:
        """Write a state in the other thread."""
        self._pass(state)

    def references(self, references: tuple[ReferenceRecord, ...]) -> str:
        """Write a chain of references before the newest takes effect; returns why it failed, empty if it succeeded.

        A failed write is not retried, and what was known before is passed on again: the caller does without the new
        reference.  The rest of the state is the newest known, without a proposal, which a new reference withdraws.
        """
        with self._changed:
            known = self._newest or MonitorState(references)
        done = self._wait(self._pass(msgspec.structs.replace(known, references=references, proposal=None), once=True))
        if done or self._sink is None:
            return ""
        failure = self.failure or _SLOW  # which may have answered meanwhile
        self._pass(known)  # a slow disk may still get the other one
        return failure

    def close(self) -> None:
        """Try once to write a pending state, and close the sink."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join(CLOSE_WITHIN_S)
        if self._sink is not None and not (self._thread is not None and self._thread.is_alive()):
            self._sink.close()  # else the lock stays with the write that hangs

    def _pass(self, state: MonitorState, *, once: bool = False) -> int:
        """Hand a state to the thread; returns its number."""
        with self._changed:
            self._newest, self._once = state, once
            self._asked += 1
            if self._sink is not None and self._thread is None:
                self._thread = threading.Thread(target=self._run, name="gripmon-state", daemon=True)
                self._thread.start()
            self._changed.notify_all()
            return self._asked

    def _wait(self, number: int) -> bool:
        """Whether a state, or a newer one, has been written."""
        with self._changed:
            answered = self._sink is None or self._changed.wait_for(lambda: self._written >= number, ANSWER_WITHIN_S)
            self._slow = not answered
            return answered and self._done

    def _run(self) -> None:
        assert self._sink is not None
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._taken < self._asked or self._closing)
                if self._taken == self._asked or self._newest is None:
                    return
                state, number, once = self._newest, self._asked, self._once
                self._taken = number
            done = self._sink.write(state)
            with self._changed:
                self._written, self._done, self._slow = number, done, False
                self._changed.notify_all()
                if self._closing and not done:
                    return
                if not done and not once:
                    self._changed.wait_for(lambda: self._closing or self._taken < self._asked, RETRY_S)
                    self._taken = min(self._taken, self._asked - 1)
