"""Faces of a gripper: loops of points in one plane, or triangles where they aren't."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array

LARGEST_WARP_M = 5e-4
"""A loop this far off its plane still counts as flat: as exactly as callipers measure."""

LARGEST_SKEW = 0.1
"""A loop farther off its plane, as a part of its extent, is not a face: one of its points is wrong."""


@dataclass(frozen=True, slots=True)
class FaceLoop:
    finger: int
    points: NDArray[np.intp]


def normal_of(loop: Array) -> Array:
    """Outward normal (3,) of a loop of points (n, 3) (Newell), not normalised."""
    return np.cross(loop, np.roll(loop, -1, axis=0)).sum(axis=0)


def off_plane_m(loop: Array) -> float:
    """How far points (n, 3) of a loop lie from their mean plane, at most."""
    normal = normal_of(loop)
    return float(np.abs((loop - loop.mean(axis=0)) @ normal).max() / np.linalg.norm(normal))


def extent_m(loop: Array) -> float:
    """Largest distance between two points of a loop (n, 3)."""
    return float(np.linalg.norm(loop[:, None] - loop, axis=2).max())


def inwards(fingers: Sequence[str], loops: Sequence[tuple[int, ...]], points_m: Array) -> int | None:
    """The first face that looks into its finger; None if there is none.

    A face runs through each edge in the way opposite to its neighbour's, and all faces of a finger together bound a
    positive volume (what is open is closed towards the finger's middle).  So fingers need not be convex, nor closed; a
    face without neighbours looks away from the middle.
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
    """A loop (n, 3) that isn't flat as triangles, indices into it, turned as it is; None if it crosses itself.

    Of the ways to cut it the one that bulges outwards: fingers are convex solids.
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
    """Whether a corner can be cut off, seen along the normal: it juts out, and no other point lies in it."""
    a, b, c = (loop[i] for i in _corner(left, k))
    area = float(np.cross(b - a, c - a) @ normal)
    if area <= 1e-9 * extent_m(loop) ** 2:
        return False
    others = loop[[i for i in left if i not in _corner(left, k)]]
    sides = [np.cross(end - start, others - start) @ normal for start, end in ((a, b), (b, c), (c, a))]
    return not bool((np.min(sides, axis=0) > 0.0).any())


def _hidden_m(loop: Array, left: list[int], k: int, normal: Array) -> float:
    """How far the rest of the loop would stand out over the cut: less is more convex."""
    a, b, c = (loop[i] for i in _corner(left, k))
    outwards = np.cross(b - a, c - a)
    return float(((loop[left] - a) @ outwards).max() / np.linalg.norm(outwards))
