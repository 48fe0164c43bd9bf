"""Writing the monitor's state: immediately what messages will depend on, the rest in another thread."""

from __future__ import annotations

import threading

import msgspec

from gripmon.io.publish.presence import CLOSE_WITHIN_S
from gripmon.judge.statefile import StateFile
from gripmon.model.records import MonitorState, ReferenceRecord

RETRY_S = 1.0
"""Pause before a failed write of the state is retried."""


class StateKeeper:
    """Writes states, of which the newest wins.  Without a sink (None) nothing is written."""

    def __init__(self, sink: StateFile | None) -> None:
        self._sink = sink
        self._writing = threading.Lock()  # held during a write, so that an older state never replaces a newer one
        self._changed = threading.Condition()  # guards what follows
        self._waiting: MonitorState | None = None
        self._newest: MonitorState | None = None  # passed to this keeper
        self._closing = False
        self._thread: threading.Thread | None = None

    @property
    def failure(self) -> str:
        """Why the state can't be written at present; empty if it can."""
        return "" if self._sink is None else self._sink.failure

    def now(self, state: MonitorState) -> None:
        """Write a state before this returns, which takes as long as the disk does.  A fault is in :attr:`failure`, and
        the write is retried.
        """
        if self._sink is None:
            return
        with self._writing:
            with self._changed:
                self._waiting, self._newest = None, state
            done = self._sink.write(state)
        if not done:
            self.soon(state)

    def references(self, references: tuple[ReferenceRecord, ...]) -> str:
        """Write a chain of references before the newest takes effect; returns why it failed, empty if it succeeded.

        A failed write is not retried: the caller does without the new reference.  The rest of the state is the newest
        known, without a proposal, which a new reference withdraws.
        """
        if self._sink is None:
            return ""
        with self._changed:
            known = self._newest or MonitorState(references)
        state = msgspec.structs.replace(known, references=references, proposal=None)
        with self._writing:
            if not self._sink.write(state):
                return self._sink.failure
            with self._changed:
                self._waiting, self._newest = None, state
        return ""

    def soon(self, state: MonitorState) -> None:
        """Write a state in another thread."""
        if self._sink is None:
            return
        with self._changed:
            self._waiting = self._newest = state
            self._changed.notify()
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="gripmon-state", daemon=True)
                self._thread.start()

    def close(self) -> None:
        """Try once to write a pending state, and close the sink."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        if self._thread is not None:
            self._thread.join(CLOSE_WITHIN_S)
        if self._sink is not None:
            self._sink.close()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting is not None or self._closing)
                if self._waiting is None:
                    return
            done = self._write_waiting()
            with self._changed:
                if self._closing and not done:
                    return
                if not done:
                    self._changed.wait_for(lambda: self._closing, RETRY_S)

    def _write_waiting(self) -> bool:
        assert self._sink is not None
        with self._writing:
            with self._changed:
                state, self._waiting = self._waiting, None
            if state is None:  # superseded by a newer one that was written directly
                return True
            done = self._sink.write(state)
            if not done:
                with self._changed:
                    self._waiting = self._waiting or state
        return done
