"""A maker of pictures for renderers' processes, which import this module alone."""

from __future__ import annotations

import time

import numpy as np

from gripmon.model.records import Frame

SHAPE = (6, 8)


class CountingMaker:
    """Images filled with their number; it can fail, or be slow, from a frame on."""

    def __init__(self, fails_at: int | None = None, pause_s: float = 0.0) -> None:
        self.fails_at, self.pause_s = fails_at, pause_s

    def frame(self, index: int) -> Frame:
        if index == self.fails_at:
            raise ArithmeticError(f"no picture {index}")
        time.sleep(self.pause_s)
        return Frame(index, 0, np.full(SHAPE, index % 251, np.uint8), 1e-3 * index)
