"""Whether a board ends where its points end (else it has more of them than was said), and which way up it is."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.calibrate.detection.pictures import Grey, to_grey
from gripmon.calibrate.sighting import NotFound, Sighting
from gripmon.model.records import Array, Image
from gripmon.model.targets import Chequerboard

LEAST_CONTRAST = 0.2
"""Between dark and light squares, over the range of the squares' grey levels: what is less may be light and shadow."""
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


def upright(image: Image, sighting: Sighting, board: Chequerboard) -> Sighting | NotFound:
    """``sighting`` of a whole board whose numbers of corners are one even, one odd, turned such that the square between
    its first corners along both axes is dark.  :class:`NotFound` where a part of the board is hidden (the lattice's
    origin is unknown then), or the colours don't tell.
    """
    count = board.columns * board.rows
    if len(sighting) != count:
        return NotFound(f"{len(sighting)} of the board's {count} corners; all of them, to tell which way up it is")
    cells = np.rint(sighting.plate_m[:, :2] / board.square_m).astype(int)
    cells -= cells.min(axis=0)
    if tuple(cells.max(axis=0) + 1) == (board.rows, board.columns):  # x along the columns
        cells = np.stack([cells[:, 1], board.rows - 1 - cells[:, 0]], axis=1)
    if tuple(cells.max(axis=0) + 1) != (board.columns, board.rows):
        return NotFound("the corners aren't the whole board; all of them, to tell which way up it is")
    places = np.empty((board.columns, board.rows, 2))
    places[cells[:, 0], cells[:, 1]] = sighting.uv_px
    # A square's middle by its four corners: perspective and lens hardly bend one square.
    middles = 0.25 * (places[:-1, :-1] + places[1:, :-1] + places[:-1, 1:] + places[1:, 1:])
    grey = to_grey(image)
    levels = grey[tuple(np.rint(middles[..., k]).astype(int) for k in (1, 0))].astype(np.float64)
    even = np.indices(levels.shape).sum(axis=0) % 2 == 0
    difference = float(np.median(levels[even]) - np.median(levels[~even]))
    if abs(difference) <= LEAST_CONTRAST * float(np.ptp(levels)):
        return NotFound("dark and light squares don't tell which way up the board is; a board in even light")
    if difference > 0.0:
        cells = [board.columns - 1, board.rows - 1] - cells
    plate_m = np.concatenate([cells * board.square_m, np.zeros((count, 1))], axis=1)
    return replace(sighting, plate_m=plate_m)
