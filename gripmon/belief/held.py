"""What is held goes where the gripper goes, in a frame before which the gripper may have moved: compiled.

Of a thing that was seen before, y = y' + c w, with w the noise that g got since and c an edge's row.  Given g after it,
w is known as well as g is:  w | g  ~  N(Q P^-1 (g - m), Q - Q P^-1 Q),  so that each such row is one more row of g.
"""

from __future__ import annotations

import math

import numpy as np

from gripmon.belief.nodes import Nodes
from gripmon.belief.rows import forward, normal, strength_of
from gripmon.belief.state import SIZE, Bank, Seen
from gripmon.belief.things import not_drawn
from gripmon.model.compiled import compiled
from gripmon.model.records import Array


@compiled
def follow(nodes: Nodes, i: int, bank: Bank, h: int, noise: Array, seen: Seen, held: int, missed: float) -> None:
    """Node ``i``, of hypothesis ``h`` that had edges ``held`` (bits), after ``noise`` (r, 23) on g; ``missed``: the
    probability that a thing isn't found.
    """
    nodes.follows[i] = 0
    for edge in range(len(seen.found) if len(noise) else 0):
        if (held >> edge) & 1 and seen.found[edge] > 0 and not not_drawn(bank, h, edge):
            nodes.follows[i] |= 1 << edge
            nodes.goes[i, edge] = go(nodes, i, bank, h, noise, seen, edge, missed)


@compiled
def go(nodes: Nodes, i: int, bank: Bank, h: int, noise: Array, seen: Seen, edge: int, missed: float) -> float:
    """The rows of the line that is nearest to where the thing would be had the gripper stayed; what of their log
    likelihood depends on no set.
    """
    kind = int(bank.kind[h, edge, 1] > bank.kind[h, edge, 0])
    like, total = seen.likeness[edge], math.log(1.0 - missed) - math.log(seen.found[edge])
    missing, variance, way = np.empty((seen.found[edge], 2)), np.empty((seen.found[edge], 2)), np.zeros(SIZE)
    best, most = 0, -math.inf
    for of in range(seen.found[edge]):
        log = 0.0
        for row in range(2):
            place, spread = bank.place[h, edge, kind, row], bank.place_spread[h, edge, kind, row]
            variance[of, row] = spread[0] + like * (2.0 * spread[1] + like * spread[2])
            variance[of, row] += (1.0 - like * like) * strength_of(seen, edge, row) + seen.image_white[edge, of, row]
            missing[of, row] = seen.image[edge, of, row] - bank.searched[h, edge, kind, row]
            missing[of, row] -= place[0] + like * place[1]
            log += normal(missing[of, row], variance[of, row] + moved(noise, seen.rows[edge, of, row], way))
        if log > most:
            best, most = of, log
    for row in range(2):
        by_noise = moved(noise, seen.rows[edge, best, row], way)
        forward(nodes.root[i], way)
        known = 0.0
        for j in range(SIZE):
            known += way[j] * way[j]
        left = variance[best, row] + max(by_noise - known, 0.0)
        total -= 0.5 * math.log(2.0 * math.pi * left)
        for j in range(SIZE):
            nodes.going[i, edge, row, j] = way[j] / math.sqrt(left)
        nodes.gone[i, edge, row] = missing[best, row] / math.sqrt(left)
    return total


@compiled
def moved(noise: Array, line: Array, way: Array) -> float:
    """Variance of what ``noise`` B (r, 23) moves a row ``line`` (23,) by, c B'B c'; ``way`` (23,) becomes B'B c'."""
    total = 0.0
    way[:] = 0.0
    for k in range(len(noise)):
        along = 0.0
        for j in range(SIZE):
            along += noise[k, j] * line[j]
        for j in range(SIZE):
            way[j] += along * noise[k, j]
        total += along * along
    return total
