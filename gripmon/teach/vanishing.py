"""The direction of parallel edges in space, by the point in which their images meet (Caprile and Torre 1990)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array

LONG_PX = 30.0
"""Least length of an edge that shows a direction: 0.1 px at each end is 0.3 degrees."""
PARALLEL_RAD = math.radians(0.6)
"""Largest angle by which a long edge may miss the vanishing point: twice what 30 px resolve."""
FEWEST_PARALLEL = 3
PARALLEL_LENGTH_SHARE = 0.5
"""Least part of the total length of candidate edges that must run along the fingers, as in the monitor's search for
their ends."""
ALONG_RAD = math.radians(50.0)
"""Largest angle between the image of an edge along a finger and the direction to its tip: perspective turns it."""


@dataclass(frozen=True)
class Outline:
    """A finger's outline: ``xy`` (v, 2) of its vertices in ideal coordinates, ``corner`` (v,), ``pieces`` as pairs of
    vertices, ``outwards`` (2,), the direction to its tip in the image, ``length_px`` (p,) of the pieces; ends
    ``inner_xy`` (i, 2, 2) and lengths ``inner_px`` (i,) of its inner edges.
    """

    name: str
    xy: Array
    corner: NDArray[np.bool_]
    pieces: tuple[tuple[int, int], ...]
    outwards: Array
    length_px: Array
    inner_xy: Array
    inner_px: Array


def finger_direction(fingers: Sequence[Outline]) -> tuple[Array | None, float]:
    """Unit vector (3,) out of the gripper and its standard deviation (rad); None where no three long edges agree."""
    lines, middles, ways, lengths = [], [], [], []
    for finger in fingers:
        ends = np.concatenate([finger.xy[np.reshape(finger.pieces, (-1, 2))], finger.inner_xy])
        for (a, b), length in zip(ends, np.append(finger.length_px, finger.inner_px), strict=True):
            way = (b - a) / np.linalg.norm(b - a)
            if length >= LONG_PX and abs(float(way @ finger.outwards)) > math.cos(ALONG_RAD):
                middles.append(0.5 * (a + b))
                ways.append(way)
                lengths.append(length)
                lines.append(np.cross(sight_of(a), sight_of(b)))
    if len(lines) < FEWEST_PARALLEL:
        return None, 0.0
    line = np.array([n / np.linalg.norm(n[:2]) for n in lines])
    middle, way, worth = np.array(middles), np.array(ways), np.array(lengths)
    best: tuple[float, NDArray[np.bool_]] | None = None
    for i in range(len(line)):
        for j in range(i):
            meet = np.cross(line[i], line[j])
            if not np.linalg.norm(meet) > 1e-6:
                continue
            on = missed_rad(meet, middle, way) < PARALLEL_RAD
            score = float(worth[on].sum())
            enough = np.count_nonzero(on) >= FEWEST_PARALLEL and score > PARALLEL_LENGTH_SHARE * float(worth.sum())
            if enough and (best is None or score > best[0]):
                best = score, on
    if best is None:
        return None, 0.0
    on = best[1]
    weighted = line[on] * worth[on, None]
    meet = np.linalg.svd(weighted)[2][2]
    sigma = _direction_sigma(meet, middle[on], line[on])
    outwards = np.sum([finger.outwards for finger in fingers], axis=0)
    centre = tip_centre(fingers)
    moved = _image_way(meet, centre)
    sign = 1.0 if float(moved @ outwards) > 0.0 else -1.0
    return sign * meet / np.linalg.norm(meet), sigma


def _direction_sigma(meet: Array, middle: Array, line: Array) -> float:
    """Standard deviation (rad) of a direction in which n lines (n, 3) through ``middle`` (n, 2) meet, each known to
    half of :data:`PARALLEL_RAD`; large where they are nearly one line.
    """
    at = meet[:2] / (meet[2] if abs(meet[2]) > 1e-9 else 1e-9)
    off = 0.5 * PARALLEL_RAD * np.linalg.norm(at - middle, axis=1)
    information = (line[:, :2] / off[:, None]).T @ (line[:, :2] / off[:, None])
    return float(np.sqrt(1.0 / max(float(np.linalg.eigvalsh(information)[0]), 1e-12)) / math.hypot(1.0, *at))


def _image_way(direction: Array, xy: Array) -> Array:
    """Direction (2,) in the image of a point's motion along a direction in space."""
    return np.asarray(direction[:2] - direction[2] * xy)


def missed_rad(meet: Array, middle: Array, way: Array) -> Array:
    """Angles (n,) by which lines miss a point of the image plane."""
    to = meet[:2] - meet[2] * middle
    to = to / np.maximum(np.linalg.norm(to, axis=1), 1e-12)[:, None]
    return np.asarray(np.arcsin(np.minimum(np.abs(to[:, 0] * way[:, 1] - to[:, 1] * way[:, 0]), 1.0)))


def sight_of(xy: Array) -> Array:
    """The line of sight (3,) of a place in the image."""
    return np.array([xy[0], xy[1], 1.0])


def tip_centre(fingers: Sequence[Outline]) -> Array:
    """Centre (2,) of the foremost vertices of all fingers, ideal coordinates."""
    return np.asarray(np.mean([f.xy[int((f.xy @ f.outwards).argmax())] for f in fingers], axis=0))
