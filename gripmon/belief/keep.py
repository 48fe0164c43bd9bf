"""Which hypotheses are kept: what says the same is one, what is too light goes and is counted.  Compiled."""

from __future__ import annotations

import math

import numpy as np

from gripmon.belief.doubts import Table, edges_of
from gripmon.belief.ends import across
from gripmon.belief.nodes import Nodes, weigh
from gripmon.belief.rows import add_noise, forward, learn
from gripmon.belief.search import Candidates
from gripmon.belief.state import OPENING, SIZE, Bank, Ints, Seen
from gripmon.belief.things import foreign, forget
from gripmon.model.compiled import compiled
from gripmon.model.records import Array

REST = 10.0
"""What is left is dropped when all of it is less probable than this many of the lightest that are kept: a hundredth of
the risk.
"""
COMPARABLE = 3.0
"""How many times heavier a hypothesis may be that another one becomes part of, by moments, wherever both are: of what
the lighter one says beyond its own mean two thirds are left then.
"""
BEGINS = 5.0
"""Nats by which doubts that a hypothesis loses would have to begin anew: once in 200 backgrounds."""


@compiled
def posterior(
    nodes: Nodes, i: int, seen: Seen, doubted: int, held: int, added: float, near: float, mean: Array,
    covariance: Array,
) -> None:  # fmt: skip
    """``mean`` (23,), which is that before the frame, and ``covariance`` (23, 23) of g after it."""
    root, solution = np.empty((SIZE, SIZE)), np.empty(SIZE)
    weigh(nodes, i, seen, doubted, held, added, near, root, solution)
    half = np.empty((SIZE, SIZE))  # row j: root of M^-1 L', so that the covariance is half half'
    for j in range(SIZE):
        for k in range(SIZE):
            half[j, k] = nodes.root[i, j, k]
            mean[j] += nodes.root[i, j, k] * solution[k]
        forward(root, half[j])
    for j in range(SIZE):
        for k in range(j + 1):
            total = 0.0
            for m in range(SIZE):
                total += half[j, m] * half[k, m]
            covariance[j, k] = covariance[k, j] = total


@compiled
def same_place(mean: Array, covariance: Array, other: Array, other_covariance: Array) -> bool:
    """Whether two hypotheses say the same of d and the opening: means within a sigma of the surer, variances within a
    factor of two.  Never a wide one with a narrow one: its tail is the bound.
    """
    for j in (0, 1, 2, 3, 4, 5, OPENING):
        a, b, away = covariance[j, j], other_covariance[j, j], mean[j] - other[j]
        if away * away > min(a, b) or max(a, b) > 2.0 * min(a, b):
            return False
    return True


@compiled
def same_doubts(one: int, other: int, table: Table) -> bool:
    """Whether two sets doubt the same edges, held alike, and the same ends, which witnesses are fooled about alike, and
    the mount alike.

    The ends of all fingers, or of each: they differ in nothing that is seen before one of them leaves.
    """
    if one == other:
        return True
    if (one ^ other) & table.moves:
        return False
    held = edges_of(one & table.held, table.edges) == edges_of(other & table.held, table.edges)
    if not held or edges_of(one, table.edges) != edges_of(other, table.edges):
        return False
    for f in range(len(table.ends)):
        a, b = one & table.ends[f], other & table.ends[f]
        if (a != 0) != (b != 0) or (a & table.fooled != 0) != (b & table.fooled != 0):
            return False
    return True


@compiled
def keep(
    candidates: Candidates, n: int, nodes: Nodes, bank: Bank, into: Bank, seen: Seen, table: Table, near: float,
    most: int, least: float, merging: bool,
) -> tuple[Ints, int, float]:  # fmt: skip
    """Write g, doubts and weights of the hypotheses ``into`` another bank, none lighter than ``least``, by moments
    where two are the same (``merging``).  At most ``most`` go on: where there are more, those become one that lose
    least by it, and what can't is listed behind them, for this frame's bound alone.  Which candidate gives each its
    rows (k,), how many are listed, and the probability that is in none.
    """
    order = np.argsort(-candidates.log_weight[:n])
    top, total = candidates.log_weight[order[0]], 0.0
    for c in order:
        total += math.exp(candidates.log_weight[c] - top)
    chosen, listed, lost = np.empty(min(most, n), np.int64), 0, 0.0
    mean, covariance = np.empty(SIZE), np.empty((SIZE, SIZE))
    rest = 1.0
    for c in order:
        weight = math.exp(candidates.log_weight[c] - top) / total
        if weight < least or (merging and listed > 0 and rest < REST * least):
            lost += weight
            continue
        rest -= weight
        i, doubts = candidates.node[c], candidates.doubts[c]
        for j in range(SIZE):
            mean[j] = bank.mean[nodes.parent[i], j]
        doubted, held = edges_of(doubts, table.edges), edges_of(doubts & table.held, table.edges)
        posterior(nodes, i, seen, doubted, held, across(nodes, i, doubts), near, mean, covariance)
        twin = -1
        for q in range(listed if merging else 0):
            alike = listed > most or same_doubts(into.doubts[q], doubts, table)
            if alike and same_place(into.mean[q], into.covariance[q], mean, covariance):
                twin = q
                break
        if twin >= 0:
            merge(into, twin, weight, mean, covariance)
            continue
        if merging and listed == most:
            listed = make_room(into, chosen, most, table)
        if listed == len(into.doubts):
            lost += weight
            continue
        if listed < most:
            chosen[listed] = c
        into.doubts[listed], into.log_weight[listed] = doubts, weight
        into.mean[listed], into.covariance[listed] = mean, covariance
        listed += 1
    for q in range(listed):
        into.log_weight[q] = math.log(into.log_weight[q] / (1.0 - lost))
    return chosen[:min(most, listed)], listed, lost


