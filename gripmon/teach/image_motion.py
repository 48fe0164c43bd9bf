"""How fingers move with the jaw's opening: what is known of it, where the search for it starts, and their tips."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array
from gripmon.teach.image_outline import OpeningSeen
from gripmon.teach.vanishing import ALONG_RAD, Outline

SAME_OPENING_M = 5e-5
"""Openings closer than this count as one: about 0.2 px of each finger, 100 mm away."""
WORST_OUTLINE_PX = 1.0
"""Standard deviation of an outline from which it is of no use: search lines at work reach 3 px to either side."""
ROUGH_TIP_SHARE = 0.35
"""Part of a finger's length that is its tip, which is at one depth."""
ROUGH_STEP_PX = 2.0
"""Resolution of a roughly known shift, which is searched for in images of half the size."""
TIP_SHARE = 0.3
"""Part of a finger's length that is its tip."""
INWARDS = math.cos(math.radians(45.0))
"""Least cosine between a tip's edge's normal and the way to the other finger by which it faces that."""
_FAR_PX = 260
"""Search range for a finger, each way."""


@dataclass(frozen=True)
class FingerMoved:
    """``shift`` (3,) of a finger's tip over the depth of the TCP, camera axes; ``turn_rad`` about the axis square to
    fingers and travel.
    """

    shift: Array
    turn_rad: float = 0.0


@dataclass(frozen=True)
class JawMotion:
    """``q`` of each finger (v,): inverse depths of its vertices, and its ``kept`` pieces, whose depth is known,
    ``by_motion`` or by perspective; ``moved`` by opening: each finger's motion over the tips' depth; ``travel`` (o,) of
    the fingers against each other, over that depth, with its ``covariance`` (o, o); ``direction`` (3,) of the travel
    with its ``direction_covariance`` (3, 3), ``slope_sigma`` (2,) of the inverse depths over x and y;
    ``tcp_covariance`` (3, 3) of the tips' middle over that depth; ``turned``: why they turn while they move, if they
    do.
    """

    q: tuple[Array, ...]
    kept: tuple[tuple[tuple[int, int], ...], ...]
    by_motion: bool
    moved: Mapping[float, Sequence[FingerMoved]]
    travel: Array
    covariance: Array
    direction: Array
    direction_covariance: Array
    slope_sigma: Array
    tcp_covariance: Array
    turned: str

    def over(self, depth: float) -> JawMotion:
        """The same over another depth, given over this one."""
        moved = {
            opening: tuple(FingerMoved(m.shift / depth, m.turn_rad) for m in own) for opening, own in self.moved.items()
        }
        return replace(
            self,
            q=tuple(q * depth for q in self.q),
            moved=moved,
            travel=self.travel / depth,
            covariance=self.covariance / depth**2,
            tcp_covariance=self.tcp_covariance / depth**2,
        )


class Unfit(ValueError):
    """Why a motion can't be measured; ``opening``: at which one, None if that holds for all."""

    def __init__(self, why: str, opening: float | None = None):
        super().__init__(why)
        self.opening = opening


def rough_shift_px(
    mask: NDArray[np.bool_],
    outwards: Array,
    other: OpeningSeen,
    part: tuple[float, float] = (0.0, ROUGH_TIP_SHARE),
) -> Array:
    """Shift (2,), to :data:`ROUGH_STEP_PX`, of a ``part`` of the finger, given as a range of its length from the tip:
    closer parts move by more in the image.
    """
    ahead = np.indices(mask.shape)[::-1].transpose(1, 2, 0) @ outwards
    behind = (float(ahead[mask].max()) - ahead) / float(np.ptp(ahead[mask]))
    tip = (behind >= part[0]) & (behind <= part[1])
    mask = mask & tip
    outline = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
    known = (mask | (tip & (cv2.dilate(outline, np.ones((17, 17), np.uint8)) > 0))).astype(np.uint8)
    rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    top, bottom, left, right = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
    window = slice(top, bottom), slice(left, right)
    known = known[window]
    here = np.where(mask, 255, 0).astype(np.uint8)[window]
    padded = cv2.copyMakeBorder(
        np.any([finger.mask for finger in other.fingers], axis=0).astype(np.uint8) * 255,
        _FAR_PX,
        _FAR_PX,
        _FAR_PX,
        _FAR_PX,
        cv2.BORDER_REPLICATE,
    )
    around = padded[top : bottom + 2 * _FAR_PX, left : right + 2 * _FAR_PX]
    half = [cv2.resize(i, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for i in (around, here, known * 255)]
    score = cv2.matchTemplate(
        half[0].astype(np.float32), half[1].astype(np.float32), cv2.TM_SQDIFF, mask=(half[2] > 127).astype(np.float32)
    )
    _, _, best, _ = cv2.minMaxLoc(score)
    return np.array([ROUGH_STEP_PX * best[0] - _FAR_PX, ROUGH_STEP_PX * best[1] - _FAR_PX])


def contact(fingers: Sequence[Outline], way: Array) -> tuple[list[NDArray[np.intp]], bool]:
    """Indices of vertices of the two tips between which the TCP lies, ``way`` (2,) being the travel in the image: the
    corners of edges that face the other finger, as many on both; else, as on round tips, the innermost vertex of each,
    and False.
    """
    tips, corners = [], []
    for finger, sign in zip(fingers, (1.0, -1.0), strict=False):
        ahead, inwards = finger.xy @ finger.outwards, sign * (finger.xy @ way)
        tip = ahead > ahead.max() - TIP_SHARE * float(np.ptp(ahead))
        pieces = np.reshape(finger.pieces, (-1, 2))
        ends = finger.xy[pieces]
        run = ends[:, 1] - ends[:, 0]
        # Going along the outline the gripper is on the left in the image.
        normal = np.column_stack([-run[:, 1], run[:, 0]]) / np.linalg.norm(run, axis=1)[:, None]
        facing = pieces[(sign * (normal @ way) > INWARDS) & tip[pieces].all(axis=1)]
        corners.append([k for k in np.unique(facing).tolist() if finger.corner[k]])
        tips.append(np.array([int(np.where(tip, inwards, -np.inf).argmax())]))
    if len(corners[0]) == len(corners[-1]) > 0:
        return [np.array(own) for own in corners], True
    return tips, False


def along_finger(finger: Outline, points: Array) -> tuple[Array, float]:
    """Unit vector (3,) along a finger: the mean of its long sides, so that a taper is symmetric to it; and the sides'
    spread about it (rad).
    """
    ways, worth = [], []
    for (a, b), length in zip(finger.pieces, finger.length_px.tolist(), strict=True):
        way, shown = points[b] - points[a], finger.xy[b] - finger.xy[a]
        part = float(shown @ finger.outwards) / float(np.linalg.norm(shown))
        if abs(part) > math.cos(ALONG_RAD):
            ways.append(math.copysign(1.0, part) * way / np.linalg.norm(way))
            worth.append(length)
    if not ways:
        return np.zeros(3), 0.0
    mean = np.average(ways, axis=0, weights=worth)
    mean /= max(float(np.linalg.norm(mean)), 1e-12)
    spread = np.average(1.0 - np.clip(np.array(ways) @ mean, -1.0, 1.0) ** 2, weights=worth)
    return mean, math.sqrt(spread)
