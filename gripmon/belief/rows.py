"""What a hypothesis remembers of each row given g, compiled: how it fades, moves with g, and learns.

h hypotheses, e edges with two rows each, k states of a row; everything else as in :class:`~gripmon.belief.state.Bank`.
"""

from __future__ import annotations

import math

import numpy as np

from gripmon.belief.state import (
    FAR,
    FOREIGN_KINDS,
    LIGHT,
    LINES_APART_PX,
    MEMORIES,
    MOST_LINES,
    NEAR,
    SIZE,
    STILL,
    Bank,
    Seen,
)
from gripmon.model.compiled import compiled
from gripmon.model.records import Array

LEAST_APART = 1e-8
"""Standard deviation, m and rad, of what p gains in a frame beside d: of rows it changes 1e-10 px^2."""


@compiled
def root_of(matrix: Array, root: Array) -> float:
    """Cholesky's lower ``root`` (n, n) of a positive ``matrix``; half the logarithm of its determinant, NaN if it isn't
    positive.
    """
    half = 0.0
    for i in range(len(matrix)):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= root[i, k] * root[j, k]
            if j < i:
                root[i, j] = rest / root[j, j]
            elif rest > 0.0:
                root[i, i] = math.sqrt(rest)
                half += math.log(root[i, i])
            else:
                return math.nan
        for j in range(i + 1, len(matrix)):
            root[i, j] = 0.0
    return half


@compiled
def forward(root: Array, values: Array) -> None:
    """``values`` (n,) become root^-1 values."""
    for i in range(len(root)):
        total = values[i]
        for k in range(i):
            total -= root[i, k] * values[k]
        values[i] = total / root[i, i]


@compiled
def backward(root: Array, values: Array) -> None:
    """``values`` (n,) become root^-T values."""
    for i in range(len(root) - 1, -1, -1):
        total = values[i]
        for k in range(i + 1, len(root)):
            total -= root[k, i] * values[k]
        values[i] = total / root[i, i]


@compiled
def move(bank: Bank, h: int, lag: float, light: float) -> None:
    """p goes ``lag`` of the way to d, and the light keeps a share: both ways can be undone, so each row keeps exactly
    what it knew.
    """
    mean, covariance, slope = bank.mean[h], bank.covariance[h], bank.slope[h]
    for i in range(6, 12):
        mean[i] += lag * (mean[i - 6] - mean[i])
    mean[LIGHT] *= light
    for j in range(SIZE):
        for i in range(6, 12):
            covariance[i, j] += lag * (covariance[i - 6, j] - covariance[i, j])
        covariance[LIGHT, j] *= light
    for i in range(SIZE):
        for j in range(6, 12):
            covariance[i, j] += lag * (covariance[i, j - 6] - covariance[i, j])
        covariance[i, LIGHT] *= light
    for i in range(6):  # without creep p comes so near d that the covariance would have no root
        covariance[6 + i, 6 + i] += LEAST_APART**2
    for q in range(slope.shape[0]):
        for k in range(slope.shape[1]):
            own = slope[q, k]  # A g = A F^-1 g'
            for i in range(6, 12):
                own[i] /= 1.0 - lag
                own[i - 6] -= lag * own[i]
            own[LIGHT] /= light


@compiled
def gains(covariance: Array, factor: Array, gain: Array, between: Array, root: Array) -> None:
    """What adding noise B'B (``factor`` B (r, 23)) to g does: ``covariance`` becomes P' = P + B'B, ``gain`` (r, 23) is
    B P'^-1, and ``between`` (r, r) is 1 - B P'^-1 B', the covariance of the noise once g' is known.
    """
    r = len(factor)
    for i in range(SIZE):
        for j in range(SIZE):
            for k in range(r):
                covariance[i, j] += factor[k, i] * factor[k, j]
    root_of(covariance, root)
    for k in range(r):
        for i in range(SIZE):
            gain[k, i] = factor[k, i]
        forward(root, gain[k])
        backward(root, gain[k])
    for k in range(r):
        for m in range(r):
            total = 1.0 if k == m else 0.0
            for i in range(SIZE):
                total -= gain[k, i] * factor[m, i]
            between[k, m] = total


@compiled
def shift_row(mean: Array, factor: Array, gain: Array, slope: Array, along: Array) -> float:
    """Change one state's ``slope`` (23,) to what it is given g' = g + w, and return how its offset changes; ``along``
    (r,) receives slope B', by which the noise is in it.
    """
    moved = 0.0
    for k in range(len(factor)):
        total = 0.0
        for i in range(SIZE):
            total += slope[i] * factor[k, i]
        along[k] = total
    for k in range(len(factor)):
        at = 0.0
        for i in range(SIZE):
            at += gain[k, i] * mean[i]
            slope[i] -= along[k] * gain[k, i]
        moved += along[k] * at
    return moved


