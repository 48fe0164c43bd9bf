"""A gripper in images before changing backgrounds: which pixels are its own, at common places and grey levels.

Which pixels, edges that stay tell (:mod:`~gripmon.model.staying`), not grey levels: those of a wall stay as well, and a
gripper's own change with light and exposure.  A real mount has play, so that images show the gripper displaced by a
pixel or so: each is moved back, first by the direction of edges, and then adjusted to the others' grey levels.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from gripmon.model.errors import NoResultError
from gripmon.model.pixels import GREY_BGR
from gripmon.model.ranks import median
from gripmon.model.records import Array, Image
from gripmon.model.staying import (
    LEAST_SLOPE,
    STAYING_PART,
    WIDEST_PX,
    Bits,
    Edges,
    Plane,
    doubled,
    edges_that_stay,
    enclosed,
)
from gripmon.track.edges.profiles import full_scale, quantum

FEWEST_IMAGES = 5
"""Fewest images of one opening: of five random directions the mean has a length of 0.4, of an edge that stays 0.9."""
MOST_PLAY_PX = 4.0
"""Largest displacement of the gripper in an image that is moved back: 1 mm of play, at 4 px/mm."""
SEARCH_PX = 8
"""Displacement, px, within which an image's edges are looked for; what is farther is another place."""
CLEARLY_BETTER = 1.1
"""Likeness at another displacement over that at none, from which it is one: edges are as alike a pixel beside."""
LEAST_LIKENESS = 0.5
"""Least share of the gripper's edges that an image must show, over the usual share: more is hidden, or elsewhere."""
BLOCK_PX = 8
"""Side of the blocks that JPEG and most video coders code apart."""
STRONG_BLOCKS = 1.7
"""Difference of grey levels across the blocks' borders over that elsewhere, from which images are compressed strongly:
1.0 without compression, 1.3 to 1.9 at JPEG's quality 75, 1.5 to 2.5 at 40, 1.7 to 3.3 at 20."""
SMALLEST_PART = 100
"""Smallest part of a gripper (px): a tip of 10 x 10 px."""
MOST_STILL_SHARE = 0.9
"""Largest part of the image that stays: a gripper that hides more of the view leaves too little background."""
MOST_ROUNDS = 20
"""In which images change between two sets: some five are enough."""
_STEP = 3
_MAD = 1.4826
_SMALL = 4


@dataclass(frozen=True)
class Matte:
    """``still`` (h, w), which pixels belong to what stays; ``edges``, how surely; ``noise``, the usual scatter of a
    pixel of these over the images, in grey levels of 0 to 255.

    ``images`` (n, h, w) float32 at common places and grey levels, ``moved_px`` (n, 2), by how much each was displaced;
    ``kept`` (n,) their indices among those given, ``left_out`` why others weren't used.
    """

    still: Bits
    edges: Edges
    noise: float
    images: Plane
    moved_px: Array
    kept: tuple[int, ...]
    left_out: dict[int, str]

    @functools.cached_property
    def mean(self) -> Plane:
        """(h, w), the median grey levels."""
        return median(self.images)


def grey_levels(image: Image) -> Plane:
    """An image as (h, w) float32 from 0 to 255; colour (blue first) is converted as in the measurement."""
    pixels = image.astype(np.float32) * np.float32(255.0 / full_scale(image))
    if pixels.ndim == 3:
        pixels = pixels @ GREY_BGR
    return np.ascontiguousarray(pixels)


def smallest_noise(image: Image) -> float:
    """Standard deviation of a pixel by rounding alone, in grey levels of 0 to 255."""
    return 255.0 * quantum(image) / full_scale(image) / 12.0**0.5


