"""A hypothesis and one frame, prepared so that any set of doubts is weighed exactly in some microseconds.

With P = L L' the covariance of g, and c a row's slope, v its variance and z its innovation given g's mean, each row is
whitened once: w = L' c / sqrt(v), zeta = z / sqrt(v).  A set of own rows then has

    M = 1 + sum w w',   log p = sum(-log(2 pi v) / 2 - zeta^2 / 2) + b' M^-1 b / 2 - log det M / 2,   b = sum w zeta

and what one edge more or less would change follows from 2 x 2 matrices alone.  Compiled.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gripmon.belief.doubts import Table
from gripmon.belief.rows import backward, foreign, forward, gains, log_sum, root_of, shift_row
from gripmon.belief.state import LENGTHS, SIZE, Bank, Ints, Seen
from gripmon.model.compiled import compiled
from gripmon.model.records import Array

_FIRST = LENGTHS.start


class Nodes(NamedTuple):
    """n nodes: a hypothesis (``parent`` (n,)) that jumped (``jump`` (n,), -1 for none) before the frame, with log
    weight ``before`` (n,).  ``root`` L (n, 23, 23); whitened ``rows`` w (n, e, 2, 23) and ``missing`` zeta (n, e, 2);
    ``base`` (n, e), what of an edge's log likelihood depends on no set; ``free`` and ``held`` (n, e), its log
    likelihood as another thing's; ``across`` (n, d), by how much that of each doubt's edges together is larger since a
    straight thing may lie over the ends; ``information`` M - 1 (n, 23, 23) and ``pull`` b (n, 23) of all edges shown.
    """

    parent: Ints
    jump: Ints
    before: Array
    root: Array
    rows: Array
    missing: Array
    base: Array
    free: Array
    held: Array
    across: Array
    information: Array
    pull: Array

    @classmethod
    def empty(cls, nodes: int, edges: int, doubts: int) -> Nodes:
        """Zeros."""
        n, e = nodes, edges
        return cls(
            np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros(n), np.zeros((n, SIZE, SIZE)),
            np.zeros((n, e, 2, SIZE)), np.zeros((n, e, 2)), np.zeros((n, e)), np.zeros((n, e)), np.zeros((n, e)),
            np.zeros((n, doubts)), np.zeros((n, SIZE, SIZE)), np.zeros((n, SIZE)),
        )  # fmt: skip


@compiled
def prepare(nodes: Nodes, i: int, bank: Bank, h: int, factor: Array, seen: Seen, sizes: Array, doubted: int) -> None:
    """Node ``i``: hypothesis ``h``, whose edges ``doubted`` (bits) it doubted before, after noise ``factor`` (r, 23) on
    g.
    """
    mean, r = bank.mean[h], len(factor)
    covariance, gain, between = bank.covariance[h].copy(), np.empty((r, SIZE)), np.empty((r, r))
    root, along, line = nodes.root[i], np.empty(r), np.empty(SIZE)
    if r:
        gains(covariance, factor, gain, between, root)
    else:
        root_of(covariance, root)
    information, pull = nodes.information[i], nodes.pull[i]
    for j in range(SIZE):
        pull[j] = 0.0
        for k in range(SIZE):
            information[j, k] = 0.0
    for edge in range(len(seen.shown)):
        nodes.base[i, edge] = nodes.free[i, edge] = nodes.held[i, edge] = 0.0
        if not seen.shown[edge]:
            continue
        fresh = (doubted >> edge) & 1 == 0
        nodes.free[i, edge] = foreign(bank, h, seen, edge, fresh, False, sizes, False)
        nodes.held[i, edge] = nodes.free[i, edge]
        if not fresh:
            nodes.held[i, edge] = foreign(bank, h, seen, edge, fresh, True, sizes, False)
        s = 1 + seen.background[edge]
        for row in range(2):
            q = 2 * edge + row
            offset, slope, spread = bank.offset[h, q], bank.slope[h, q], bank.spread[h, q]
            variance = spread[0, 0] + 2.0 * spread[0, s] + spread[s, s] + seen.white[edge, row]
            innovation = seen.measured[edge, row] - offset[0] - offset[s]
            for j in range(SIZE):
                line[j] = slope[0, j] + slope[s, j]
            if r:
                innovation -= shift_row(mean, factor, gain, line, along)
                for j in range(r):
                    for k in range(r):
                        variance += along[j] * between[j, k] * along[k]
            for j in range(SIZE):
                line[j] += seen.rows[edge, row, j]
                innovation -= line[j] * mean[j]
            scale = 1.0 / math.sqrt(variance)
            white = nodes.rows[i, edge, row]
            for j in range(SIZE):
                total = 0.0
                for k in range(j, SIZE):
                    total += root[k, j] * line[k]
                white[j] = total * scale
            zeta = innovation * scale
            nodes.missing[i, edge, row] = zeta
            nodes.base[i, edge] -= 0.5 * math.log(2.0 * math.pi * variance)
            add_row(information, pull, white, zeta, 1.0)


@compiled
def lie_across(nodes: Nodes, i: int, bank: Bank, seen: Seen, table: Table, sizes: Array) -> None:
    """What a straight thing over the fingers' ends explains that edges apart don't: all of them are found as if the
    fingers were longer or shorter by one length, far or near, each but for an edge's width.
    """
    near, far, another, share = sizes[0], sizes[1], sizes[2], sizes[3]
    before = bank.doubts[nodes.parent[i]]
    for k in range(len(table.edges)):
        nodes.across[i, k] = 0.0
        of_ends = False
        for finger in range(len(table.ends)):
            of_ends = of_ends or (table.ends[finger] >> k) & 1 == 1
        if not of_ends:
            continue
        log, apart, squares, cross, along, rows = 0.0, 0.0, 0.0, 0.0, 0.0, 0
        most = 0.0
        for edge in range(len(seen.shown)):
            if (table.edges[k] >> edge) & 1 and seen.shown[edge]:
                for row in range(2):
                    most = max(most, abs(seen.rows[edge, row, _FIRST] + seen.rows[edge, row, _FIRST + 1]))
        for edge in range(len(seen.shown)):
            if not ((table.edges[k] >> edge) & 1 and seen.shown[edge]):
                continue
            apart += nodes.held[i, edge]
            for row in range(2):
                way = (seen.rows[edge, row, _FIRST] + seen.rows[edge, row, _FIRST + 1]) / most
                missing = seen.measured[edge, row] - seen.searched[edge, row]
                variance = near + seen.strength[edge] + seen.white[edge, row]
                log -= 0.5 * math.log(2.0 * math.pi * variance)
                squares += missing * missing / variance
                cross += way * missing / variance
                along += way * way / variance
                rows += 1
        if rows < 4 or most == 0.0:
            continue
        log -= 0.5 * (squares - far * cross * cross / (1.0 + far * along)) + 0.5 * math.log(1.0 + far * along)
        share_now = share if (before >> k) & 1 == 0 else another * share
        if share_now > 0.0:
            nodes.across[i, k] = log_sum(math.log(1.0 - share_now), math.log(share_now) + log - apart)


@compiled
def across(nodes: Nodes, i: int, doubts: int) -> float:
    """The largest of what a set's doubts add."""
    most = 0.0
    for k in range(nodes.across.shape[1]):
        if (doubts >> k) & 1 and (most == 0.0 or nodes.across[i, k] > most):
            most = nodes.across[i, k]
    return most


