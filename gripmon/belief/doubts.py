"""What may be wrong with the edges: doubts, how often they begin and end, and what the fingers' ends tell of them.

Each doubt is a chain of two states by itself.  Rates are per second, or per background that is new; never per frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import NamedTuple

import numpy as np

from gripmon.belief.state import SIZE, Flags, Ints, Seen
from gripmon.model.compiled import compiled
from gripmon.model.records import Array

MOST_DOUBTS = 62
"""Bits of a set."""


@dataclass(frozen=True)
class Rates:
    """A doubt's probability at ``first``, and how it begins and leaves: ``per_s``, and per background that is new."""

    first: float
    per_s: float
    per_background: float = 0.0
    leaves_per_s: float = 0.0
    leaves_per_background: float = 0.0


# Policy, from design: one edge in a hundred is mistaken at first, a curve with all its parts; something is held or lies
# beside the fingers every 50 s, for 5 s; ends are hidden at the start by whatever is held; a finger is bent once in 11
# days; the mount is loose (it vibrates, flexes, creeps) as often, and as long, as something is held.
EDGE = Rates(1e-2, 1e-3, 5e-3, 0.0, 0.7)
CURVE = Rates(1e-2, 1e-3, leaves_per_s=0.2)
GROUP = Rates(1e-2, 0.02, leaves_per_s=0.2)
ALL_ENDS = Rates(1e-1, 0.02, leaves_per_s=0.2)
FINGER = Rates(1e-3, 1e-6)
LOOSE = Rates(1e-2, 0.02, leaves_per_s=0.2)
FOOLED_SHARE = 3.0 / 178.0
"""Share of wrong ends at which the witnesses answer as at right ones: 3/n of the 178 wrong fits that were looked at,
none of which did.
"""


@dataclass(frozen=True)
class Doubt:
    """``edges`` (e,) that are something else's while it lasts; ``ends`` (f,) of fingers that are then not the ends;
    ``fooled``: the witnesses of these answer all the same as for right ones.  What is ``held`` moves with the gripper.
    ``moves``: while it lasts, the mount does.
    """

    edges: Flags
    rates: Rates
    ends: Flags
    held: bool = True
    fooled: bool = False
    moves: bool = False


def of_mount(edges: int, fingers: int) -> Doubt:
    """It is loose."""
    return Doubt(np.zeros(edges, bool), LOOSE, np.zeros(fingers, bool), moves=True)


def of_edges(edges: int, fingers: int) -> list[Doubt]:
    """Each edge by itself: it isn't held, but belongs to what is behind."""
    return [Doubt(np.arange(edges) == e, EDGE, np.zeros(fingers, bool), held=False) for e in range(edges)]


def of_ends(ends_of: Sequence[Flags]) -> list[Doubt]:
    """The ends of each finger, ``ends_of`` (e,) edges a finger, and of all; each found by witnesses and not."""
    out, fingers = [], len(ends_of)
    for fooled, share in ((False, 1.0 - FOOLED_SHARE), (True, FOOLED_SHARE)):
        each = [(ends_of[f], np.arange(fingers) == f, GROUP) for f in range(fingers)]
        all_of = [(np.any(ends_of, axis=0), np.ones(fingers, bool), ALL_ENDS)]
        for edges, ends, rates in each + (all_of if fingers > 1 else []):
            shared = Rates(rates.first * share, rates.per_s * share, leaves_per_s=rates.leaves_per_s)
            if edges.any():
                out.append(Doubt(edges, shared, ends, fooled=fooled))
    return out


class Table(NamedTuple):
    """All d doubts: ``edges`` (d,) as bits, ``ends`` (f,) doubts about a finger's ends as bits; ``held``, ``fooled``,
    ``moves`` and ``all_ends`` as bits of doubts, ``at_ends`` as bits of edges.  ``rates`` (d, 5) in the order of
    :class:`Rates`.
    """

    edges: Ints
    ends: Ints
    held: int
    fooled: int
    moves: int
    all_ends: int
    at_ends: int
    rates: Array

    @classmethod
    def of(cls, doubts: Sequence[Doubt]) -> Table:
        """ValueError for more doubts, or edges, than a set has bits."""
        if max(len(doubts), len(doubts[0].edges)) > MOST_DOUBTS:
            raise ValueError(f"{len(doubts)} doubts about {len(doubts[0].edges)} edges; at most {MOST_DOUBTS} of each")
        ends = np.array([bits([d.ends[f] for d in doubts]) for f in range(len(doubts[0].ends))], np.int64)
        at_ends = np.any([d.edges for d in doubts if d.ends.any()] or [np.zeros(len(doubts[0].edges), bool)], axis=0)
        rates = np.array([astuple(d.rates) for d in doubts])
        return cls(
            np.array([bits(d.edges) for d in doubts], np.int64), ends, bits([d.held for d in doubts]),
            bits([d.fooled for d in doubts]), bits([d.moves for d in doubts]),
            bits([bool(d.ends.any() and d.ends.all() and len(d.ends) > 1) for d in doubts]), bits(at_ends), rates,
        )  # fmt: skip


class Chances(NamedTuple):
    """Of one frame: logarithms of a doubt's staying and changing (2, d), from off (0) and on (1); ``silent`` (d,):
    about one edge that isn't shown, it waits.
    """

    stay: Array
    change: Array
    silent: Flags