@compiled
def add_noise(bank: Bank, h: int, mean: Array, covariance: Array, factor: Array) -> None:
    """g gets noise with covariance B'B (``factor`` B (r, 23)): each row keeps its joint law with g', exactly.  What the
    noise ties between rows is dropped (p takes most of it).  Of g that is before it, ``mean`` (23,) and ``covariance``
    (23, 23), the latter becomes that after it.
    """
    r, states = len(factor), bank.offset.shape[2]
    gain, between, root = np.empty((r, SIZE)), np.empty((r, r)), np.empty((SIZE, SIZE))
    along = np.empty((states, r))
    gains(covariance, factor, gain, between, root)
    for q in range(bank.offset.shape[1]):
        for k in range(states):
            bank.offset[h, q, k] += shift_row(mean, factor, gain, bank.slope[h, q, k], along[k])
        for k in range(states):
            for m in range(states):
                total = 0.0
                for i in range(r):
                    for j in range(r):
                        total += along[k, i] * between[i, j] * along[m, j]
                bank.spread[h, q, k, m] += total


@compiled
def strength_of(seen: Seen, edge: int, row: int) -> float:
    """Variance of the background's error of one of an edge's rows: of errors that are independent along it, that of the
    slope times half the length is three times that of the offset.
    """
    return seen.strength[edge] * (3.0 if row == 1 else 1.0)


@compiled
def fade(bank: Bank, h: int, seen: Seen) -> None:
    """The errors before the backgrounds that are behind the edges now: as like them as the pictures are."""
    for q in range(bank.offset.shape[1]):
        edge = q // 2
        if seen.found[edge] == 0:
            continue
        s, rho = 1 + seen.background[edge], seen.likeness[edge]
        bank.offset[h, q, s] *= rho
        for i in range(SIZE):
            bank.slope[h, q, s, i] *= rho
        for k in range(bank.offset.shape[2]):
            bank.spread[h, q, s, k] *= rho
            bank.spread[h, q, k, s] *= rho
        bank.spread[h, q, s, s] += (1.0 - rho * rho) * strength_of(seen, edge, q % 2)


@compiled
def learn(bank: Bank, h: int, seen: Seen, edge: int, of: int) -> None:
    """Both rows of an edge that is taken for the gripper's own, ``of`` the lines there."""
    states, s = bank.offset.shape[2], 1 + seen.background[edge]
    gain, line = np.empty(states), np.empty(SIZE)
    for row in range(2):
        q = 2 * edge + row
        offset, slope, spread = bank.offset[h, q], bank.slope[h, q], bank.spread[h, q]
        variance = spread[0, 0] + 2.0 * spread[0, s] + spread[s, s] + seen.white[edge, of, row]
        missing = seen.lines[edge, of, row] - offset[0] - offset[s]
        for i in range(SIZE):
            line[i] = seen.rows[edge, of, row, i] + slope[0, i] + slope[s, i]
        for k in range(states):
            gain[k] = spread[k, 0] + spread[k, s]
        for k in range(states):
            share = gain[k] / variance
            offset[k] += share * missing
            for i in range(SIZE):
                slope[k, i] -= share * line[i]
            for m in range(states):
                spread[k, m] -= share * gain[m]


@compiled
def log_sum(a: float, b: float) -> float:
    """log(exp(a) + exp(b))."""
    return max(a, b) + math.log1p(math.exp(-abs(a - b)))


@compiled
def normal(missing: float, variance: float) -> float:
    """Log density."""
    return -0.5 * (missing * missing / variance + math.log(2.0 * math.pi * variance))


@compiled
def drawn(place: Array, spread: Array, missing: float, white: float, own: float) -> float:
    """Log likelihood of one row, ``missing`` px from where it was searched, whose ``place`` (2,) (place, background)
    with its variances and covariance ``spread`` (3,) learns from it.  It is known with variance ``white`` there, and
    ``own`` where the gripper's own are: as a density of the same number as theirs.
    """
    missing -= place[0] + place[1]
    known = spread[0] + 2.0 * spread[1] + spread[2]
    variance = known + white
    of_place, of_back = (spread[0] + spread[1]) / variance, (spread[1] + spread[2]) / variance
    place[0] += of_place * missing
    place[1] += of_back * missing
    spread[0] -= of_place * of_place * variance
    spread[1] -= of_place * of_back * variance
    spread[2] -= of_back * of_back * variance
    return -0.5 * (missing * missing / variance + math.log(2.0 * math.pi * (known + own)))


