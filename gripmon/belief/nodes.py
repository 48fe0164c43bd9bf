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

from gripmon.belief.rows import backward, forward, gains, log_sum, normal, root_of, shift_row
from gripmon.belief.state import SIZE, Bank, Flags, Ints, Seen
from gripmon.belief.things import foreign, not_drawn
from gripmon.model.compiled import compiled
from gripmon.model.records import Array

APART_PX = 1.0
"""Standard deviation of an edge's place beyond which it doesn't tell lines apart that lie two widths of an edge apart.
"""


class Nodes(NamedTuple):
    """n nodes: a hypothesis (``parent`` (n,)) that jumped (``jump`` (n,), -1 for none) before the frame, with log
    weight ``before`` (n,).  ``root`` L (n, 23, 23); whitened ``rows`` w (n, e, 2, 23) and ``missing`` zeta (n, e, 2)
    with variance ``noise`` (n, e, 2) before; ``line`` (n, e), which of the lines there an edge is taken for, -1 for
    none of them; where it is expected, ``at`` (n, e, 2), px, with variance ``wide`` (n, e, 2); ``base`` (n, e), what of
    its log likelihood depends on no set; ``free`` and ``held`` (n, e), its log likelihood as another thing's.  Of edges
    that are ``joint`` (n, e), another thing that lies near is wherever the gripper is by the others: these have ``far``
    (n, e) instead.  ``across`` (n, d), by how much that of each doubt's edges together is larger since a straight thing
    may lie over the ends; ``information`` M - 1 (n, 23, 23) and ``pull`` b (n, 23) of all edges shown; ``hope`` (n,),
    by how much more a place would explain where all edges were on lines, of those that are on none; ``looked`` (n, f):
    at which place a finger's ends were looked at, -1 for none; ``unsearched`` (n, e): nobody looked where an edge would
    be.  Edges (bits) that ``follows`` (n,) names were held and
    go where the gripper goes: with ``goes`` (n, e), ``going`` (n, e, 2, 23), ``gone`` (n, e, 2) instead of ``base``,
    ``rows`` and ``missing``.
    """

    parent: Ints
    jump: Ints
    before: Array
    root: Array
    rows: Array
    missing: Array
    noise: Array
    line: Ints
    at: Array
    wide: Array
    base: Array
    free: Array
    held: Array
    joint: Flags
    far: Array
    across: Array
    information: Array
    pull: Array
    hope: Array
    looked: Ints
    unsearched: Flags
    follows: Ints
    goes: Array
    going: Array
    gone: Array

    @classmethod
    def empty(cls, nodes: int, edges: int, doubts: int, fingers: int) -> Nodes:
        """Zeros."""
        n, e = nodes, edges
        return cls(
            np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros(n), np.zeros((n, SIZE, SIZE)),
            np.zeros((n, e, 2, SIZE)), np.zeros((n, e, 2)), np.zeros((n, e, 2)), np.zeros((n, e), np.int64),
            np.zeros((n, e, 2)), np.zeros((n, e, 2)), np.zeros((n, e)), np.zeros((n, e)), np.zeros((n, e)),
            np.zeros((n, e), bool), np.zeros((n, e)), np.zeros((n, doubts)), np.zeros((n, SIZE, SIZE)),
            np.zeros((n, SIZE)), np.zeros(n), np.zeros((n, fingers), np.int64),
            np.zeros((n, e), bool), np.zeros(n, np.int64), np.zeros((n, e)), np.zeros((n, e, 2, SIZE)),
            np.zeros((n, e, 2)),
        )  # fmt: skip


class Expected(NamedTuple):
    """Where an edge's lines would be if they were the gripper's, by each line's rows: ``place`` (l, 2), whitened slopes
    ``way`` (l, 2, 23), their variance ``prior`` (l, 2), and that of the rows' own errors, ``noise`` (2,).
    """

    place: Array
    way: Array
    prior: Array
    noise: Array