def blocks(images: Sequence[Plane]) -> float:
    """How much larger grey levels' differences (at most 8) are across the borders of coded blocks than elsewhere, in
    images (h, w); 1 in those that aren't compressed, or were scaled since.
    """
    each = np.zeros(BLOCK_PX)
    for image in images:
        for way in (image, image.T):
            steps = np.minimum(np.abs(np.diff(way, axis=1)), 8.0).mean(axis=0)
            steps = steps[: len(steps) // BLOCK_PX * BLOCK_PX]
            each += steps.reshape(-1, BLOCK_PX).mean(axis=0)
    return float(each[-1] / max(float(np.median(each)), 1e-6))


def find_matte(images: Sequence[Plane], least_noise: float, step: Callable[[], None] = lambda: None) -> Matte:
    """The matte of ``images`` (h, w) at one jaw opening.  Raises :class:`NoResultError` if too few are alike, nothing
    changes behind the gripper, or nothing stays.
    """
    given, kept = list(images), list(range(len(images)))
    moved = np.zeros((len(images), 2))
    left_out: dict[int, str] = {}
    shrink = max(1, -(-max(images[0].shape) // WIDEST_PX))
    small = [_smaller(image, shrink) for image in given]
    for _ in range(3):
        edges = edges_that_stay([shifted(image, -moved[k] / shrink) for image, k in zip(small, kept, strict=True)])
        step()
        more, likeness = _displacements(small, edges, moved[kept] / shrink)
        change = more * shrink - moved[kept]
        moved[kept] = more * shrink
        bad = _unlike(moved[kept], likeness)
        if bad:
            left_out.update({kept[i]: why for i, why in bad.items()})
            small = [image for i, image in enumerate(small) if i not in bad]
            kept = [k for i, k in enumerate(kept) if i not in bad]
            if len(kept) < max(FEWEST_IMAGES, (len(images) + 2) // 2):
                raise NoResultError(
                    f"{len(left_out)} of {len(images)} images contradict the others ({next(iter(bad.values()))}); one "
                    "camera, one gripper, jaws at rest, sharp images"
                )
        elif np.abs(change).max() < 0.25:
            break
    still = _static(edges, images[0].shape)
    stack = np.stack([shifted(given[k], -moved[k]) for k in kept])
    inside = _inside(still)
    _level(stack, inside)
    usual = median(stack)
    noise = _noise((image - usual for image in stack), inside, least_noise)
    step()
    sets = image_sets(list(stack))
    if len(sets) > 1:
        raise sets_refused([len(own) for own in sets])
    return Matte(still, edges, noise, stack, moved[kept], tuple(kept), left_out)


def shifted(image: Plane, by_px: Array) -> Plane:
    """An image (h, w) moved by (2,) pixels; what comes in repeats the border."""
    if not np.any(by_px):
        return image
    matrix = np.array([[1.0, 0.0, by_px[0]], [0.0, 1.0, by_px[1]]])
    size = (image.shape[1], image.shape[0])
    return np.asarray(
        cv2.warpAffine(image, matrix, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), np.float32
    )


def sets_refused(counts: Sequence[int]) -> NoResultError:
    """The refusal of sets of images (``counts`` images each) that don't show one gripper."""
    sizes = " and ".join(map(str, counts))
    return NoResultError(
        f"the images fall into {len(counts)} sets, of {sizes}, in which different edges stay; images of one gripper, a "
        "camera fixed to it, jaws at rest, each with another background"
    )


def _smaller(image: Plane, shrink: int) -> Plane:
    if shrink == 1:
        return image
    size = (image.shape[1] // shrink, image.shape[0] // shrink)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)


def _grown(mask: Bits, shape: tuple[int, ...]) -> Bits:
    """A mask at the images' size, without specks and small holes."""
    soft = cv2.resize(mask.astype(np.float32), (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
    out = cv2.medianBlur((soft > 0.5).astype(np.uint8), 5)
    for value in (1, 0):
        count, labels, stats, _ = cv2.connectedComponentsWithStats((out == value).astype(np.uint8), connectivity=4)
        for k in range(1, count):
            if stats[k, cv2.CC_STAT_AREA] < SMALLEST_PART:
                out[labels == k] = 1 - value
    return np.asarray(out > 0)


def _static(edges: Edges, shape: tuple[int, ...]) -> Bits:
    """The pixels of images of a ``shape`` that don't belong to the background.  Raises :class:`NoResultError`."""
    still = enclosed(edges)
    share = 1.0 if still is None else float(still.mean())
    if still is None or share > MOST_STILL_SHARE:
        raise NoResultError(
            f"{100.0 * share:.0f} % of the image stays the same; images with changing backgrounds: move the robot "
            "between them"
        )
    still = _grown(still, shape)
    if not still.any():
        raise NoResultError(
            "no edges that stay enclose anything; a camera that is fixed to the gripper, one gripper, jaws at rest, "
            "sharp images"
        )
    return still


def _displacements(images: Sequence[Plane], edges: Edges, at: Array) -> tuple[Array, Array]:
    """How far (n, 2) the gripper lies in each image from where its edges stay, px, searched around ``at`` (n, 2), and
    the share (n,) of these edges that the image then shows.
    """
    margin = SEARCH_PX + 1
    inner = slice(margin, -margin), slice(margin, -margin)
    stays = edges.stays[inner]
    count = np.count_nonzero(stays)
    if count < 2 * FEWEST_IMAGES:
        return np.array(at), np.ones(len(images))
    angle = 2.0 * edges.across_rad[inner]
    usual = [np.where(stays, part, 0.0).astype(np.float32) for part in (np.cos(angle), np.sin(angle))]
    reach = np.arange(-SEARCH_PX, SEARCH_PX + 1)
    out, share = np.zeros((len(images), 2)), np.zeros(len(images))
    for k, image in enumerate(images):
        doubles = doubled(shifted(image, -at[k]), LEAST_SLOPE)
        alike = [cv2.matchTemplate(part[1:-1, 1:-1], of, cv2.TM_CCORR) for part, of in zip(doubles, usual, strict=True)]
        scores = np.sum(alike, axis=0, dtype=float) / count
        y, x = np.unravel_index(int(scores.argmax()), scores.shape)
        share[k] = scores[y, x]
        if share[k] < CLEARLY_BETTER * scores[SEARCH_PX, SEARCH_PX]:
            out[k] = at[k]  # within the width of the edges, which the outline's measurement tells
            continue
        out[k] = at[k] + [reach[x] + _vertex(scores[y], int(x)), reach[y] + _vertex(scores[:, x], int(y))]
    return out - np.median(out, axis=0), share


def _vertex(values: Array, at: int) -> float:
    """Offset of the parabola's vertex from the largest of values (m,), which is ``at``."""
    if not 0 < at < len(values) - 1:
        return 0.0
    bend = 2.0 * values[at] - values[at - 1] - values[at + 1]
    return float(0.5 * (values[at + 1] - values[at - 1]) / max(bend, 1e-9))


def _unlike(moved_px: Array, likeness: Array) -> dict[int, str]:
    """Images that show the gripper elsewhere, or too little of it: why, by their index."""
    out = {}
    usual = float(np.median(likeness))
    middle = np.median(moved_px, axis=0)
    for k, (away, share) in enumerate(zip(np.linalg.norm(moved_px - middle, axis=1), likeness, strict=True)):
        if share < LEAST_LIKENESS * usual:
            out[k] = (
                f"shows {100.0 * max(share, 0.0) / usual:.0f} % of the edges that the others show, at least "
                f"{100.0 * LEAST_LIKENESS:.0f} %: the camera or the jaws moved, something hides it, or it is blurred"
            )
        elif away > MOST_PLAY_PX:
            out[k] = (
                f"shows the gripper {away:.1f} px from where the others do, at most {MOST_PLAY_PX:g} px: the camera "
                "or the jaws moved"
            )
    return out


def _inside(still: Bits) -> Bits:
    """What stays, without its borders, where the background shines in; all of it where nothing would be left."""
    inner = np.asarray(cv2.erode(still.astype(np.uint8), np.ones((9, 9), np.uint8), borderValue=1) > 0)
    return inner if np.count_nonzero(inner) >= SMALLEST_PART else still


def _level(stack: Plane, inside: Bits) -> None:
    """Adjust each image in place by a gain, so that the gripper's pixels agree with their median: exposure and lamps.
    By two faces, each in a light of its own, an offset would be tens of levels off where a dark pad is.
    """
    at = np.flatnonzero(inside)[:: max(1, np.count_nonzero(inside) // 20_000)]
    values = stack.reshape(len(stack), -1)[:, at].astype(float)
    middle = np.median(values, axis=0)
    usable = (middle > 1.0) & (middle < 250.0)
    if np.count_nonzero(usable) < 50:
        return
    for k in range(len(stack)):
        gain = _gain(values[k, usable], middle[usable])
        if 0.2 < gain < 5.0:
            stack[k] *= gain


def _gain(seen: Array, wanted: Array) -> float:
    """Robust gain that adjusts grey levels (p,) of an image to those of all images."""
    weight, gain = np.ones(len(seen)), 1.0
    for _ in range(6):
        gain = float(weight @ wanted) / max(float(weight @ seen), 1.0)
        off: Array = np.abs(gain * seen - wanted)
        weight = 1.0 / np.maximum(off / max(_MAD * float(np.median(off)), 0.1), 1.0)
    return gain


def _noise(off: Iterable[Plane], inside: Bits, least_noise: float) -> float:
    """Scatter of one pixel beside its neighbours, of images' deviations (h, w) from what is usual: light that changes
    over a finger is none.
    """
    values = [(image - cv2.blur(image, (5, 5)))[inside][::_STEP] for image in off]
    return max(_MAD * float(np.median(np.abs(np.concatenate(values)))), least_noise)


def image_sets(images: Sequence[Plane]) -> list[list[int]]:
    """Indices of images (h, w) in which the same edges stay, the largest set first; usually a set per jaw opening.  A
    set has at least :data:`FEWEST_IMAGES`; fewer images unlike all others stay with a set, whose matte rejects them.
    """
    features = np.stack([_directions(image) for image in images])
    found, left = list[list[int]](), [list(range(len(images)))]
    while left:
        own = left.pop()
        there = _halves(features[own])
        parts = [[k for k, first in zip(own, there, strict=True) if first is side] for side in (True, False)]
        if _differ(features, *parts):
            left += parts
        else:
            found.append(own)
    return sorted(found, key=lambda own: (-len(own), own[0]))


def _halves(features: Plane) -> list[bool]:
    """Which of images (n, 2, h, w) belong to the first of the two sets in which most stays; all where none is large
    enough.

    Each image goes to the set whose staying edges it shows more of (as in k-means, without its own share in them),
    until none changes: begun with the first half, with every other image, and with the signs of the four leading
    eigenvectors of the images' likeness, in which objects behind the gripper count as much.
    """
    count = len(features)
    flat = features.reshape(count, -1)
    length = np.maximum(np.linalg.norm(flat, axis=1), 1e-9)
    likeness = flat @ flat.T / np.outer(length, length)
    np.fill_diagonal(likeness, 0.0)
    vectors = np.linalg.eigh(likeness)[1][:, :-5:-1].T
    order, best, most = np.arange(count), np.ones(count, bool), 0.0
    for start in (order < count // 2, order % 2 == 0, *(vector > np.median(vector) for vector in vectors)):
        there = _settled(features, start)
        sets = [own for own in (there, ~there) if np.count_nonzero(own) >= FEWEST_IMAGES]
        stays = sum(
            own.sum() * float(_beyond_chance(*_resultant(features[own]), 1.0 / own.sum()).sum()) for own in sets
        )
        if len(sets) == 2 and stays > most:
            best, most = there, stays
    return best.tolist()


def _settled(features: Plane, there: Bits) -> Bits:
    """Which images (n, 2, h, w) are in the first of two sets when none would rather change, begun with ``there``."""
    squares = np.square(features).sum(axis=1)
    for _ in range(MOST_ROUNDS):
        shown = np.empty((2, len(features)))
        for side, own in enumerate((~there, there)):
            size = np.count_nonzero(own)
            if size < 2:
                return there
            mean = features[own].mean(axis=0)
            square = np.square(mean).sum(axis=0)
            stays = _beyond_chance(square, squares[own].mean(axis=0), 1.0 / size)
            share = np.sqrt(stays / np.maximum(square, 1e-12))
            shown[side] = np.tensordot(features, share * mean, 3)
            # Without what an image itself adds to its set's mean.
            itself = np.tensordot(squares, share, 2)
            shown[side] = np.where(own, (size * shown[side] - itself) / (size - 1), shown[side])
            shown[side] /= max(math.sqrt(float(stays.sum())), 1e-9)
        then = shown[1] > shown[0]
        if (then == there).all():
            break
        there = then
    return there


def _directions(image: Plane) -> Plane:
    """Directions of an image's edges (2, h / 4, w / 4), angles doubled."""
    return np.stack([
        cv2.resize(part, None, fx=1.0 / _SMALL, fy=1.0 / _SMALL, interpolation=cv2.INTER_AREA)
        for part in doubled(image, LEAST_SLOPE)
    ])  # fmt: skip


def _differ(features: Plane, one: list[int], other: list[int]) -> bool:
    """Whether more stays in each of two sets of images than in both together.  Images of a video follow each other
    before much the same background, which stays in a set as well: what does by chance is measured, where nothing stays
    in both.
    """
    if min(len(one), len(other)) < FEWEST_IMAGES:
        return False
    sets = one, other, one + other
    shown = [_resultant(features[own]) for own in sets]
    mean, each = shown[-1]
    changing = mean < STAYING_PART**2 * each
    energies = []
    for (mean, each), own in zip(shown, sets, strict=True):
        at = changing & (each > 0.0)
        usual = float(np.median(mean[at] / each[at])) if at.any() else 0.0
        # Random directions' squared mean is exponentially distributed, so that its median is ln 2 of its mean.
        chance = max(usual / math.log(2.0), 1.0 / len(own))
        energies.append(float(_beyond_chance(mean, each, chance).sum()))
    return min(energies[:2]) > energies[2]


def _beyond_chance(mean: Plane, each: Plane, chance: float) -> Plane:
    """What squares of mean directions (h, w) have beyond three times what chance makes of the squares of ``each``."""
    return np.maximum(mean - 3.0 * chance * each, 0.0)


def _resultant(features: Plane) -> tuple[Plane, Plane]:
    """Square of the mean direction (h, w) over images (n, 2, h, w), and the mean square of each one's."""
    return np.square(features.mean(axis=0)).sum(axis=0), np.square(features).sum(axis=1).mean(axis=0)