@compiled
def forget(bank: Bank, h: int, edge: int) -> None:
    """What was seen of other things' edges in its place."""
    for slot in range(FOREIGN_KINDS * MEMORIES):
        bank.place_spread[h, edge, slot, :, :] = 0.0


@compiled
def not_drawn(bank: Bank, h: int, edge: int) -> bool:
    """Whether nothing was seen of another thing's edge since the doubt began."""
    return bank.place_spread[h, edge, 0, 0, 0] == 0.0


@compiled
def things_seen(bank: Bank, h: int, edge: int, kind: int) -> int:
    """How many things are remembered that the search found for another thing's edge."""
    known = 0
    while known < MEMORIES and bank.place_spread[h, edge, FOREIGN_KINDS * known + kind, 0, 0] > 0.0:
        known += 1
    return known


@compiled
def row_of_thing(
    bank: Bank, h: int, seen: Seen, edge: int, of: int, row: int, slot: int, stays: float, size: float, place: Array,
    spread: Array,
) -> float:  # fmt: skip
    """Log likelihood of one row of line ``of`` as a remembered thing's, whose ``place`` (2,) learns from it, with its
    ``spread`` (3,), as in :func:`drawn`.  Of those but the last one seen the background counts as new.
    """
    shown = seen.found[edge] > 0
    like = 0.0 if slot >= FOREIGN_KINDS else seen.likeness[edge] if shown else 1.0
    was = bank.place_spread[h, edge, slot, row]
    place[0] = stays * bank.place[h, edge, slot, row, 0]
    place[1] = like * bank.place[h, edge, slot, row, 1]
    spread[0] = stays * stays * was[0] + (1.0 - stays * stays) * size
    spread[1] = stays * like * was[1]
    spread[2] = like * like * was[2] + (1.0 - like * like) * strength_of(seen, edge, row)
    if not shown:
        return 0.0
    missing = seen.image[edge, of, row] - bank.searched[h, edge, slot, row]
    return drawn(place, spread, missing, seen.image_white[edge, of, row], seen.white[edge, of, row])


@compiled
def row_of_new_thing(
    seen: Seen, edge: int, of: int, row: int, at: float, variance: float, place: Array, spread: Array
) -> float:
    """The same as that of a thing that wasn't seen before and lies ``at`` px, with a ``variance``, from where the edge
    was searched.
    """
    white = seen.white[edge, of, row]
    place[0], place[1] = at, 0.0
    spread[0], spread[1], spread[2] = variance, 0.0, strength_of(seen, edge, row)
    return drawn(place, spread, seen.lines[edge, of, row] - seen.searched[edge, of, row], white, white)


@compiled
def reached(bank: Bank, h: int, seen: Seen, edge: int, kind: int, known: int, stays: float, reach: float) -> bool:
    """Whether anything that is remembered of an edge lies within the ``reach`` (a variance, px^2) of a search that
    found something: of what wasn't looked at nothing is found.
    """
    for way in range(known):
        slot = FOREIGN_KINDS * way + kind
        for of in range(seen.found[edge]):
            centre = seen.image[edge, of, 0] - seen.lines[edge, of, 0] + seen.searched[edge, of, 0]
            if (centre - bank.searched[h, edge, slot, 0] - stays * bank.place[h, edge, slot, 0, 0]) ** 2 <= reach:
                return True
    return False


@compiled
def is_missed(bank: Bank, h: int, seen: Seen, edge: int, kind: int, stays: float, reach: float) -> bool:
    """Whether the thing that was seen last isn't among the lines found, where the search would have found it."""
    at = bank.searched[h, edge, kind, 0] + stays * bank.place[h, edge, kind, 0, 0]
    spread, looked = bank.place_spread[h, edge, kind, 0], False
    wide = LINES_APART_PX**2 + 9.0 * (spread[0] + 2.0 * spread[1] + spread[2])
    for of in range(seen.found[edge]):
        centre = seen.image[edge, of, 0] - seen.lines[edge, of, 0] + seen.searched[edge, of, 0]
        looked = looked or (centre - at) ** 2 <= reach
        if (seen.image[edge, of, 0] - at) ** 2 <= wide:
            return False
    return looked and seen.found[edge] < MOST_LINES


