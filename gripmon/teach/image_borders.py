"""Along which borders of the fingers the images show their outline, in words of the picture, and what would help."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array
from gripmon.teach.silhouette import FEWEST_CLEAR, Stations, Transitions
from gripmon.teach.straight_pieces import Chain

SHORTEST_BORDER_PX = 20
"""Shortest border that is spoken of: half of the shortest outline."""
WELL_SEEN = 0.8
"""Part of a border that shows, below which more images are proposed: corners take the rest."""
_NEAR_PX = 4.0
_DARK = 128.0


@dataclass(frozen=True)
class Border:
    """A border of a finger, ``name``, in view along ``length_px``; ``share`` of it is measured, what isn't lies at
    ``unseen_px`` (k, 2).  There, usually ``clear`` of ``images`` show it, before always the ``same`` background or not;
    ``brighter``: what should be behind it.
    """

    name: str
    length_px: int
    share: float
    unseen_px: Array
    clear: int
    images: int
    same: bool
    brighter: bool

    def words(self) -> str:
        """What is seen and what would help."""
        shown = f"along {self.name} {100.0 * self.share:.0f} % of the outline shows"
        kind = "bright" if self.brighter else "dark"
        if self.clear < FEWEST_CLEAR:
            return (
                f"{shown}: usually {self.clear} of {self.images} images have a background there that differs from it, "
                f"at least {FEWEST_CLEAR}; add images with something {kind} behind it"
            )
        if self.same:
            empty = ", and with nothing between the jaws" if self.name.endswith("inner border") else ""
            always = "the background is the same there in all images"
            return f"{shown}: {always}; add images with brighter and darker ones{empty}"
        return (
            f"{shown}: images contradict each other there, or a face of the background's grey lies beyond; add images "
            f"with something {kind} and plain behind it"
        )


def borders_of(
    names: Sequence[str],
    outwards: Sequence[Array],
    centres_px: Sequence[Array],
    seen: Sequence[tuple[int, Stations, Transitions]],
    chains: Sequence[Sequence[Chain]],
    shape: tuple[int, ...],
) -> list[Border]:
    """The borders of fingers, worst first.  ``seen``: what shows along a contour of the finger of this number."""
    out = []
    for k, name in enumerate(names):
        own = [(stations, found) for number, stations, found in seen if number == k]
        if not own:
            continue
        inside = np.concatenate([stations.inside for stations, _ in own])
        uv_px, normal = (np.vstack([getattr(s, what) for s, _ in own])[inside] for what in ("uv_px", "normal"))
        clear, different, level = (
            np.concatenate([getattr(t, what) for _, t in own])[inside] for what in ("clear", "different", "level")
        )
        missed = _away_px(uv_px, chains[k], shape) > _NEAR_PX
        towards = centres_px[1 - k] - centres_px[k] if len(centres_px) == 2 else None
        for border, part in _parted(normal, outwards[k], towards).items():
            if np.count_nonzero(part) < SHORTEST_BORDER_PX:
                continue
            at = part & missed if (part & missed).any() else part
            usual = int(np.median(clear[at]))
            out.append(Border(
                f"the {name}'s {border}", int(np.count_nonzero(part)), float(1.0 - missed[part].mean()),
                uv_px[part & missed], usual, len(own[0][1].worth), bool(np.median(different[at]) < 2.0),
                bool(np.median(level[at]) < _DARK),
            ))  # fmt: skip
    return sorted(out, key=lambda border: border.share)


def _parted(normal: Array, outwards: Array, towards: Array | None) -> dict[str, NDArray[np.bool_]]:
    """Which points (n,) with these normals (n, 2) are of which border."""
    tip = normal @ outwards > np.cos(np.radians(40.0))
    side = np.array([-outwards[1], outwards[0]])
    if towards is not None:
        inner = normal @ (side * (np.sign(float(side @ towards)) or 1.0)) > 0.0
        return {"tip": tip, "inner border": ~tip & inner, "outer border": ~tip & ~inner}
    axis = int(np.abs(side).argmax())
    first = (normal @ side) * np.sign(side[axis]) < 0.0
    names = ("left border", "right border") if axis == 0 else ("upper border", "lower border")
    return {"tip": tip, names[0]: ~tip & first, names[1]: ~tip & ~first}


def _away_px(uv_px: Array, chains: Sequence[Chain], shape: tuple[int, ...]) -> Array:
    """How far (n,) points are from the pieces of chains, px."""
    free = np.full(shape[:2], 255, np.uint8)
    for chain in chains:
        for a, b in chain.pieces:
            ends = np.rint(chain.uv_px[[a, b]]).astype(int)
            cv2.line(free, ends[0].tolist(), ends[1].tolist(), 0, 1)
    away = cv2.distanceTransform(free, cv2.DIST_L2, 5)
    column, row = np.clip(np.rint(uv_px).astype(int), 0, np.array(shape[1::-1]) - 1).T
    return np.asarray(away[row, column], float)
