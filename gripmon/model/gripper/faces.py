"""Faces of a gripper: planar loops of points, or triangles where a loop isn't planar."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array

LARGEST_WARP_M = 5e-4
"""Deviation from its plane up to which a loop counts as planar, m: the accuracy of callipers."""

LARGEST_SKEW = 0.1
"""Deviation from its plane, over its extent, above which a loop is not a face: one of its points is wrong."""


@dataclass(frozen=True, slots=True)
class FaceLoop:
    finger: int
    points: NDArray[np.intp]


def normal_of(loop: Array) -> Array:
    """Outward normal (3,) of a loop of points (n, 3) by Newell's method, not normalised."""
    return np.cross(loop, np.roll(loop, -1, axis=0)).sum(axis=0)


def off_plane_m(loop: Array) -> float:
    """Largest distance of points (n, 3) of a loop from their mean plane."""
    normal = normal_of(loop)
    return float(np.abs((loop - loop.mean(axis=0)) @ normal).max() / np.linalg.norm(normal))


def extent_m(loop: Array) -> float:
    """Largest distance between two points of a loop (n, 3)."""
    return float(np.linalg.norm(loop[:, None] - loop, axis=2).max())


def inwards(fingers: Sequence[str], loops: Sequence[tuple[int, ...]], points_m: Array) -> int | None:
    """The first face whose normal points into its finger; None if there is none.

    Correct faces pass each shared edge in opposite directions, and all faces of a finger together bound a positive
    volume (openings are closed towards the finger's centre).  So fingers need neither be convex nor closed; a face
    without neighbours must face away from the centre.
    """
    of_finger: dict[str, set[int]] = {}
    for finger, loop in zip(fingers, loops, strict=True):
        of_finger.setdefault(finger, set()).update(loop)
    middle_m = {finger: points_m[sorted(own)].mean(axis=0) for finger, own in of_finger.items()}
    looks_out = []
    for finger, loop in zip(fingers, loops, strict=True):
        corners = points_m[list(loop)]
        looks_out.append(float(normal_of(corners) @ (corners.mean(axis=0) - middle_m[finger])))
    sides = [{(a, b) for a, b in zip(loop, (*loop[1:], loop[0]), strict=True)} for loop in loops]
    for k, finger in enumerate(fingers):
        if looks_out[k] >= 0.0:
            continue
        others = [n for n, name in enumerate(fingers) if name == finger and n != k]
        against = any(sides[k] & sides[n] for n in others)
        beside = any((b, a) in sides[n] for n in others for a, b in sides[k])
        total = sum(looks_out[n] for n in (k, *others))
        if against or not beside or total < 0.0:
            return k
    return None


def triangles(loop: Array) -> list[tuple[int, int, int]] | None:
    """Triangulate a non-planar loop (n, 3): indices into it, with its orientation; None if it crosses itself.

    Of the possible triangulations it takes the one that bulges outwards: fingers are convex solids.
    """
    normal = normal_of(loop) / np.linalg.norm(normal_of(loop))
    left, out = list(range(len(loop))), []
    while len(left) > 3:
        ears = [(_hidden_m(loop, left, k, normal), k) for k in range(len(left)) if _is_ear(loop, left, k, normal)]
        if not ears:
            return None
        k = min(ears)[1]
        out.append(_corner(left, k))
        del left[k]
    return [*out, (left[0], left[1], left[2])]


def _corner(left: list[int], k: int) -> tuple[int, int, int]:
    return left[k - 1], left[k], left[(k + 1) % len(left)]


def _is_ear(loop: Array, left: list[int], k: int, normal: Array) -> bool:
    """Whether a corner can be cut off, seen along the normal: it is convex, and no other point lies in its triangle."""
    a, b, c = (loop[i] for i in _corner(left, k))
    area = float(np.cross(b - a, c - a) @ normal)
    if area <= 1e-9 * extent_m(loop) ** 2:
        return False
    others = loop[[i for i in left if i not in _corner(left, k)]]
    sides = [np.cross(end - start, others - start) @ normal for start, end in ((a, b), (b, c), (c, a))]
    return not bool((np.min(sides, axis=0) > 0.0).any())


def _hidden_m(loop: Array, left: list[int], k: int, normal: Array) -> float:
    """How far the rest of the loop would protrude beyond the cut: less means more convex."""
    a, b, c = (loop[i] for i in _corner(left, k))
    outwards = np.cross(b - a, c - a)
    return float(((loop[left] - a) @ outwards).max() / np.linalg.norm(outwards))
