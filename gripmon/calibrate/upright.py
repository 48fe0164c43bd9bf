"""Which way up a chequerboard is, by its colours: corners alone look the same after half a turn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gripmon.calibrate.pictures import to_grey
from gripmon.calibrate.sighting import NotFound, Sighting
from gripmon.model.records import Image
from gripmon.model.targets import Chequerboard

LEAST_CONTRAST = 0.2
"""Between dark and light squares, over the range of the squares' grey levels: what is less may be light and shadow."""


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
