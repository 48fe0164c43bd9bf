"""Which pieces of an outline the images of other openings contradict: those that aren't where their finger's motion
puts them, as the bars of a linkage, which turn while the finger slides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from gripmon.model.camera import Camera
from gripmon.model.records import Array
from gripmon.teach.finger_depth import PlacedOutlines, place
from gripmon.teach.image_model import finger_outlines
from gripmon.teach.image_motion import WORST_OUTLINE_PX, FingerMoved
from gripmon.teach.image_outline import OpeningSeen
from gripmon.teach.jaw_fit import AGREEING
from gripmon.teach.motion_depth import Moved, move
from gripmon.teach.piece_lines import WORST_SIGMA_PX, jackknife_sigma
from gripmon.teach.silhouette import WIDE_PX, WIDE_SEARCH_PX, Stations, measure_transitions, stations_ahead
from gripmon.teach.vanishing import Outline

FEWEST_STATIONS = 4
"""Pixels of a piece that speak for or against it: as many as a line takes."""

Pieces = frozenset[tuple[int, int]]


def place_and_move(
    camera: Camera,
    seen: OpeningSeen,
    around: Mapping[float, OpeningSeen],
    *,
    pose: tuple[Array, Array] | None = None,
    travel: Mapping[float, tuple[float, float]] | None = None,
    notes: list[str],
) -> tuple[list[Outline], PlacedOutlines, Moved]:
    """The fingers of the ``seen`` opening in space, by perspective and by their motion to those ``around``, without
    what the images of those contradict; other arguments as of :func:`~gripmon.teach.motion_depth.move`.  Raises
    :class:`~gripmon.model.errors.NoResultError`.
    """
    outlines = finger_outlines(camera, seen)
    first = place(outlines, *(pose or (None, None)))
    placed, moved = move(camera, outlines, seen, around, first, pose=pose, travel=travel, notes=notes)
    found = contradicted(camera, placed, moved.by_opening, around, seen.blur_px)
    agreeing = _share_left(outlines, placed, [wrong for wrong, _ in found])
    if agreeing < AGREEING:
        why = f"only {100.0 * agreeing:.0f} % of the outlines are seen where the fingers' motion puts them"
        return outlines, first, Moved({}, None, why)
    unused = [wrong | _hanging_on(wrong, shown, kept) for (wrong, shown), kept in zip(found, placed.kept, strict=True)]
    if any(unused):
        notes.append(
            f"{sum(map(len, unused))} outer edges aren't used: images of another opening don't show them where the "
            "fingers' motion puts them, as the bars of a linkage, which turn"
        )
        # They hardly counted when the motion was found.
        outlines = [_without(own, pieces) for own, pieces in zip(outlines, unused, strict=True)]
        kept = zip(placed.kept, unused, strict=True)
        placed = replace(placed, kept=tuple(tuple(k for k in own if k not in pieces) for own, pieces in kept))
    return outlines, placed, moved


def contradicted(
    camera: Camera,
    placed: PlacedOutlines,
    moved: Mapping[float, Sequence[FingerMoved]],
    around: Mapping[float, OpeningSeen],
    blur_px: float,
) -> list[tuple[Pieces, Pieces]]:
    """Of each finger the pieces whose edge, in the images of an opening, lies :data:`WORST_OUTLINE_PX` or more (in the
    median over its pixels) beside where the finger's motion puts it, or where only background shows there; and those
    that are seen where it puts them.  What another part of the gripper hides, what leaves the image, and what the
    backgrounds don't show are neither; nor are outlines that are assumed flat, whose stated tilt moves them by more.
    """
    out = []
    for finger, (points, kept) in enumerate(zip(placed.points, placed.kept, strict=True)):
        wrong, shown = set[tuple[int, int]](), set[tuple[int, int]]()
        for opening, motion in ({} if placed.flat else moved).items():
            for piece in kept:
                off_px = _beside_px(camera, points[list(piece)] + motion[finger].shift, around[opening], blur_px)
                if off_px is not None:
                    (wrong if off_px >= WORST_OUTLINE_PX else shown).add(piece)
        out.append((frozenset(wrong), frozenset(shown - wrong)))
    return out


def _hanging_on(wrong: Pieces, shown: Pieces, kept: Sequence[tuple[int, int]]) -> Pieces:
    """The pieces that hang on wrong ones and, without these, on none that is ``shown`` elsewhere."""

    def grown(start: Pieces) -> set[tuple[int, int]]:
        out, more = set[tuple[int, int]](), set(start)
        while more:
            out |= more
            ends = {vertex for piece in more for vertex in piece}
            more = {piece for piece in kept if ends & {*piece}} - out - wrong
        return out

    return frozenset(grown(wrong) - wrong - grown(shown))


def _beside_px(camera: Camera, ends: Array, seen: OpeningSeen, blur_px: float) -> float | None:
    """How far an edge with ends (2, 3) lies beside the one that images show, in the median over its pixels; where only
    background shows, as far as the search goes.  None if too little is seen.
    """
    if not (np.isfinite(ends).all() and (ends[:, 2] > 0.0).all()):
        return None
    matte, shape = seen.matte, seen.matte.still.shape
    stations = _stations(camera, ends, shape)
    found = measure_transitions(matte.images, stations, matte.noise, wide=True, blur_px=blur_px)
    across = np.arange(-WIDE_SEARCH_PX, WIDE_SEARCH_PX + 0.5)[:, None, None]
    column, row = np.moveaxis(np.rint(stations.uv_px + across * stations.normal).astype(int), 2, 0)
    still = matte.still[np.clip(row, 0, shape[0] - 1), np.clip(column, 0, shape[1] - 1)]
    gone = stations.inside & ~found.usable & ~still.any(axis=0)
    known = (found.usable & (jackknife_sigma(found.folds_px) < WORST_SIGMA_PX)) | gone
    if np.count_nonzero(known) < FEWEST_STATIONS:
        return None
    return float(np.median(np.where(gone, WIDE_SEARCH_PX, np.abs(found.offset_px))[known]))


def _stations(camera: Camera, ends: Array, shape: tuple[int, ...]) -> Stations:
    """Stations a pixel apart on the image of an edge with ends (2, 3)."""
    xy = ends[:, :2] / ends[:, 2:]
    count = max(round(camera.fx_px * float(np.linalg.norm(xy[1] - xy[0]))), 1)
    share = (np.arange(count) + 0.5)[:, None] / count
    uv, ahead = (camera.distort(xy[0] + part * (xy[1] - xy[0])) for part in (share, share + 1e-3))
    return stations_ahead(uv, ahead, shape, WIDE_PX)


def _share_left(outlines: Sequence[Outline], placed: PlacedOutlines, wrong: Sequence[Pieces]) -> float:
    """Of the placed outlines' length in the image, without the wrong pieces."""
    total = left = 0.0
    for outline, kept, pieces in zip(outlines, placed.kept, wrong, strict=True):
        for piece, length in zip(outline.pieces, outline.length_px.tolist(), strict=True):
            total += length * (piece in kept)
            left += length * (piece in kept and piece not in pieces)
    return left / total if total else 1.0


def _without(outline: Outline, pieces: Pieces) -> Outline:
    left = [k for k, piece in enumerate(outline.pieces) if piece not in pieces]
    return replace(outline, pieces=tuple(outline.pieces[k] for k in left), length_px=outline.length_px[left])
