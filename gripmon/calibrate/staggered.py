"""Staggered discs (OpenCV's asymmetric circles) as part of a square lattice that is turned by 45 degrees."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gripmon.model.targets import CircleGrid, StaggeredCircles

Lattice = tuple[tuple[int, int], float]


def lattice_of(target: CircleGrid) -> Lattice:
    """Columns and rows of the square lattice in which the target's discs lie, and its step (m)."""
    if not isinstance(target, StaggeredCircles):
        return (target.columns, target.rows), target.step_m
    x, y = np.array(target.places).T
    side = int(max(np.ptp(x + y), np.ptp(y - x))) // 2 + 1
    return (side, side), math.sqrt(2.0) * target.step_m


def places_of(cells: NDArray[np.intp], target: StaggeredCircles) -> NDArray[np.intp] | None:
    """Steps (n, 2) along the target's x and y of the discs at cells (n, 2) of its lattice; None if these cells are no
    part of it.  Of several places the first: a part of the target may be anywhere on it.
    """
    there = np.zeros(np.array(target.last) + 1, bool)
    there[tuple(np.array(target.places).T)] = True
    for _ in range(4):
        cells = np.stack([-cells[:, 1], cells[:, 0]], axis=1)
        steps = np.stack([cells[:, 0] - cells[:, 1], cells.sum(axis=1)], axis=1)
        steps -= steps.min(axis=0)
        free = np.array(there.shape) - steps.max(axis=0)
        for shift in np.ndindex(*np.maximum(free, 0)):
            moved: NDArray[np.intp] = steps + shift
            if there[tuple(moved.T)].all():
                return moved
    return None
