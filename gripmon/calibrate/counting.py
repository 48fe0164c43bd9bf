"""Whether a target ends where its points end: then it has fewer of them than was said."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.calibrate.pictures import Grey
from gripmon.model.records import Array

BARE = 0.3
"""Of the contrast: so much what lies beyond may differ from the plate's own ground."""
_ALL = 0.9


def ends_all_round(grey: Grey, cells: NDArray[np.intp], at: Array, squares: bool) -> bool:
    """True where a lattice (cells (n, 2) from 0 on, at (n, 2) px) has no gaps and the plate beyond all its four sides
    is in view and bare.  False says nothing: a finger, the image's border, or something else may hide the rest.

    ``squares``: the points are corners of squares, else centres of discs.
    """
    columns, rows = (cells.max(axis=0) + 1).tolist()
    if len(cells) < columns * rows or min(columns, rows) < 3:
        return False
    grid = np.empty((rows, columns, 2))
    grid[cells[:, 1], cells[:, 0]] = at
    middles = 0.25 * (grid[1:, 1:] + grid[1:, :-1] + grid[:-1, 1:] + grid[:-1, :-1])
    if squares:
        ink, ground = np.percentile(_levels(grey, middles), [15.0, 85.0]).tolist()
    else:
        ink, ground = float(np.median(_levels(grey, grid))), float(np.median(_levels(grey, middles)))
    for turn in range(4):
        turned = np.rot90(grid, turn)
        edge, step = turned[0], turned[0] - turned[1]
        if squares:  # the middles of the squares that would follow those which end the pattern
            edge, step = 0.5 * (edge[1:] + edge[:-1]), 0.75 * (step[1:] + step[:-1])
        beyond = edge + step
        if ((beyond < 1.0) | (beyond > np.array(grey.shape[::-1]) - 2.0)).any():
            return False
        # Beyond squares of two colours may be either, but the same all along.
        shown, near = _levels(grey, beyond), BARE * abs(ground - ink)
        if max(np.mean(np.abs(shown - level) < near) for level in ((ground, ink) if squares else (ground,))) < _ALL:
            return False
    return True


def _levels(grey: Grey, where: Array) -> Array:
    at = where.reshape(1, -1, 2).astype(np.float32)
    out = cv2.remap(cv2.GaussianBlur(grey, (0, 0), 1.0), at[:, :, 0], at[:, :, 1], cv2.INTER_LINEAR)
    return np.asarray(out[0], np.float64)
