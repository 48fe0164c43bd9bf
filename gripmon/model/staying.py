"""What stays in place while everything behind it changes: edges, and what they enclose.

The grey of a wall stays, too; the borders of a gripper are what stays in front of changing backgrounds.  Each image k
shows at a pixel a gradient of magnitude m and direction θ.  With ``w = min(m / m0, 1)``, since an edge counts the same
whatever its contrast, and doubled angles, since a background may be darker or brighter than a finger::

    share = | sum_k w_k exp(2 i θ_k) | / n

is the share of the n images that show an edge of one direction there: 1 on an outline, some 1 / sqrt(n) where
directions are random (the mean resultant length of circular statistics; Mardia and Jupp, *Directional Statistics*,
2000).  How large it is by chance in these very images is measured: with each image displaced by another amount.

Small cells of the image, divided by such edges, are then merged: across the weakest common boundary first, and cells in
which edges come and go are background from the beginning.  What no boundary without an edge joins to the background is
the gripper.  A gap in an outline does little, since a boundary counts by its mean along its whole length.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from gripmon.model.ranks import of_ranks
from gripmon.model.records import Array

Plane = NDArray[np.float32]
Bits = NDArray[np.bool_]
_T = TypeVar("_T", bound=np.generic)

LEAST_SLOPE = 2.0
"""Slope of an edge that counts in full, grey levels of 255 a pixel: a step of 6.5 levels, blurred to 1.3 px."""
NOISE_SLOPES = 3.0
"""The same, in the slopes that noise alone makes: one in a hundred of these is larger (Rayleigh: exp(-4.5))."""
STAYING_PART = 0.35
"""Where between chance (0) and all images (1) an edge stays: a third of the images may show something else there."""
SURELY_STAYS = 0.6
"""Share from which, if that is more, what is there isn't counted as coming and going: most images show it."""
CHANGING_SLOPES = 4.0
"""Slope that a fifth of the images show, over noise's: noise exceeds it in one of 3,000 (Rayleigh: exp(-8)).  At least
that of an edge that counts: shading and a coder's errors come and go on a plain body as well."""
CHANGING_FACTOR = 2.5
"""... and over the slope that two thirds of the images show, which on a standing edge is about the same."""
CHANGING_PART = 0.3
"""Part of a cell where edges come and go, from which it is background: a thin finger fills two thirds of a cell.  At
most half of what the tenth of the cells has that changes most: a background of few edges."""
LEAST_CHANGING = 0.02
"""Least part of these cells where edges come and go; noise alone makes a thousandth."""
CHANGE_WORTH = 0.3
"""What a boundary between a cell where everything changes and one where nothing does counts over an edge that stays in
all images: by itself, as where a wall begins, less than :data:`STAYING_PART` asks for."""
CLOSED_GAP_PX = 7
"""Gaps in what stays that are closed: at a corner directions mix over the width of two blurred edges."""
CLOSED_CHANGING = 0.2
"""Part of what the background changes by: in what edges that stay enclose less changes, or it is background as well (in
drawn tips and pads nothing does, between jaws that meet from half to twice as much as elsewhere)."""
CELL_PX = 14
"""Side of a cell: its boundary is twice the shortest edge of 8 px that is measured, so that one edge divides it."""
SHORT_PENALTY = 0.3
"""Added to the strength of a boundary as long as a cell's side; boundaries n times as long get 1 / sqrt(n) of it: the
scatter of a mean of n, so that of two equal boundaries the better known one is opened first."""
WIDEST_PX = 1600
"""Wider images are searched at a fraction of their size, which their outlines are not measured at."""
_SMOOTH_PX = 1.0
_BAND_VALUES = 8e6


