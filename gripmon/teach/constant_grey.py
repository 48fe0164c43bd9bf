"""The fingers by their grey levels, which stay while those beside them change: what edges that stay leave open.

Edges alone leave out a face about as grey as what is usually behind it, and take in background on which little moves.
Pixels tell of these: on a finger, moved back and at one exposure, hardly any image shows another grey level.  By
themselves they don't tell a finger from a wall, or a face in a light of its own from the background; so they only
amend parts that edges have found, and what they give has to be measured along its outline like any other.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from gripmon.model.staying import Bits
from gripmon.teach.fingers import Box, Parts, inside_box
from gripmon.teach.matte import SMALLEST_PART, Matte
from gripmon.teach.silhouette import CLEAR_NOISES

ELSEWHERE_PART = 0.2
"""Part of the images that may show another grey level at a pixel of a finger: one of five may show something else in
front of it.
"""
_SMOOTHED = 5
"""Side of the median that a pixel is decided by, px."""


def stays_grey(matte: Matte) -> Bits:
    """Pixels (h, w) at which hardly any image differs clearly from what they usually show."""
    least = CLEAR_NOISES * max(matte.noise, 1.0)
    usual = matte.mean
    others = np.zeros(usual.shape, np.intp)
    for image in matte.images:
        others += np.abs(cv2.blur(image - usual, (3, 3))) > least
    stays = others <= ELSEWHERE_PART * len(matte.images)
    return np.asarray(cv2.medianBlur(stays.astype(np.uint8), _SMOOTHED) > 0)


def amended(matte: Matte, parts: Parts, within: Sequence[Box] = ()) -> Parts:
    """The fingers as what stays grey and lies on them, each region on the one that has more of it; ``within``: only
    there, if a person has said so.
    """
    stays = stays_grey(matte) & ~parts.rest
    if within:
        stays = np.logical_or.reduce([inside_box(stays, box) for box in within])
    count, label = cv2.connectedComponents(stays.astype(np.uint8), connectivity=4)
    own = [np.bincount(label[part], minlength=count) for part in parts.fingers]
    fingers = []
    for k, part in enumerate(parts.fingers):
        mine = own[k] >= SMALLEST_PART
        mine[0] = False
        for other in (*own[:k], *own[k + 1 :]):
            mine &= own[k] > other  # what lies on two belongs to where more of it does
        region = np.asarray(mine[label])
        fingers.append(_without_holes(region) if region.any() else part)
    return Parts(tuple(fingers), parts.outwards, parts.rest)


def _without_holes(region: Bits) -> Bits:
    """A region (h, w) with what it encloses, such as a face in a light of its own."""
    outer, _ = cv2.findContours(region.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    out = np.zeros(region.shape, np.uint8)
    cv2.drawContours(out, outer, -1, 1, cv2.FILLED)
    return np.asarray(out > 0)