@compiled
def prepare(nodes: Nodes, i: int, bank: Bank, h: int, factor: Array, seen: Seen, sizes: Array, doubted: int) -> None:
    """Node ``i``: hypothesis ``h``, whose edges ``doubted`` (bits) it doubted before, after noise ``factor`` (r, 23) on
    g.
    """
    r, lines = len(factor), seen.lines.shape[1]
    covariance, gain, between = bank.covariance[h].copy(), np.empty((r, SIZE)), np.empty((r, r))
    if r:
        gains(covariance, factor, gain, between, nodes.root[i])
    else:
        root_of(covariance, nodes.root[i])
    nodes.information[i, :, :] = 0.0
    nodes.pull[i, :] = 0.0
    nodes.hope[i] = 0.0
    expected = Expected(np.empty((lines, 2)), np.empty((lines, 2, SIZE)), np.empty((lines, 2)), np.empty(2))
    for edge in range(len(seen.found)):
        nodes.joint[i, edge] = nodes.unsearched[i, edge] = False
        nodes.at[i, edge], nodes.wide[i, edge] = seen.searched[edge, 0], 0.0
        nodes.base[i, edge] = nodes.free[i, edge] = nodes.held[i, edge] = 0.0
        if seen.found[edge] > 0:
            expect(expected, nodes.root[i], bank, h, factor, gain, between, seen, edge)
            take(nodes, i, bank, h, expected, seen, edge, sizes)
            leave(nodes, i, bank, h, seen, edge, sizes, (doubted >> edge) & 1 == 0 or not_drawn(bank, h, edge))


@compiled
def expect(
    into: Expected, root: Array, bank: Bank, h: int, factor: Array, gain: Array, between: Array, seen: Seen, edge: int
) -> None:  # fmt: skip
    """An edge's lines by hypothesis ``h``, after noise ``factor`` (r, 23) on g whose covariance has ``root`` then."""
    mean, r, s = bank.mean[h], len(factor), 1 + seen.background[edge]
    along, known, line = np.empty(r), np.empty(SIZE), np.empty(SIZE)
    for row in range(2):
        q = 2 * edge + row
        offset, slope, spread = bank.offset[h, q], bank.slope[h, q], bank.spread[h, q]
        into.noise[row] = spread[0, 0] + 2.0 * spread[0, s] + spread[s, s]
        expected = offset[0] + offset[s]
        for j in range(SIZE):
            known[j] = slope[0, j] + slope[s, j]
        if r:
            expected += shift_row(mean, factor, gain, known, along)
            for j in range(r):
                for k in range(r):
                    into.noise[row] += along[j] * between[j, k] * along[k]
        for of in range(seen.found[edge]):
            place, prior, way = expected, 0.0, into.way[of, row]
            for j in range(SIZE):
                line[j] = known[j] + seen.rows[edge, of, row, j]
                place += line[j] * mean[j]
            for j in range(SIZE):
                total = 0.0
                for k in range(j, SIZE):
                    total += root[k, j] * line[k]
                way[j] = total
                prior += total * total
            into.place[of, row], into.prior[of, row] = place, prior


@compiled
def take(nodes: Nodes, i: int, bank: Bank, h: int, expected: Expected, seen: Seen, edge: int, sizes: Array) -> None:
    """An edge for one of its lines, or for none of them."""
    of, share, unsearched = which(seen, edge, expected.place, expected.prior + expected.noise, sizes)
    nodes.line[i, edge], nodes.base[i, edge], nodes.unsearched[i, edge] = of, share, unsearched
    usual = max(of, 0)
    nodes.at[i, edge], nodes.wide[i, edge] = expected.place[usual], expected.prior[usual] + expected.noise
    for row in range(2):
        white = nodes.rows[i, edge, row]
        variance = expected.noise[row] + seen.white[edge, usual, row]
        if of < 0:
            white[:] = 0.0
            nodes.missing[i, edge, row] = 0.0
            nodes.hope[i] -= 0.5 * math.log(2.0 * math.pi * variance)
            continue
        scale = 1.0 / math.sqrt(variance)
        for j in range(SIZE):
            white[j] = expected.way[of, row, j] * scale
        zeta = (seen.lines[edge, of, row] - expected.place[of, row]) * scale
        nodes.missing[i, edge, row], nodes.noise[i, edge, row] = zeta, variance
        nodes.base[i, edge] -= 0.5 * math.log(2.0 * math.pi * variance)
        add_row(nodes.information[i], nodes.pull[i], white, zeta, 1.0)
    if of < 0:
        nodes.hope[i] -= share
    if unsearched:
        nodes.base[i, edge] = foreign(
            bank, h, seen, edge, False, True, sizes, nodes.at[i, edge], nodes.wide[i, edge], False, False
        )  # fmt: skip


