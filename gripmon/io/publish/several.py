"""Several publishers in place of one."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import ParamSpec

from gripmon.io.publish.publisher import Publisher, SpotPublisher, StatePublisher
from gripmon.model.records import AlertRecord, FrameRecord, ReferenceRecord, SpotRecord, StateRecord

_log = logging.getLogger(__name__)
_P = ParamSpec("_P")


class _Several:
    """Hands each record to the first publisher and then to the others.

    What the first raises is raised, after the others had the record.  What another one raises never reaches the caller:
    it is logged once, until it changes, and :meth:`fault` says it.
    """

    def __init__(self, first: StatePublisher, others: Mapping[str, StatePublisher]) -> None:
        self._first_state, self._other_states = first, others
        self._faults: dict[tuple[str, str], str] = {}  # by publisher and method, of which one may work and one not

    def state(self, record: StateRecord) -> None:
        try:
            self._first_state.state(record)
        finally:
            for name, other in self._other_states.items():
                self._hand(name, other.state, record)

    def alert(self, record: AlertRecord) -> None:
        try:
            self._first_state.alert(record)
        finally:
            for name, other in self._other_states.items():
                self._hand(name, other.alert, record)

    def close(self) -> None:
        """Close all, the first last."""
        for name, other in self._other_states.items():
            self._hand(name, other.close)
        self._first_state.close()

    def fault(self) -> str:
        """What is wrong with the others, in a few words for a person; empty if nothing is."""
        return "; ".join(dict.fromkeys(self._faults.values()))

    def _hand(self, name: str, put: Callable[_P, None], *values: _P.args, **named: _P.kwargs) -> None:
        what = (name, put.__name__)
        try:
            put(*values, **named)
        except Exception as error:  # noqa: BLE001  said here and in the state
            text = f"{name} fails: {' '.join(str(error).split()) or type(error).__name__}"
            if self._faults.get(what) != text:
                _log.error("%s", text)
                _log.debug("%s", name, exc_info=error)
            self._faults[what] = text
        else:
            self._faults.pop(what, None)


class Publishers(_Several):
    """Those of a wrist camera."""

    def __init__(self, first: Publisher, others: Mapping[str, Publisher]) -> None:
        """``others`` by the names that they have in messages."""
        super().__init__(first, others)
        self._first = first
        self._others = others

    def transform(self, record: FrameRecord) -> None:
        try:
            self._first.transform(record)
        finally:
            for name, other in self._others.items():
                self._hand(name, other.transform, record)

    def reference(self, record: ReferenceRecord) -> None:
        try:
            self._first.reference(record)
        finally:
            for name, other in self._others.items():
                self._hand(name, other.reference, record)


class SpotPublishers(_Several):
    """Those of a second camera: the others take its states and alerts."""

    def __init__(self, first: SpotPublisher, others: Mapping[str, StatePublisher]) -> None:
        """``others`` by the names that they have in messages."""
        super().__init__(first, others)
        self._first = first

    def spot(self, record: SpotRecord) -> None:
        self._first.spot(record)