@compiled
def remember(
    bank: Bank, h: int, seen: Seen, edge: int, kind: int, way: int, of: int, place: Array, spread: Array
) -> None:  # fmt: skip
    """What was seen last comes first: the thing ``way`` of those known, or with a line ``of`` a new one, in place of
    what wasn't seen for longest where there are too many.
    """
    searched = np.empty(2)
    for row in range(2):
        if of >= 0:
            searched[row] = seen.image[edge, of, row] - seen.lines[edge, of, row] + seen.searched[edge, of, row]
        else:
            searched[row] = bank.searched[h, edge, FOREIGN_KINDS * way + kind, row]
    for m in range(min(way, MEMORIES - 1), 0, -1):
        slot, newer = FOREIGN_KINDS * m + kind, FOREIGN_KINDS * (m - 1) + kind
        bank.searched[h, edge, slot] = bank.searched[h, edge, newer]
        bank.place[h, edge, slot] = bank.place[h, edge, newer]
        bank.place_spread[h, edge, slot] = bank.place_spread[h, edge, newer]
    bank.searched[h, edge, kind], bank.place[h, edge, kind] = searched, place
    bank.place_spread[h, edge, kind] = spread


@compiled
def foreign(
    bank: Bank, h: int, seen: Seen, edge: int, fresh: bool, held: bool, sizes: Array, at: Array, wide: Array,
    near: bool, keep: bool,
) -> float:  # fmt: skip
    """Log likelihood of an edge that is another thing's, by ``sizes`` (3,): variances of near and far, px^2, and the
    probability that the search finds a line that it hasn't found before, or that the thing has moved.

    It lies near where the gripper's own is expected, ``at`` (2,) with variance ``wide`` (2,), or anywhere around where
    it was searched, is any of the lines there, and stays there while the picture does; ``held`` moves with the gripper
    and stays in any case.  Where another place was searched another line is found: several are remembered, and half of
    the frames show the last one; another one without that, where both would be found, misses it.  ``fresh``: the doubt
    begins; of one that begins while nothing is shown the place is
    drawn when something is.  ``near``: it may be near.  ``keep``: it is learnt, and what wasn't shown fades.
    """
    count = seen.found[edge]
    if fresh and keep:
        forget(bank, h, edge)
    fresh = fresh or not_drawn(bank, h, edge)
    if count == 0 and fresh:
        return 0.0
    like = seen.likeness[edge] if count > 0 else 1.0
    stays = 1.0 if held or like >= STILL else like
    logs, place, spread = np.empty(FOREIGN_KINDS), np.zeros((2, 2)), np.zeros((2, 3))
    best, best_spread = np.zeros((2, 2)), np.zeros((2, 3))
    for kind in range(FOREIGN_KINDS):
        most, total, best_way, best_line = -math.inf, -math.inf, 0, 0
        known = 0 if fresh else things_seen(bank, h, edge, kind)
        another = 1.0 if fresh else sizes[2] if count > 0 else 0.0
        if another > 0.0 and not reached(bank, h, seen, edge, kind, known, stays, sizes[FAR]):
            another = 1.0
        missed = sizes[2] if known > 1 and is_missed(bank, h, seen, edge, kind, stays, sizes[FAR]) else 1.0
        for way in range(known + 1):  # a thing that was seen, the last one first, or one that wasn't
            part = 1.0 if known == 1 else 0.5 if way == 0 else 0.5 * missed / max(known - 1, 1)
            share = math.log(max(another if way == known else (1.0 - another) * part, 1e-300)) - math.log(max(count, 1))
            for of in range(max(count, 1)):
                log = share
                for row in range(2):
                    if way < known:
                        slot = FOREIGN_KINDS * way + kind
                        log += row_of_thing(
                            bank, h, seen, edge, of, row, slot, stays, sizes[kind], place[row], spread[row]
                        )
                    elif count > 0:
                        near_px = at[row] - seen.searched[edge, of, row] if kind == NEAR else 0.0
                        variance = sizes[kind] + (wide[row] if kind == NEAR else 0.0)
                        log += row_of_new_thing(seen, edge, of, row, near_px, variance, place[row], spread[row])
                total = log if total == -math.inf else log_sum(total, log)
                if log > most:
                    most, best_way, best_line = log, way, of
                    best[:, :], best_spread[:, :] = place, spread
        logs[kind] = (-math.log(2.0) if fresh else bank.kind[h, edge, kind]) + total
        if keep:
            line = best_line if best_way == known and count > 0 else -1
            remember(bank, h, seen, edge, kind, best_way, line, best, best_spread)
    total = log_sum(logs[NEAR], logs[FAR]) if near else logs[FAR]
    if keep:
        for kind in range(FOREIGN_KINDS):
            bank.kind[h, edge, kind] = logs[kind] - total
    return total