class Onsets:
    """How probable it is now that each doubt begins or ends; what wasn't asked meanwhile is asked when it is shown."""

    def __init__(self, table: Table) -> None:
        self._table = table
        self._alone = np.array([not (table.held >> d) & 1 for d in range(len(table.edges))])
        self._edge = np.array([int(of).bit_length() - 1 for of in table.edges])  # of those alone, the only one
        self._waits = np.zeros(len(table.edges))  # log probability of not having begun unseen
        self._leaves = np.zeros(len(table.edges))
        self._first = True

    def of(self, seen: Seen, dt_s: float) -> Chances:
        """Of a frame, ``dt_s`` after the last one."""
        table, first = self._table, self._first
        rates = table.rates.T
        shown = bits(seen.shown)
        silent = self._alone & ((table.edges & shown) == 0)
        new = np.where(self._alone & ~silent, 1.0 - seen.likeness[self._edge], 0.0)
        if first:
            self._waits += np.log1p(-rates[0])
        else:
            both = rates[1] + rates[3]
            turned = -np.expm1(-both * dt_s) / np.maximum(both, 1e-300)  # a chain of two states, in any time
            self._waits += np.log1p(-rates[2] * new) + np.log1p(-rates[1] * turned)
            self._leaves += np.log1p(-rates[4] * new) + np.log1p(-rates[3] * turned)
        begins = np.where(silent, 0.0, -np.expm1(self._waits))
        ends = np.where(silent, 0.0, -np.expm1(self._leaves))
        self._waits[~silent], self._leaves[~silent], self._first = 0.0, 0.0, False
        with np.errstate(divide="ignore"):
            change = np.log(np.array([begins, ends]))
        return Chances(np.log1p(-np.array([begins, ends])), np.maximum(change, -1e6), silent)


class Told(NamedTuple):
    """What the fingers' ends show at each of the k places where they were looked at: log likelihood of each finger's
    answer where its ends are there, ``right`` (k, f), and where something else is, ``wrong`` (k, f); ``memory`` (k, f):
    probability that an answer is only one of those before again, ``repeats`` (k, f), the share of these that are the
    same.  Who isn't asked has 0, 0, 1, 1.  ``together`` (k, 2): log likelihood of all fingers' answers where all are
    right, and all wrong, NaN where these are independent: what lies over all ends answers for all; theirs are
    ``memory_together`` and ``repeats_together`` (k,).  ``rows`` (e, 23): px by which the middle of each edge at an end
    moves with g; ``at`` (k, 23): g where it was looked; ``fit``: at which of these places the image was fitted.
    """

    right: Array
    wrong: Array
    memory: Array
    repeats: Array
    together: Array
    memory_together: Array
    repeats_together: Array
    rows: Array
    at: Array
    fit: int


def nothing_told(edges: int, fingers: int) -> Told:
    """No witness."""
    none, rows, at = np.zeros((0, fingers)), np.zeros((edges, SIZE)), np.zeros((0, SIZE))
    return Told(none, none, none, none, np.zeros((0, 2)), np.zeros(0), np.zeros(0), rows, at, 0)


@compiled
def edges_of(doubts: int, edges: Ints) -> int:
    """Bits of all edges that a set of doubts is about."""
    out, k = 0, 0
    while doubts >> k:
        if (doubts >> k) & 1:
            out |= edges[k]
        k += 1
    return out


@compiled
def log_transition(before: int, after: int, chances: Chances) -> float:
    """Log probability of a set of doubts after another."""
    total = 0.0
    for k in range(len(chances.silent)):
        on = (before >> k) & 1
        total += chances.change[on, k] if (after >> k) & 1 != on else chances.stay[on, k]
    return total


@compiled
def log_told(before: int, after: int, table: Table, told: Told, first: bool, looked: Ints) -> float:
    """Log likelihood of the witnesses, over what it is where all ends are something else's and were so before.  An
    answer heard before is little news while what it is about stays.  ``looked`` (f,): at which place each finger's ends
    were looked at, -1 for none; at the others something else was.
    """
    total, fingers = 0.0, len(table.ends)
    for k in range(len(told.memory)):
        apart, wrong, rights, sames = 0.0, 0.0, 0, 0
        for f in range(fingers):
            here, bad, was = looked[f] == k, after & table.ends[f], before & table.ends[f]
            right, was_right = bad == 0 or bad & table.fooled != 0, was == 0 or was & table.fooled != 0
            same = not first and (not here or ((bad != 0) == (was != 0) and right == was_right))
            right = right and here
            rights, sames = rights + int(right), sames + int(same)
            log = told.right[k, f] if right else told.wrong[k, f]
            apart += answered(log, same, told.repeats[k, f], told.memory[k, f])
            wrong += answered(told.wrong[k, f], not first, told.repeats[k, f], told.memory[k, f])
        if not math.isnan(told.together[k, 0]):
            wrong = answered(told.together[k, 1], not first, told.repeats_together[k], told.memory_together[k])
            if rights in (0, fingers) and sames in (0, fingers):
                log = told.together[k, 0] if rights else told.together[k, 1]
                apart = answered(log, sames > 0, told.repeats_together[k], told.memory_together[k])
        total += apart - wrong
    return total


@compiled
def answered(log: float, same: bool, repeats: float, memory: float) -> float:
    """Log likelihood of an answer of log likelihood ``log`` if it were new, where what it is about may be the ``same``
    as before: then answers come from the scene's own (a Dirichlet process about the table).
    """
    return math.log(memory * repeats + (1.0 - memory) * math.exp(log)) if same else log


def bits(flags: Sequence[bool] | Flags) -> int:
    """A bit for each flag, the first the lowest."""
    return int(sum(1 << int(k) for k in np.flatnonzero(np.asarray(flags))))
