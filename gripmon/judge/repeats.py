"""Old pixels beside the edges that a fit rests on, in an image that is new elsewhere.

A decoder that misses data leaves what was there before; so does a coder that sends nothing for what stands still, until
its next key frame.  Whole images that repeat are the stream's affair (``stream``).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gripmon.judge.inspection import FULL_SCALE
from gripmon.judge.stream import RING_FRAMES, StreamFault, StreamSettings
from gripmon.model.compiled import compiled
from gripmon.model.records import Cause, Image
from gripmon.track.edges import Measurement

TILE_PX = 16
"""Side of the tiles that are compared: a macroblock of H.264, the unit of JPEGs with halved colours; a decoder keeps
or replaces it whole.
"""

FEWEST_TILES = 2
"""Fewest tiles along an edge that tell whether it is new: one alone may repeat by itself in a strongly compressed
JPEG.
"""

TEXT = "the image repeats an earlier one to the bit beside the gripper's edges: data are missing, or lost on the way"


class RepeatWatch:
    """Tells of each frame whether an edge in use shows only pixels of an earlier one.  Depends on nothing but the
    frames so far.
    """

    def __init__(self, settings: StreamSettings, edges: int) -> None:
        self._settings = settings
        self._tiles: NDArray[np.uint64] = np.zeros((RING_FRAMES + 1, 0), np.uint64)
        self._slot = 0
        self._new_s = np.full(edges, -np.inf)
        self._fault: StreamFault | None = None
        self._white: dict[np.dtype[Any], int] = {}  # as an unsigned number

    def taken(self) -> StreamFault | None:
        """What there is to say of the newest measured frame where it has lasted, once: a frame in which nothing is
        measured doesn't tell.
        """
        fault, self._fault = self._fault, None
        return fault

    def add(self, image: Image, measurement: Measurement, coded: bool, now_s: float) -> bool:
        """Whether the frame shows nothing new of an edge for longer than a stream may repeat it: one that is ``coded``
        for ``frozen_coded_s``, any other not at all.
        """
        rows, columns = image.shape[:2]
        across = -(-columns // TILE_PX)
        tiles = across * -(-rows // TILE_PX)
        if self._tiles.shape[1] != tiles:
            self._tiles = np.zeros((RING_FRAMES + 1, tiles), np.uint64)
        self._slot = (self._slot + 1) % len(self._tiles)
        pixels = np.ascontiguousarray(image).view(np.uint8).reshape(rows, -1)
        pixels.flags.writeable = False
        prediction, candidates = measurement.prediction, measurement.candidates
        white = self._white.get(image.dtype)
        if white is None:
            white = int(np.array(FULL_SCALE[image.dtype], image.dtype).view(f"u{image.itemsize}"))
            self._white[image.dtype] = white
        new, old = repeated_edges(
            pixels,
            image.itemsize,
            pixels.shape[1] // columns,
            white,
            prediction.uv_px,
            prediction.normal,
            candidates.sample,
            candidates.offset_px,
            measurement.consensus.weight,
            prediction.layout.edge,
            self._tiles,
            self._slot,
            len(self._new_s),
        )
        self._new_s[new | (old & np.isinf(self._new_s))] = now_s
        longest_s = float((now_s - self._new_s[old]).max(initial=0.0))
        settings = self._settings
        late = longest_s > (settings.frozen_coded_s if coded else 0.0)
        self._fault = None
        if late and longest_s >= settings.frozen_s:
            self._fault = StreamFault("repeated", Cause.CAMERA_FROZEN, TEXT)
        return late


@compiled
def repeated_edges(
    pixels: Any, item: int, pixel: int, white: int, uv_px: Any, normal: Any, sample: Any, offset_px: Any, weight: Any,
    edge: Any, ring: Any, slot: int, edges: int,
) -> Any:  # fmt: skip
    """(e,) which edges' points in use lie in tiles of which one is new, and (e,) which in tiles that all repeat one
    earlier frame to the bit; an edge with too few tiles to tell does neither.

    ``pixels`` (h, bytes of a row), of ``item`` bytes a value, that of ``white`` as an unsigned number, and ``pixel``
    bytes a pixel; points (k,) ``offset_px``
    along the normals of their search lines.  ``ring`` (frames, tiles): numbers of the tiles of earlier frames, 0 where
    nothing was in use, 1 where nothing but black and white; those of this frame are written to ``slot``.
    """
    rows, columns = pixels.shape[0], pixels.shape[1] // pixel
    across = (columns + TILE_PX - 1) // TILE_PX
    ring[slot, :] = 0
    frames = ring.shape[0]
    told = np.zeros(edges, np.int64)
    known, same = np.zeros((edges, frames), np.int64), np.zeros((edges, frames), np.int64)
    seen = np.full(ring.shape[1], -1, np.int64)  # the edge that a tile was counted for last
    for k in range(len(sample)):
        if not weight[k] > 0.0:
            continue
        n = sample[k]
        x = int(min(max(uv_px[n, 0] + offset_px[k] * normal[n, 0], 0.0), columns - 1.0)) // TILE_PX
        y = int(min(max(uv_px[n, 1] + offset_px[k] * normal[n, 1], 0.0), rows - 1.0)) // TILE_PX
        tile, e = y * across + x, edge[n]
        if seen[tile] == e:
            continue
        seen[tile] = e
        if ring[slot, tile] == 0:
            ring[slot, tile] = _tile_number(pixels, item, pixel, white, x * TILE_PX, y * TILE_PX)
        if ring[slot, tile] == 1:
            continue
        told[e] += 1
        for frame in range(frames):
            if frame != slot and ring[frame, tile] != 0:
                known[e, frame] += 1
                same[e, frame] += ring[frame, tile] == ring[slot, tile]
    new, old = told >= FEWEST_TILES, np.zeros(edges, np.bool_)
    for e in range(edges):
        for frame in range(frames):
            enough = known[e, frame] >= FEWEST_TILES and 2 * known[e, frame] >= told[e]
            if enough and same[e, frame] == known[e, frame]:
                new[e], old[e] = False, True
    return new, old


@compiled
def _tile_number(pixels: Any, item: int, pixel: int, white: int, left: int, top: int) -> Any:
    """A hash (FNV-1a over whole values) of every other pixel in every other row of a tile, of which black and white
    ones count as one; 1 where half of them are that.
    """
    rows, row = pixels.shape
    number, cut_off, count = np.uint64(14695981039346656037), 0, 0
    for y in range(top, min(top + TILE_PX, rows), 2):
        for first in range(left * pixel, min((left + TILE_PX) * pixel, row), 2 * pixel):
            for x in range(first, first + pixel, item):
                value = np.uint64(0)
                for byte in range(item - 1, -1, -1):
                    value = (value << np.uint64(8)) | np.uint64(pixels[y, x + byte])
                count += 1
                if value == 0 or value == np.uint64(white):
                    cut_off += 1
                    value = np.uint64(0)
                number = (number ^ value) * np.uint64(1099511628211)
    return np.uint64(1) if 2 * cut_off >= count or number < 2 else number


def warm_up() -> None:
    """Compile what a frame needs, or load what was compiled."""
    pixels = np.zeros((TILE_PX, TILE_PX), np.uint8)
    pixels.flags.writeable = False
    points, none = np.zeros((1, 2)), np.zeros(1)
    at = np.zeros(1, np.intp)
    repeated_edges(pixels, 1, 1, 255, points, points, at, none, none, at, np.zeros((2, 1), np.uint64), 0, 1)
