"""How long a transform was on its way, without clocks that show the same time.

A message says what the monitor's steady clock showed when it was sent.  That alone tells nothing: one that waited for
ten seconds looks like one of a clock that is ten seconds behind, and the fastest message ever seen may have waited,
too.  A question and its answer do tell: what the answer says was read after the question was asked, so the monitor's
clock is ahead of ours by no more than the difference of the two readings, however long either was on its way.  From
then on that bound grows with the drift of the two clocks, and every further answer may only lower it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from gripmon.io.wire import MOST_DRIFT
from gripmon.model.records import ClockReading

_MOST_CLOCKS = 16
"""Of more clocks nothing is kept: each start of a monitor has one, and a stranger may make up any number."""


class Sent(NamedTuple):
    """What the monitor's clock showed when a message was sent, and ours (steady, ns) when it arrived."""

    reading: ClockReading
    arrived_ns: int


class Lead(NamedTuple):
    """At ``at_ns`` by our steady clock, a monitor's was ahead of it by at most ``most_ns``; both may be negative."""

    most_ns: int
    at_ns: int

    def most_at_ns(self, when_ns: int) -> int:
        """The same at another time, ns; the clocks have drifted since."""
        return self.most_ns + math.ceil(MOST_DRIFT * abs(when_ns - self.at_ns))


Leads = Mapping[str, Lead]
"""By the clock's name."""

NO_LEADS: Leads = MappingProxyType({})


def with_answer(leads: Leads, answer: ClockReading, asked_ns: int, answered_ns: int) -> Leads:
    """What is known after an answer.  What contradicts it was true before a clock jumped, and is forgotten."""
    round_trip_ns = answered_ns - asked_ns
    lead = Lead(answer.now_ns - asked_ns + math.ceil(MOST_DRIFT * round_trip_ns), asked_ns)
    before = leads.get(answer.clock)
    if before is not None and before.most_at_ns(answered_ns) >= answer.now_ns - answered_ns:
        lead = min(lead, before, key=lambda each: each.most_at_ns(answered_ns))
    kept = {clock: known for clock, known in leads.items() if clock != answer.clock}
    return dict(list(kept.items())[1 - _MOST_CLOCKS :]) | {answer.clock: lead}


def without_contradicted(leads: Leads, sent: Sent) -> Leads:
    """What is known after a message: nothing of its clock, if it would have arrived before it was sent."""
    waited_ns = _waited_ns(leads, sent)
    if waited_ns is None or waited_ns >= 0:
        return leads
    return {clock: lead for clock, lead in leads.items() if clock != sent.reading.clock}


def waited_s(leads: Leads, sent: Sent | None) -> float | None:
    """How long the message was on its way at most, s; None if that isn't known."""
    waited_ns = None if sent is None else _waited_ns(leads, sent)
    return None if waited_ns is None else 1e-9 * waited_ns


def _waited_ns(leads: Leads, sent: Sent) -> int | None:
    lead = leads.get(sent.reading.clock)
    return None if lead is None else sent.arrived_ns + lead.most_at_ns(sent.arrived_ns) - sent.reading.now_ns