@compiled
def leave(nodes: Nodes, i: int, bank: Bank, h: int, seen: Seen, edge: int, sizes: Array, fresh: bool) -> None:
    """An edge to another thing; ``fresh``: nothing was seen of that before."""
    at, wide = nodes.at[i, edge], nodes.wide[i, edge]
    apart = wide[0] > APART_PX**2 and seen.fitted[edge] >= 0  # then the fit says where its own would be
    if apart:
        at[:], wide[:] = seen.searched[edge, seen.fitted[edge]], 0.0
    nodes.joint[i, edge] = fresh and apart
    if nodes.joint[i, edge]:
        nodes.far[i, edge] = foreign(bank, h, seen, edge, fresh, False, sizes, at, wide, False, False)
    nodes.free[i, edge] = foreign(bank, h, seen, edge, fresh, False, sizes, at, wide, True, False)
    nodes.held[i, edge] = nodes.free[i, edge]
    if not fresh:
        nodes.held[i, edge] = foreign(bank, h, seen, edge, fresh, True, sizes, at, wide, True, False)


@compiled
def which(seen: Seen, edge: int, places: Array, spreads: Array, sizes: Array) -> tuple[int, float, bool]:
    """The line there that an edge of the gripper is taken for, by each line's rows expected at ``places`` (l, 2) with
    variances ``spreads`` (l, 2), and the log probability of that; or that of its being none of them, with what these
    say as anything's; and whether it can't be among them, since no search reached the place: what was found there is
    other things', maybe the gripper's own, which stay.

    Where it is known to less than lines lie apart, the fit chooses, as for all edges together.
    """
    count, far, missed, reached = seen.found[edge], sizes[1], sizes[2], False
    log, any_of, best, most = -math.log(count), 0.0, -1, -math.inf
    for of in range(count):
        near, anything = 0.0, 0.0
        reached = reached or (places[of, 0] - seen.searched[edge, of, 0]) ** 2 <= far
        for row in range(2):
            value, white = seen.lines[edge, of, row], seen.white[edge, of, row]
            near += normal(value - places[of, row], spreads[of, row] + white)
            anything += normal(value - seen.searched[edge, of, row], far + white)
        any_of += math.exp(anything) / count
        if near > most:
            best, most = of, near
    none, apart = math.log(missed) + math.log(any_of) if missed > 0.0 else -math.inf, spreads[0, 0] > APART_PX**2
    if apart and seen.fitted[edge] >= 0:
        return seen.fitted[edge], math.log(1.0 - missed) + log, False
    if not (reached or apart) and missed > 0.0:
        return -1, math.log(any_of), True
    if missed > 0.0 and (apart or math.log(1.0 - missed) + log + most < none):
        return -1, none, False
    return best, math.log(1.0 - missed) + log, False


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
    nodes: Nodes, i: int, seen: Seen, doubted: int, held: int, added: float, near: float, root: Array, solution: Array
) -> tuple[float, float, int]:  # fmt: skip
    """Log p(frame) of node ``i`` with edges ``doubted`` (bits), of which ``held`` move with the gripper and others may
    lie ``near`` (a variance, px^2); the surprise, by how much the squares of its own rows exceed what is expected,
    halved; and how many rows these are.  ``added``: what is known of edges that are held, over what each says.
    ``root`` (23, 23) of M and ``solution`` (23,) M^-1 b are left behind.
    """
    log, surprise, own = sum_of(nodes, i, seen, doubted, held, 0, near, root, solution)
    log += added
    following = nodes.follows[i] & held
    if following:
        other_root, other = np.empty((SIZE, SIZE)), np.empty(SIZE)
        goes = sum_of(nodes, i, seen, doubted, held, following, near, other_root, other)
        if goes[0] > log:
            root[:, :], solution[:] = other_root, other
            return goes
    return log, surprise, own


