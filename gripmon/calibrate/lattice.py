"""Points of a square lattice in an image.

A lattice is grown from a seed, point by point, by predictions from neighbours that are already known.  A part of a
plate is therefore enough, whatever lies on it, and lens distortion doesn't matter.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Mapping
from typing import Protocol

import numpy as np
from scipy.spatial import cKDTree

from gripmon.model.records import Array

GATE_STEPS = 0.35
"""Gate for a predicted point, in steps of the lattice: a fisheye's steps change by as much."""
SEEDS = 60
"""Maximum number of seeds that are tried."""
_NEIGHBOURS = 8
_WAYS = ((0, 1), (0, -1), (1, 1), (1, -1))  # axis and direction
Index = tuple[int, int]


class LatticeRules(Protocol):
    """Which points can be neighbours on a lattice, besides their positions."""

    def neighbours(self, a: int, b: int, step_px: Array) -> bool:
        """Whether point b, a step (2,) from a, can be its neighbour on the lattice."""

    def basis(self, at: int, a_px: Array, b_px: Array) -> bool:
        """Whether two steps from a point can be those of a *square* lattice."""


def find_lattice(points_px: Array, rules: LatticeRules) -> dict[Index, int]:
    """Lattice coordinates (column, row) -> index of the point, for the largest lattice among points (n, 2); the
    lattice's axes have the same handedness as the image's.  Empty if there is none of at least 3 x 3.
    """
    if len(points_px) < 9:
        return {}
    tree = cKDTree(points_px)
    best: dict[Index, int] = {}
    tried: set[int] = set()
    count = 0
    middle = np.median(points_px, axis=0)
    for seed in np.argsort(np.linalg.norm(points_px - middle, axis=1)).tolist():
        if seed in tried:
            continue
        bases = _bases(points_px, tree, seed, rules)
        count += bool(bases)
        for basis in bases:
            grown = _grow(points_px, tree, seed, basis, rules)
            tried.update(grown.values())
            if len(grown) > len(best):
                best = grown
        if len(best) > 0.5 * len(points_px) or count >= SEEDS:
            break
    best = _consistent(points_px, best)
    columns, rows = extent(best)
    return best if min(columns, rows) >= 3 and len(best) >= 9 else {}


def trimmed(lattice: dict[Index, int], columns: int, rows: int) -> dict[Index, int]:
    """Remove sparse outermost lines while the lattice is larger than ``columns`` x ``rows``, in either orientation:
    those are points beside the target that fit by chance.
    """
    out = dict(lattice)
    while out:
        seen = extent(out)
        excess = min(
            ((seen[0] - columns, seen[1] - rows), (seen[0] - rows, seen[1] - columns)),
            key=lambda e: max(e[0], 0) + max(e[1], 0),
        )
        lines: list[tuple[int, int, int]] = []
        for axis in (0, 1):
            if excess[axis] > 0:
                places = [cell[axis] for cell in out]
                lines += [(places.count(place), axis, place) for place in (min(places), max(places))]
        if not lines:
            return out
        fewest, axis, place = min(lines)
        if fewest >= 0.5 * len(out) / seen[axis]:
            return out
        out = {cell: index for cell, index in out.items() if cell[axis] != place}
    return out


def extent(lattice: Mapping[Index, object]) -> tuple[int, int]:
    """Columns and rows that a lattice spans."""
    if not lattice:
        return 0, 0
    cells = np.array(list(lattice))
    size = cells.max(axis=0) - cells.min(axis=0) + 1
    return int(size[0]), int(size[1])


def _bases(points: Array, tree: cKDTree, seed: int, rules: LatticeRules) -> list[tuple[Array, Array]]:
    """Pairs of steps from a point to neighbours that the opposite neighbours confirm, the shortest first."""
    count = min(_NEIGHBOURS + 1, len(points))
    _, near = tree.query(points[seed], count)
    confirmed = []
    for k in np.atleast_1d(near)[1:].tolist():
        step = points[k] - points[seed]
        back = _near(tree, points[seed] - step, float(np.hypot(*step)))
        if back is not None and rules.neighbours(seed, k, step) and rules.neighbours(seed, back, -step):
            confirmed.append(step)
    out = []
    for a, b in itertools.combinations(confirmed, 2):
        turning = float(a[0] * b[1] - a[1] * b[0])
        if abs(turning) < 0.2 * float(np.hypot(*a) * np.hypot(*b)) or not rules.basis(seed, a, b):
            continue
        if turning < 0.0:
            a, b = b, a
        corner = points[seed] + a + b
        if _near(tree, corner, min(float(np.hypot(*a)), float(np.hypot(*b)))) is not None:
            out.append((a, b))
    return sorted(out, key=lambda pair: float(pair[0] @ pair[0] + pair[1] @ pair[1]))[:3]


def _near(tree: cKDTree, where: Array, step_px: float) -> int | None:
    distance, index = tree.query(where)
    return int(index) if distance < GATE_STEPS * step_px else None


def _grow(points: Array, tree: cKDTree, seed: int, basis: tuple[Array, Array], rules: LatticeRules) -> dict[Index, int]:
    found: dict[Index, int] = {(0, 0): seed}
    taken = {seed}
    local: dict[Index, Array] = {(0, 0): np.stack(basis)}
    queue = deque([(0, 0)])
    while queue:
        at = queue.popleft()
        here = points[found[at]]
        for axis, sign in _WAYS:
            to, behind = _beside(at, axis, sign), _beside(at, axis, -sign)
            if to in found:
                continue
            step = here - points[found[behind]] if behind in found else sign * local[at][axis]
            index = _near(tree, here + step, float(np.hypot(*step)))
            if index is None or index in taken or not rules.neighbours(found[at], index, points[index] - here):
                continue
            found[to] = index
            taken.add(index)
            moved = local[at].copy()
            moved[axis] = sign * (points[index] - here)
            # The other step changes slowly: take the neighbour's where it is known.
            local[to] = _own_steps(points, found, to, moved)
            queue.append(to)
    return found


def _own_steps(points: Array, found: dict[Index, int], at: Index, otherwise: Array) -> Array:
    out = otherwise.copy()
    for axis, sign in _WAYS:
        neighbour = _beside(at, axis, sign)
        if neighbour in found:
            out[axis] = sign * (points[found[neighbour]] - points[found[at]])
    return out


def _beside(at: Index, axis: int, steps: int) -> Index:
    return (at[0] + steps, at[1]) if axis == 0 else (at[0], at[1] + steps)


def _consistent(points: Array, lattice: dict[Index, int]) -> dict[Index, int]:
    """Remove points that lie off the midpoint of two neighbours on a line: they met a prediction by chance."""
    out = dict(lattice)
    for at, index in lattice.items():
        for axis in (0, 1):
            before, after = _beside(at, axis, -1), _beside(at, axis, 1)
            if before in lattice and after in lattice:
                low, high = points[lattice[before]], points[lattice[after]]
                off = np.hypot(*(points[index] - 0.5 * (low + high)))
                if off > 0.12 * float(np.hypot(*(high - low))):
                    out.pop(at, None)
    return out


def fits(lattice: Mapping[Index, object], columns: int, rows: int, least: int = 1) -> bool:
    """Whether a lattice can be part of ``columns`` x ``rows``, in either orientation, and is large enough: nine points,
    and ``least`` in each of its rows and columns.
    """
    seen = extent(lattice)
    return len(lattice) >= 9 and max(seen) <= max(columns, rows) and least <= min(seen) <= min(columns, rows)
