"""What another thing's edge looks like that lies where one of the gripper's is searched, and what is remembered of it.

A thing lies near or far from where it was searched, and stays there while the picture does; compiled.
"""

from __future__ import annotations

import math

import numpy as np

from gripmon.belief.rows import log_sum, strength_of
from gripmon.belief.state import (
    FAR,
    FOREIGN_KINDS,
    LINES_APART_PX,
    MEMORIES,
    MOST_LINES,
    NEAR,
    STILL,
    Bank,
    Seen,
)
from gripmon.model.compiled import compiled
from gripmon.model.records import Array


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
def expect_thing(
    bank: Bank, h: int, seen: Seen, edge: int, row: int, slot: int, stays: float, size: float, place: Array,
    spread: Array,
) -> None:  # fmt: skip
    """Where a row of a remembered thing is before it is seen again: ``place`` (2,) and ``spread`` (3,) as in
    :func:`drawn`.  Of those but the last one seen the background counts as new.
    """
    like = 0.0 if slot >= FOREIGN_KINDS else seen.likeness[edge] if seen.found[edge] > 0 else 1.0
    was = bank.place_spread[h, edge, slot, row]
    place[0] = stays * bank.place[h, edge, slot, row, 0]
    place[1] = like * bank.place[h, edge, slot, row, 1]
    spread[0] = stays * stays * was[0] + (1.0 - stays * stays) * size
    spread[1] = stays * like * was[1]
    spread[2] = like * like * was[2] + (1.0 - like * like) * strength_of(seen, edge, row)


@compiled
def row_of_thing(
    bank: Bank, h: int, seen: Seen, edge: int, of: int, row: int, slot: int, stays: float, size: float, place: Array,
    spread: Array,
) -> float:  # fmt: skip
    """Log likelihood of one row of line ``of`` as a remembered thing's, whose ``place`` (2,) learns from it, with its
    ``spread`` (3,), as in :func:`drawn`.
    """
    expect_thing(bank, h, seen, edge, row, slot, stays, size, place, spread)
    if seen.found[edge] == 0:
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