@dataclass(frozen=True)
class Edges:
    """What the images (n, h, w) show of edges: ``share`` (h, w), 0 to 1, of the images with an edge of one direction;
    ``across_rad`` (h, w), that direction of the gradient, modulo pi; ``ridge`` (h, w), where the slope has its maximum
    across; ``changing`` (h, w), where edges come and go; ``by_chance``, the mean share by chance; ``slope`` (h, w), the
    one that all but a third of the images exceed, grey levels a pixel.
    """

    share: Plane
    across_rad: Plane
    ridge: Bits
    changing: Bits
    by_chance: float
    slope: Plane = field(default_factory=lambda: np.zeros((0, 0), np.float32))

    @property
    def limit(self) -> float:
        """Share from which an edge stays."""
        return self.by_chance + STAYING_PART * (1.0 - self.by_chance)

    @property
    def stays(self) -> Bits:
        """Ridges (h, w) that stay, one or two pixels wide."""
        return np.asarray((self.share > self.limit) & self.ridge)

    @property
    def most_changing(self) -> float:
        """Part of the tenth of the image that changes most where edges come and go."""
        part = cv2.blur(self.changing.astype(np.float32), (CELL_PX, CELL_PX))
        return float(np.quantile(part, 0.9))

    @property
    def strength(self) -> Plane:
        """The share (h, w) on ridges and a pixel beside them, else 0."""
        on = np.where(self.ridge, self.share, 0.0).astype(np.float32)
        return np.asarray(cv2.dilate(on, np.ones((3, 3), np.uint8)))


def edges_that_stay(images: Sequence[Plane]) -> Edges:
    """Of ``images`` (h, w), grey levels of 0 to 255, at one jaw opening."""
    usual, high = _quantiles(images)
    # The quietest fiftieth is a plain part of a fingertip or a wall; a third of a Rayleigh's values are below 0.93 s.
    quiet = float(np.quantile(cv2.blur(usual, (9, 9))[::3, ::3], 0.02))
    noise = max(quiet / 0.93, LEAST_SLOPE / 8.0)
    full = max(NOISE_SLOPES * noise, LEAST_SLOPE)
    share, across_rad = _share(images, full)
    chance, _ = _share(_displaced(images), full)
    changing = (high > max(CHANGING_SLOPES * noise, LEAST_SLOPE)) & (high > CHANGING_FACTOR * usual)
    edges = Edges(share, across_rad, _ridge(usual, across_rad), changing, float(chance.mean()), usual)
    # A pixel beside an edge that surely stays its own blur and play change.
    surely = (share >= max(edges.limit, SURELY_STAYS)).astype(np.uint8)
    return replace(edges, changing=changing & (cv2.dilate(surely, np.ones((3, 3), np.uint8)) == 0))


def gradient(image: Plane) -> tuple[Plane, Plane]:
    """Slopes (h, w) along x and y of a slightly smoothed image, grey levels a pixel."""
    soft = cv2.GaussianBlur(image, (0, 0), _SMOOTH_PX)
    return tuple(cv2.Scharr(soft, cv2.CV_32F, *way, scale=1.0 / 32.0) for way in ((1, 0), (0, 1)))  # type: ignore[return-value]


def doubled(image: Plane, full: float) -> tuple[Plane, Plane]:
    """The weighted gradient directions (h, w) of an image, angles doubled: cosine and sine, at most 1 long."""
    x, y = gradient(image)
    square = x * x + y * y
    scale = np.minimum(np.sqrt(square) / full, 1.0) / np.maximum(square, 1e-9)
    return np.asarray((x * x - y * y) * scale, np.float32), np.asarray(2.0 * x * y * scale, np.float32)


def _displaced(images: Sequence[Plane]) -> Iterator[Plane]:
    """The images, each rolled by another amount, so that nothing stays."""
    rng = np.random.default_rng(0)
    height, width = images[0].shape
    for image in images:
        yield np.roll(image, (int(rng.integers(height)), int(rng.integers(width))), (0, 1))


def _share(images: Sequence[Plane] | Iterator[Plane], full: float) -> tuple[Plane, Plane]:
    total: list[Plane] = []
    count = 0
    for image in images:
        parts = doubled(image, full)
        total = [a + b for a, b in zip(total, parts, strict=True)] if total else list(parts)
        count += 1
    cosine, sine = (cv2.GaussianBlur(part / count, (0, 0), _SMOOTH_PX) for part in total)
    return np.asarray(np.hypot(cosine, sine), np.float32), np.asarray(0.5 * np.arctan2(sine, cosine), np.float32)