@compiled
def sum_of(
    nodes: Nodes, i: int, seen: Seen, doubted: int, held: int, following: int, near: float, root: Array, solution: Array
) -> tuple[float, float, int]:  # fmt: skip
    """:func:`weigh`, where what is held goes where the gripper goes on edges ``following`` (bits), or stays."""
    information, pull = np.empty((SIZE, SIZE)), np.empty(SIZE)
    for j in range(SIZE):
        pull[j] = nodes.pull[i, j]
        for k in range(j + 1):
            information[j, k] = nodes.information[i, j, k]
        information[j, j] += 1.0
    total, far, squares, own, joint = 0.0, 0.0, 0.0, 0, False
    for edge in range(len(seen.found)):
        if seen.found[edge] == 0:
            continue
        if (doubted >> edge) & 1:
            if nodes.joint[i, edge] and not (following >> edge) & 1:
                joint, far = True, far + nodes.far[i, edge]
            else:
                total += nodes.held[i, edge] if (held >> edge) & 1 else nodes.free[i, edge]
            for row in range(2):
                add_row(information, pull, nodes.rows[i, edge, row], nodes.missing[i, edge, row], -1.0)
            if (following >> edge) & 1:
                total += nodes.goes[i, edge] - nodes.held[i, edge]
                for row in range(2):
                    add_row(information, pull, nodes.going[i, edge, row], nodes.gone[i, edge, row], 1.0)
                    squares += nodes.gone[i, edge, row] ** 2
                own += 2
        else:
            total += nodes.base[i, edge]
            if nodes.line[i, edge] < 0:
                continue
            squares += nodes.missing[i, edge, 0] ** 2 + nodes.missing[i, edge, 1] ** 2
            own += 2
    half = root_of(information, root)
    solution[:] = pull
    forward(root, solution)
    explained = 0.0
    for j in range(SIZE):
        explained += solution[j] * solution[j]
    if joint:
        total += log_sum(far, beside(nodes, i, seen, doubted, near, information, pull) + half - 0.5 * explained)
    backward(root, solution)
    squares -= explained
    return total - 0.5 * squares - half, 0.5 * (squares - own), own


@compiled
def beside(
    nodes: Nodes, i: int, seen: Seen, doubted: int, near: float, information: Array, pull: Array
) -> float:  # fmt: skip
    """Log likelihood of edges ``doubted`` (bits) that are joint as all of things ``near`` (a variance, px^2) the
    gripper's own edges: one motion has to put them there.  ``information`` and ``pull`` are those of the own edges and
    are overwritten; what these explain and half the logarithm of their determinant come off.
    """
    total, row_scaled = 0.0, np.empty(SIZE)
    for edge in range(len(seen.found)):
        if not (nodes.joint[i, edge] and (doubted >> edge) & 1):
            continue
        total -= math.log(2.0 * seen.found[edge])
        for row in range(2):
            variance = nodes.noise[i, edge, row] + near
            share = math.sqrt(nodes.noise[i, edge, row] / variance)
            zeta = share * nodes.missing[i, edge, row]
            for j in range(SIZE):
                row_scaled[j] = share * nodes.rows[i, edge, row, j]
            add_row(information, pull, row_scaled, zeta, 1.0)
            total += normal(zeta * math.sqrt(variance), variance)
    root = np.empty((SIZE, SIZE))
    total -= root_of(information, root)
    forward(root, pull)
    for j in range(SIZE):
        total += 0.5 * pull[j] * pull[j]
    return total


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