@compiled
def make_room(into: Bank, chosen: Ints, n: int, table: Table) -> int:
    """Pairs of ``n`` hypotheses become one each, by moments, those first that lose least (Runnalls 2007, with the axes
    of d and the opening apart), with what each would have to doubt anew: who says the same of the place, or is as
    light.  Never more than an eighth at once.  The heavier of a pair gives its doubts and its candidate, in ``chosen``;
    how many are left.
    """
    cost, partner = np.full(n, math.inf), np.full(n, -1)
    for q in range(n):
        weight = into.log_weight[q]
        for other in range(n):
            heavier = into.log_weight[other]
            if other == q or heavier < weight or (heavier == weight and other > q):
                continue
            if heavier > COMPARABLE * weight and not same_place(
                into.mean[other], into.covariance[other], into.mean[q], into.covariance[q]
            ):
                continue
            loss = loss_of(into, other, q)
            loss += 0.0 if same_doubts(into.doubts[other], into.doubts[q], table) else BEGINS * weight
            if loss < cost[q]:
                cost[q], partner[q] = loss, other
    taken, gone, left = np.zeros(n, np.bool_), np.zeros(n, np.bool_), n - max(n // 8, 1)
    count = n
    for q in np.argsort(cost):
        other = partner[q]
        if other < 0 or count == left:
            break
        if not (taken[q] or taken[other]):
            taken[q] = taken[other] = gone[q] = True
            merge(into, other, into.log_weight[q], into.mean[q], into.covariance[q])
            count -= 1
    count = 0
    for q in range(n):
        if not gone[q]:
            chosen[count], into.doubts[count], into.log_weight[count] = chosen[q], into.doubts[q], into.log_weight[q]
            into.mean[count], into.covariance[count] = into.mean[q], into.covariance[q]
            count += 1
    return count


@compiled
def loss_of(into: Bank, heavier: int, q: int) -> float:
    """At most so much of the Kullback-Leibler divergence is lost when ``q`` becomes part of a heavier hypothesis;
    ``log_weight`` holds the weights themselves meanwhile.
    """
    together, loss = into.log_weight[heavier] + into.log_weight[q], 0.0
    share = into.log_weight[q] / together
    for j in (0, 1, 2, 3, 4, 5, OPENING):
        a, b = into.covariance[heavier, j, j], into.covariance[q, j, j]
        away = into.mean[q, j] - into.mean[heavier, j]
        both = (1.0 - share) * a + share * b + share * (1.0 - share) * away * away
        loss += math.log(both) - (1.0 - share) * math.log(a) - share * math.log(b)
    return 0.5 * together * loss


@compiled
def merge(into: Bank, q: int, weight: float, mean: Array, covariance: Array) -> None:
    """By moments; ``log_weight`` holds the weight itself meanwhile."""
    share = weight / (into.log_weight[q] + weight)
    into.log_weight[q] += weight
    away = np.empty(SIZE)
    for j in range(SIZE):
        away[j] = mean[j] - into.mean[q, j]
    for j in range(SIZE):
        for m in range(SIZE):
            into.covariance[q, j, m] += share * (covariance[j, m] - into.covariance[q, j, m])
            into.covariance[q, j, m] += share * (1.0 - share) * away[j] * away[m]
        into.mean[q, j] += share * away[j]


@compiled
def remember(
    into: Bank, chosen: Ints, candidates: Candidates, nodes: Nodes, bank: Bank, factors: Array, ranks: Ints, seen: Seen,
    table: Table, sizes: Array,
) -> None:  # fmt: skip
    """What the rows of the hypotheses kept, which are those of their parents as yet, learn from the frame and from a
    jump before it (``factors`` (j, r, 23), of which ``ranks`` (j,) rows count).
    """
    for q in range(len(chosen)):
        c = chosen[q]
        i = candidates.node[c]
        h, jump = nodes.parent[i], nodes.jump[i]
        if jump >= 0:
            add_noise(into, q, bank.mean[h], bank.covariance[h].copy(), factors[jump, : ranks[jump]])
        doubts = candidates.doubts[c]
        doubted, held = edges_of(doubts, table.edges), edges_of(doubts & table.held, table.edges)
        before = edges_of(bank.doubts[h], table.edges)
        for edge in range(len(seen.found)):
            if (doubted >> edge) & 1:
                fresh, stays = (before >> edge) & 1 == 0, (held >> edge) & 1 == 1
                foreign(into, q, seen, edge, fresh, stays, sizes, nodes.at[i, edge], nodes.wide[i, edge], True, True)
            elif seen.found[edge] > 0 and nodes.unsearched[i, edge]:
                foreign(into, q, seen, edge, False, True, sizes, nodes.at[i, edge], nodes.wide[i, edge], False, True)
            elif seen.found[edge] > 0 and nodes.line[i, edge] >= 0:
                forget(into, q, edge)
                learn(into, q, seen, edge, nodes.line[i, edge])
