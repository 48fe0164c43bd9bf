"""Which sets of doubts explain a frame: the search that decides whether a bound can be trusted.

From every hypothesis, and from what it finds, it goes on to the sets with one doubt more or less, each weighed exactly;
without it what begins later is never doubted.  Compiled.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gripmon.belief.doubts import Chances, Table, Told, edges_of, log_told, log_transition
from gripmon.belief.ends import across
from gripmon.belief.nodes import Nodes, weigh, without
from gripmon.belief.state import SIZE, Bank, Flags, Ints, Seen
from gripmon.model.compiled import compiled
from gripmon.model.records import Array

MOST_ROUNDS = 8
AT_ONCE = 8
"""Sets from which a round goes on."""
IMPOSSIBLE = -1e5
"""A logarithm of no probability."""


class Candidates(NamedTuple):
    """c sets: ``node`` (c,), ``doubts`` (c,) as bits, ``log_weight`` (c,) after the frame, not normalised, ``surprise``
    (c,) of ``own`` (c,) rows; ``expanded`` (c,): its neighbours were weighed.
    """

    node: Ints
    doubts: Ints
    log_weight: Array
    surprise: Array
    own: Ints
    expanded: Flags

    @classmethod
    def empty(cls, sets: int) -> Candidates:
        """Zeros."""
        return cls(
            np.zeros(sets, np.int64), np.zeros(sets, np.int64), np.zeros(sets), np.zeros(sets),
            np.zeros(sets, np.int64), np.zeros(sets, bool),
        )


class Asked(NamedTuple):
    """A frame: its edges, the doubts and their chances, what witnesses told, whether it is the first, and what is
    ``near`` an edge, a variance, px^2.
    """

    seen: Seen
    table: Table
    chances: Chances
    told: Told
    first: bool
    near: float


@compiled
def known(candidates: Candidates, n: int, node: int, doubts: int) -> int:
    """Which of the first ``n`` is this set of a node, -1 for none."""
    c = n - 1
    while c >= 0 and (candidates.doubts[c] != doubts or candidates.node[c] != node):
        c -= 1
    return c


@compiled
def put(candidates: Candidates, n: int, nodes: Nodes, i: int, doubts: int, bank: Bank, asked: Asked) -> int:
    """One more candidate, weighed; the number of them."""
    if n >= len(candidates.node) or known(candidates, n, i, doubts) >= 0:
        return n
    root, solution = np.empty((SIZE, SIZE)), np.empty(SIZE)
    table, before = asked.table, bank.doubts[nodes.parent[i]]
    doubted, held = edges_of(doubts, table.edges), edges_of(doubts & table.held, table.edges)
    log, surprise, own = weigh(
        nodes, i, asked.seen, doubted, held, across(nodes, i, doubts), asked.near, root, solution
    )  # fmt: skip
    log += nodes.before[i] + log_transition(before, doubts, asked.chances)
    candidates.node[n], candidates.doubts[n] = i, doubts
    candidates.log_weight[n] = log + log_told(before, doubts, table, asked.told, asked.first, nodes.looked[i])
    candidates.surprise[n], candidates.own[n], candidates.expanded[n] = surprise, own, False
    return n + 1


@compiled
def take_one_of(candidates: Candidates, n: int, nodes: Nodes, edges: Ints, asked: int) -> Flags:
    """(n,) whether each takes one of the edges ``asked`` (bits) for the gripper's, and a line there for it; ``edges``
    (d,), bits, are those of each doubt.
    """
    out = np.zeros(n, np.bool_)
    for c in range(n):
        own = asked & ~edges_of(candidates.doubts[c], edges)
        for edge in range(nodes.line.shape[1]):
            if (own >> edge) & 1 and nodes.line[candidates.node[c], edge] >= 0:
                out[c] = True
    return out


@compiled
def put_all(candidates: Candidates, n: int, nodes: Nodes, i: int, bank: Bank, asked: Asked) -> int:
    """Every set of doubts that is possible."""
    for doubts in range(1 << len(asked.table.edges)):
        if log_transition(bank.doubts[nodes.parent[i]], doubts, asked.chances) < IMPOSSIBLE:
            continue
        n = put(candidates, n, nodes, i, doubts, bank, asked)
    return n


@compiled
def put_pairs(candidates: Candidates, n: int, nodes: Nodes, i: int, bank: Bank, asked: Asked) -> int:
    """Every set of one and two doubts: before anything is known, their likelihoods are no guide."""
    for j in range(len(asked.table.edges)):
        for k in range(j + 1):
            n = put(candidates, n, nodes, i, (1 << j) | (1 << k), bank, asked)
    return n


@compiled
def neighbours(candidates: Candidates, n: int, c: int, nodes: Nodes, bank: Bank, asked: Asked, floor: float) -> int:
    """Candidates with one doubt more or less than ``c``, heavier than ``floor``; the number of all.  A doubt about an
    edge that another one covers changes nothing that can be seen: it is left as it is.
    """
    i, doubts, table, seen = candidates.node[c], candidates.doubts[c], asked.table, asked.seen
    before = bank.doubts[nodes.parent[i]]
    root, solution = np.empty((SIZE, SIZE)), np.empty(SIZE)
    covered, held = edges_of(doubts, table.edges), edges_of(doubts & table.held, table.edges)
    log, _, _ = weigh(nodes, i, seen, covered, held, across(nodes, i, doubts), asked.near, root, solution)
    candidates.expanded[c] = True
    for k in range(len(table.edges)):
        changed = doubts ^ (1 << k)
        if asked.chances.silent[k]:
            continue
        if (table.held >> k) & 1 == 0:
            edge = 0
            while (table.edges[k] >> edge) & 1 == 0:
                edge += 1
            if (held >> edge) & 1:
                continue
            own = (covered >> edge) & 1 == 0
            gain = without(nodes, i, edge, root, solution, own) - nodes.free[i, edge]
            weight = log - gain if own else log + gain
            weight += nodes.before[i] + log_transition(before, changed, asked.chances)
            weight += log_told(before, changed, table, asked.told, asked.first, nodes.looked[i])
            if weight < floor:
                continue
        m = put(candidates, n, nodes, i, changed, bank, asked)
        if m > n and candidates.log_weight[n] < floor:
            continue
        n = m
    return n


@compiled
def search(candidates: Candidates, n: int, nodes: Nodes, bank: Bank, asked: Asked, reach: float, least: float) -> int:
    """Go on from every hypothesis that was within ``reach`` (a logarithm) of certain before the frame, then from what
    is within it of the best now, until nothing is left; what is lighter than ``least`` (another) is left out.  The
    number of candidates.
    """
    best = -math.inf
    for c in range(n):
        best = max(best, candidates.log_weight[c])
    for c in range(n):
        if nodes.before[candidates.node[c]] > -reach:
            n = neighbours(candidates, n, c, nodes, bank, asked, best - least)
    for _ in range(MOST_ROUNDS):
        for c in range(n):
            best = max(best, candidates.log_weight[c])
        done = 0
        for c in np.argsort(-candidates.log_weight[:n]):
            if candidates.log_weight[c] < best - reach or done >= AT_ONCE:
                break
            if not candidates.expanded[c]:
                n = neighbours(candidates, n, c, nodes, bank, asked, best - least)
                done += 1
        if done == 0:
            break
    return spread(candidates, n, nodes, bank, asked, reach, least)


@compiled
def spread(candidates: Candidates, n: int, nodes: Nodes, bank: Bank, asked: Asked, reach: float, least: float) -> int:
    """What the heaviest sets doubt is tried everywhere: else a place loses only since nobody looked there for what
    begins in several edges at once.
    """
    heaviest = np.argsort(-candidates.log_weight[:n])[:AT_ONCE]
    floor = candidates.log_weight[heaviest[0]] - least
    for i in range(candidates.node[:n].max() + 1):
        for c in heaviest if nodes.before[i] > -reach else heaviest[:0]:
            m = put(candidates, n, nodes, i, candidates.doubts[c], bank, asked)
            n = m if m > n and candidates.log_weight[n] >= floor else n
    return n