def _quantiles(images: Sequence[Plane]) -> tuple[Plane, Plane]:
    """Slopes (h, w) that all but a third, and that a fifth of the images exceed; by rows, to save memory."""
    count, (height, width) = len(images), images[0].shape
    low, high = int(0.35 * (count - 1)), round(0.8 * (count - 1))
    usual, upper = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    rows = max(32, int(_BAND_VALUES / (count * width)))
    margin = 6
    for top in range(0, height, rows):
        first, last = max(top - margin, 0), min(top + rows + margin, height)
        slopes = np.stack([np.hypot(*gradient(image[first:last])) for image in images])
        slopes = slopes[:, top - first : min(top + rows, height) - first]
        usual[top : top + rows], upper[top : top + rows] = of_ranks(slopes, (low, high))
    return usual, upper


def _ridge(slope: Plane, across_rad: Plane) -> Bits:
    """Where a slope is at least as large as a pixel to either side, across the edge."""
    soft = cv2.GaussianBlur(slope, (0, 0), 0.7)
    y, x = np.indices(soft.shape, np.float32)
    dx, dy = np.cos(across_rad), np.sin(across_rad)
    sides = [
        cv2.remap(soft, x + s * dx, y + s * dy, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for s in (-1, 1)
    ]
    return np.asarray((soft >= sides[0]) & (soft >= sides[1]))


def enclosed(edges: Edges) -> Bits | None:
    """The pixels (h, w) that edges which stay separate from the background; None where nothing changes."""
    labels = _cells(edges.stays)
    count = int(labels.max()) + 1
    area = np.bincount(labels.ravel(), minlength=count)
    changing = np.bincount(labels.ravel(), edges.changing.ravel(), minlength=count) / np.maximum(area, 1)
    most = float(np.quantile(changing, 0.9))
    if most < LEAST_CHANGING:
        return None
    one, other, total, length_px = _boundaries(labels, edges)
    changes = changing > min(CHANGING_PART, 0.5 * most)
    joined = changes[one] & changes[other] & (total <= edges.limit * length_px)
    parts = coo_array((np.ones(np.count_nonzero(joined)), (one[joined], other[joined])), shape=(count, count))
    part = connected_components(parts, directed=False)[1]
    # What edges that stay cut off from a cell may as well be a shadow, unless it changes like most of the background.
    changes &= (np.bincount(part, area, minlength=count)[part] >= CELL_PX**2) | (changing > 0.5 * most)
    total += CHANGE_WORTH * length_px * np.abs(changing[one] - changing[other])
    start = np.where(changes, 0, np.arange(count))
    kept = np.asarray(_merged(one, other, total, length_px, start, edges.limit)[labels] != 0)
    return _closed(kept, edges)


def _closed(kept: Bits, edges: Edges) -> Bits:
    """The pixels (h, w) that are ``kept``, and those that edges which stay cut off from the background together with
    these: a tip or a pad about as grey as the walls, whose cells join these where its border is weakest.  Where nearly
    as much changes as elsewhere it is background between what is kept.
    """
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (CLOSED_GAP_PX, CLOSED_GAP_PX))
    around = cv2.morphologyEx((edges.share > edges.limit).astype(np.uint8), cv2.MORPH_CLOSE, disc) > 0
    free = ~(around | kept)
    count, label = cv2.connectedComponents(free.astype(np.uint8), connectivity=4)
    # Beside an edge its own blur and its play change.
    inner = np.where(cv2.erode(free.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0, label, 0)
    area = np.bincount(inner.ravel(), minlength=count)
    changing = np.bincount(inner.ravel(), edges.changing.ravel(), minlength=count) / np.maximum(area, 1)
    outside = 1 + int(area[1:].argmax()) if count > 1 else 0
    filled = (area > 0) & (changing < CLOSED_CHANGING * changing[outside])
    filled[[0, outside]] = False
    if not filled.any():
        return kept
    added = filled[label]
    beside = cv2.dilate(added.astype(np.uint8), np.ones((2 * CLOSED_GAP_PX + 1,) * 2, np.uint8)) > 0
    return np.where(beside, _of_nearest(free | kept, kept | added), kept)


def _cells(stays: Bits) -> NDArray[np.int64]:
    """Labels (h, w) from 1 of squares, divided by edges; an edge's own pixels go to the nearest cell."""
    free = cv2.dilate(stays.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))) == 0
    height, width = stays.shape
    row, column = (np.arange(height) // CELL_PX) % 2, (np.arange(width) // CELL_PX) % 2
    labels, count = np.zeros((height, width), np.int64), 0
    for odd_row in (0, 1):
        for odd_column in (0, 1):  # squares of one kind don't touch: what is connected is part of one
            part = free & (row == odd_row)[:, None] & (column == odd_column)[None]
            found, own = cv2.connectedComponents(part.astype(np.uint8), connectivity=4)
            labels[part] = own[part] + count
            count += found - 1
    return _of_nearest(free, labels)


def _of_nearest(free: Bits, values: NDArray[_T]) -> NDArray[_T]:
    """The ``values`` (h, w) of ``free`` pixels, and elsewhere that of the nearest of these."""
    taken = (~free).astype(np.uint8)
    _, nearest = cv2.distanceTransformWithLabels(taken, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    table = np.zeros(int(nearest.max()) + 1, values.dtype)
    table[nearest[free]] = values[free]
    return np.asarray(table[nearest])


def _boundaries(labels: NDArray[np.int64], edges: Edges) -> tuple[NDArray[np.int64], NDArray[np.int64], Array, Array]:
    """Pairs of neighbouring cells (b,) and (b,), the sum of the edges' shares along their common boundary, and its
    length, px.
    """
    strength = edges.strength
    count = int(labels.max()) + 1
    keys, values = [], []
    for here, there in (
        ((slice(None), slice(None, -1)), (slice(None), slice(1, None))),
        ((slice(None, -1), slice(None)), (slice(1, None), slice(None))),
    ):
        apart = labels[here] != labels[there]
        a, b = labels[here][apart], labels[there][apart]
        keys.append(np.minimum(a, b) * count + np.maximum(a, b))
        values.append(np.maximum(strength[here], strength[there])[apart])
    key, index = np.unique(np.concatenate(keys), return_inverse=True)
    one, other = np.asarray(key // count, np.int64), np.asarray(key % count, np.int64)
    total, length_px = np.bincount(index, np.concatenate(values)), np.bincount(index)
    return one, other, np.asarray(total, float), np.asarray(length_px, float)


def _merged(
    one: NDArray[np.int64],
    other: NDArray[np.int64],
    total: Array,
    length_px: Array,
    start: NDArray[np.int64],
    limit: float,
) -> NDArray[np.int64]:
    """The region (c,) of each cell, 0 the background; ``start`` (c,): cells that begin as one."""
    around: list[dict[int, tuple[float, float]]] = [{} for _ in start]
    for a, b, value, length in zip(start[one].tolist(), start[other].tolist(), total, length_px, strict=True):
        if a != b:
            before = around[a].get(b, (0.0, 0.0))
            around[a][b] = around[b][a] = before[0] + float(value), before[1] + float(length)

    def entry(a: int, b: int) -> tuple[float, int, int, tuple[float, float]]:
        value, length = around[a][b]
        return value / length + SHORT_PENALTY * math.sqrt(CELL_PX / length), min(a, b), max(a, b), (value, length)

    heap = [entry(a, b) for a, own in enumerate(around) for b in own if a < b]
    heapq.heapify(heap)
    parent = np.arange(len(start))
    while heap:
        _, a, b, seen = heapq.heappop(heap)
        if around[a].get(b) != seen or seen[0] > limit * seen[1]:
            continue
        if a != 0 and len(around[b]) > len(around[a]):
            a, b = b, a
        parent[b] = a
        del around[a][b]
        for c, (value, length) in around[b].items():
            if c != a:
                del around[c][b]
                before = around[a].get(c, (0.0, 0.0))
                around[a][c] = around[c][a] = before[0] + value, before[1] + length
                heapq.heappush(heap, entry(a, c))
        around[b] = {}
    while (parent[parent] != parent).any():
        parent = parent[parent]
    return np.asarray(parent[start])
