"""Fingers that are connected in the image, by a palm: separated by how they move with the jaw's opening."""

from __future__ import annotations

import math
from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.records import Array
from gripmon.teach.image_motion import ROUGH_STEP_PX, rough_shift_px
from gripmon.teach.image_outline import OpeningSeen, outwards_from, see_parts
from gripmon.teach.matte import FEWEST_STILL_SHARE

_STEP_PX = 4
"""Distance between cuts across a part: half the length of the shortest edge."""
LEAST_SIZE_SHARE = 0.85
"""Least size of the smallest part that a cut leaves, over the largest such size of any cut: with some tolerance the cut
runs across both fingers, not along their body."""
_TURN_RAD, _TURN_STEP_RAD = math.radians(30.0), math.radians(3.0)
"""Largest angle between the direction to a part's farthest point and the normal of the cut: 30 degrees for two fingers
as long as they are apart; a step of 3 degrees is 4 px on a finger 80 px wide."""


def apart_by_motion(camera: Camera, seen: OpeningSeen, around: Iterable[OpeningSeen]) -> OpeningSeen | None:
    """The images' result with the prongs of its parts as fingers, where these move against each other from one opening
    to another, and without the body that joins them; None where none do.
    """
    others = list(around)
    parts, ways, found = [], [], False
    for finger in seen.fingers:
        own, of_own = [finger.mask], [finger.outwards]
        cut = prongs(finger.mask, finger.outwards)
        if len(cut) > 1:
            body = (finger.mask & ~np.any(cut, axis=0)).astype(np.uint8)
            near = cv2.dilate(body, np.ones((3, 3), np.uint8)) > 0
            roots = [np.argwhere(prong & near)[:, ::-1].mean(axis=0) for prong in cut]
            to_tip = [outwards_from(prong, root) for prong, root in zip(cut, roots, strict=True)]
            if any(_against_each_other(cut, to_tip, other) for other in others):
                own, of_own, found = cut, to_tip, True
        parts += own
        ways += of_own
    return see_parts(camera, seen, parts, ways) if found else None


def _against_each_other(own: list[NDArray[np.bool_]], ways: list[Array], other: OpeningSeen) -> bool:
    shifts = [rough_shift_px(prong, way, other) for prong, way in zip(own, ways, strict=True)]
    apart = np.ptp(np.array(shifts), axis=0)
    return bool(np.linalg.norm(apart) > 2.0 * ROUGH_STEP_PX)


def prongs(mask: NDArray[np.bool_], outwards: Array) -> list[NDArray[np.bool_]]:
    """Parts into which a mask is divided by a straight cut about square to ``outwards`` (2,): the shortest of all cuts
    that leave the smallest part about as large as possible; the mask alone where no cut divides it.
    """
    small = mask[::_STEP_PX, ::_STEP_PX]
    at = np.indices(small.shape)[::-1].transpose(1, 2, 0)
    cuts: list[tuple[int, int, Array, float]] = []
    for turn in np.arange(-_TURN_RAD, _TURN_RAD + 0.5 * _TURN_STEP_RAD, _TURN_STEP_RAD).tolist():
        way = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]) @ outwards
        ahead = at @ way
        for level in np.arange(float(ahead[small].max()), float(ahead[small].min()), -1.0).tolist():
            parts = _large(small & (ahead > level))
            if len(parts) > 1:
                along = np.any(parts, axis=0) & (ahead <= level + 1.0)
                cuts.append((int(parts[-1].sum()), int(along.sum()), way, level))
    if not cuts:
        return [mask]
    enough = LEAST_SIZE_SHARE * max(smallest for smallest, *_ in cuts)
    _, _, way, level = min((cut for cut in cuts if cut[0] >= enough), key=lambda cut: cut[1])
    ahead = np.indices(mask.shape)[::-1].transpose(1, 2, 0) @ way
    found = _large(mask & (ahead > _STEP_PX * (level + 1.0)))
    return found if len(found) > 1 else [mask]


def _large(mask: NDArray[np.bool_]) -> list[NDArray[np.bool_]]:
    """Its parts that are large enough for a finger, the largest first."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    area = stats[1:, cv2.CC_STAT_AREA]
    order = [k for k in np.argsort(-area).tolist() if area[k] > FEWEST_STILL_SHARE * mask.size]
    return [labels == k + 1 for k in order]
