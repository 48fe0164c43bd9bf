"""An upper bound on the age of a message, without synchronised clocks.

A message contains the reading of the monitor's steady clock when it was sent.  This alone is not enough: a message
delayed by ten seconds looks like one from a clock that is ten seconds behind, and even the fastest message so far may
have been delayed.  A query and its reply give a bound: the clock in the reply was read after the query was sent, so the
monitor's clock is ahead of ours by at most the difference of the two readings, however long either was on its way.
From then on the bound grows with the drift of the two clocks, and every further reply can only lower it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from gripmon.io.wire import MOST_DRIFT, steady_ns
from gripmon.model.records import ClockReading

_CLOCKS_KEPT = 16
"""Each start of a monitor has one clock, and a malicious sender may invent any number."""


def steady_s() -> float:
    """This machine's steady clock, s: nobody sets it, and it goes on while the machine is suspended."""
    return 1e-9 * steady_ns()


class Sent(NamedTuple):
    """The monitor's clock when a message was sent, and our steady clock (ns) when it arrived."""

    reading: ClockReading
    arrived_ns: int


class Lead(NamedTuple):
    """At ``at_ns`` of our steady clock, a monitor's clock led it by at most ``most_ns``; both may be negative."""

    most_ns: int
    at_ns: int

    def most_at_ns(self, when_ns: int) -> int:
        """The bound at another time, ns, with the clocks' drift since."""
        return self.most_ns + math.ceil(MOST_DRIFT * abs(when_ns - self.at_ns))


Leads = Mapping[str, Lead]
"""Leads by the clock's name."""

NO_LEADS: Leads = MappingProxyType({})


def with_answer(leads: Leads, answer: ClockReading, asked_ns: int, answered_ns: int) -> Leads:
    """The leads after a reply; a bound that contradicts it is from before a clock jumped, and is dropped."""
    lead = Lead(answer.now_ns - asked_ns + math.ceil(MOST_DRIFT * (answered_ns - asked_ns)), asked_ns)
    before = leads.get(answer.clock)
    if before is not None and before.most_at_ns(answered_ns) >= answer.now_ns - answered_ns:
        lead = min(lead, before, key=lambda each: each.most_at_ns(answered_ns))
    kept = {clock: known for clock, known in leads.items() if clock != answer.clock}
    return dict(list(kept.items())[1 - _CLOCKS_KEPT :]) | {answer.clock: lead}


def without_contradicted(leads: Leads, sent: Sent) -> Leads:
    """The leads after a message; its clock is dropped if the message would have arrived before it was sent."""
    waited_ns = _waited_ns(leads, sent)
    if waited_ns is None or waited_ns >= 0:
        return leads
    return {clock: lead for clock, lead in leads.items() if clock != sent.reading.clock}


def waited_s(leads: Leads, sent: Sent | None) -> float | None:
    """Upper bound of the message's delay, s; None if unknown."""
    waited_ns = None if sent is None else _waited_ns(leads, sent)
    return None if waited_ns is None else 1e-9 * waited_ns


def _waited_ns(leads: Leads, sent: Sent) -> int | None:
    lead = leads.get(sent.reading.clock)
    return None if lead is None else sent.arrived_ns + lead.most_at_ns(sent.arrived_ns) - sent.reading.now_ns