@compiled
def add_row(information: Array, pull: Array, white: Array, zeta: float, sign: float) -> None:
    """One whitened row more (``sign`` 1) or less (-1); of the information the lower half."""
    for j in range(SIZE):
        share = sign * white[j]
        pull[j] += share * zeta
        for k in range(j + 1):
            information[j, k] += share * white[k]


@compiled
def weigh(
    nodes: Nodes, i: int, seen: Seen, doubted: int, held: int, root: Array, solution: Array
) -> tuple[float, float]:
    """Log p(frame) of node ``i`` with edges ``doubted`` (bits), of which ``held`` move with the gripper; and the
    surprise: by how much the squares of its own rows exceed what is expected, halved.  ``root`` (23, 23) of M and
    ``solution`` (23,) M^-1 b are left behind.
    """
    information, pull = np.empty((SIZE, SIZE)), np.empty(SIZE)
    for j in range(SIZE):
        pull[j] = nodes.pull[i, j]
        for k in range(j + 1):
            information[j, k] = nodes.information[i, j, k]
        information[j, j] += 1.0
    total, squares, own = 0.0, 0.0, 0
    for edge in range(len(seen.shown)):
        if not seen.shown[edge]:
            continue
        if (doubted >> edge) & 1:
            total += nodes.held[i, edge] if (held >> edge) & 1 else nodes.free[i, edge]
            for row in range(2):
                add_row(information, pull, nodes.rows[i, edge, row], nodes.missing[i, edge, row], -1.0)
        else:
            total += nodes.base[i, edge]
            squares += nodes.missing[i, edge, 0] ** 2 + nodes.missing[i, edge, 1] ** 2
            own += 2
    half = root_of(information, root)
    for j in range(SIZE):
        solution[j] = pull[j]
    forward(root, solution)
    for j in range(SIZE):
        squares -= solution[j] * solution[j]
    backward(root, solution)
    return total - 0.5 * squares - half, 0.5 * (squares - own)


@compiled
def without(nodes: Nodes, i: int, edge: int, root: Array, solution: Array, own: bool) -> float:
    """By how much the log likelihood of a weighed set of node ``i`` grows with an ``own`` edge's rows in it, against
    without: its own density, predicted from all others.
    """
    side = np.empty((2, SIZE))
    left = np.empty(2)
    for row in range(2):
        left[row] = nodes.missing[i, edge, row]
        for j in range(SIZE):
            side[row, j] = nodes.rows[i, edge, row, j]
            left[row] -= side[row, j] * solution[j]
        forward(root, side[row])
    a, b, c = 0.0, 0.0, 0.0
    for j in range(SIZE):
        a += side[0, j] * side[0, j]
        b += side[0, j] * side[1, j]
        c += side[1, j] * side[1, j]
    sign = -1.0 if own else 1.0  # of rows that are in the fit, what they explain of themselves is taken out again
    a, b, c = 1.0 + sign * a, sign * b, 1.0 + sign * c
    determinant = max(a * c - b * b, 1e-300)
    square = (c * left[0] ** 2 - 2.0 * b * left[0] * left[1] + a * left[1] ** 2) / determinant
    return nodes.base[i, edge] - 0.5 * square - 0.5 * sign * math.log(determinant)
