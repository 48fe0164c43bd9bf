"""What is held goes where the gripper goes, in a frame before which the gripper may have moved: compiled.

Of a thing that was seen before, y = y' + c w, with w the noise that g got since and c an edge's row.  Given g after it,
w is known as well as g is:  w | g  ~  N(Q P^-1 (g - m), Q - Q P^-1 Q),  so that each such row is one more row of g.
"""

from __future__ import annotations

import math

import numpy as np

from gripmon.belief.nodes import Nodes
from gripmon.belief.rows import forward, normal
from gripmon.belief.state import SIZE, Bank, Seen
from gripmon.belief.things import expect_thing, not_drawn
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
    kind, total = int(bank.kind[h, edge, 1] > bank.kind[h, edge, 0]), -math.log(seen.found[edge])
    expected_px, variance, way = np.empty(2), np.empty(2), np.zeros(SIZE)
    place, spread, best, most = np.empty(2), np.empty(3), 0, -math.inf
    for row in range(2):
        expect_thing(bank, h, seen, edge, row, kind, 1.0, 0.0, place, spread)
        expected_px[row] = bank.searched[h, edge, kind, row] + place[0] + place[1]
        variance[row] = spread[0] + 2.0 * spread[1] + spread[2]
    for of in range(seen.found[edge]):
        log = 0.0
        for row in range(2):
            known = variance[row] + seen.image_white[edge, of, row]
            by_noise = moved(noise, seen.rows[edge, of, row], way)
            log += normal(seen.image[edge, of, row] - expected_px[row], known + by_noise)
        if log > most:
            best, most = of, log
    for row in range(2):
        left = moved(noise, seen.rows[edge, best, row], way)
        forward(nodes.root[i], way)
        for j in range(SIZE):
            left -= way[j] * way[j]
        left = max(left, 0.0) + variance[row] + seen.image_white[edge, best, row]
        total -= 0.5 * math.log(2.0 * math.pi * left)
        for j in range(SIZE):
            nodes.going[i, edge, row, j] = way[j] / math.sqrt(left)
        nodes.gone[i, edge, row] = (seen.image[edge, best, row] - expected_px[row]) / math.sqrt(left)
    return total + math.log(1.0 - missed)


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
