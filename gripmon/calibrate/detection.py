"""Detection of calibration targets, whole or partly hidden by fingers that stand on them; to hundredths of a pixel."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gripmon.calibrate import chequers
from gripmon.calibrate.chequers import bends
from gripmon.calibrate.discs import find_discs, refined
from gripmon.calibrate.grey_levels import Grey, edge_blur_px, noise_of, sharpest_blur_px, to_bytes, to_grey
from gripmon.calibrate.lattice import Index, fits
from gripmon.calibrate.markers import marked_corners
from gripmon.calibrate.sighting import NotFound, Sighting
from gripmon.calibrate.staggered import lattice_of, places_of
from gripmon.model.records import Array, Image
from gripmon.model.targets import (
    FEWEST,
    Charuco,
    Chequerboard,
    CircleGrid,
    StaggeredCircles,
    Target,
    name_of,
    turns_alike,
)

CORNER_RADIUS = 0.42
"""Radius of the window around a corner, in squares."""
TOO_BLURRED = 0.16
"""Standard deviation of the edges' blur above which an image isn't measured: in squares; for discs twice the number, in
units of the smaller of gap and radius.
"""
_MOST_OF = 0.7
"""Part of a staggered target that no rectangle of a lattice is."""
BLURRED_PX = 3.0
"""Standard deviation of the edges' blur above which it is reported."""


def detect(image: Image, target: Target, name: str = "") -> Sighting | NotFound:
    """Points of the target in an image (of any type that a camera delivers), or why there are none.

    On a part of a chequerboard or of a lattice of discs any point may be the origin: nothing marks one.  A whole board
    with an odd and an even number of corners is numbered so that the square between its first corners along both axes
    is dark.  :class:`TargetError` for an
    impossible target (an unknown dictionary).
    """
    grey = to_grey(image)
    if isinstance(target, Charuco):
        return _charuco(grey, target, name)
    return _discs(grey, target, name) if isinstance(target, CircleGrid) else _chequerboard(grey, target, name)


def _charuco(grey: Grey, target: Charuco, name: str) -> Sighting | NotFound:
    shown = to_bytes(grey)
    board, corners, ids, marks = marked_corners(shown, target)
    if 2 * len(ids) < (target.columns - 1) * (target.rows - 1):
        turned = msgspec.structs.replace(target, columns=target.rows, rows=target.columns)
        if len(marked_corners(shown, turned)[2]) > max(len(ids), FEWEST["charuco"] - 1):
            sizes = f"{turned.columns} x {turned.rows} squares, not {turned.rows} x {turned.columns}"
            return NotFound(f"the board has {sizes}: columns and rows are swapped")
        # In a mirrored board some markers look like others of the dictionary.
        if len(marked_corners(np.ascontiguousarray(shown[:, ::-1]), target)[2]) > max(len(ids), FEWEST["charuco"] - 1):
            return NotFound("the board is mirrored; an image that isn't flipped")
        if len(ids) < FEWEST["charuco"]:
            board_is = f"a board of {target.columns} x {target.rows} squares"
            few = f"{marks} marks and {len(ids)} corners of {board_is}; at least {FEWEST['charuco']}"
            return NotFound(_blurred(grey) or few)
    plate = np.asarray(board.getChessboardCorners(), np.float64)
    # Markers are in the white squares, and must be outside the windows.
    margin = 0.5 * (1.0 - target.marker_m / target.square_m)
    steps = _steps(plate[ids, :2] / target.square_m, corners)
    window = np.minimum(CORNER_RADIUS, 1.3 * margin) * steps - (1.0 if 1.3 * margin < CORNER_RADIUS else 0.0)
    uv_px, covariance, good = _sharp(grey, corners, window, plate[ids, :2] / target.square_m)
    note = _note(int(good.sum()), len(plate))
    return _sighting(grey, uv_px, plate[ids], covariance, good, 0.0, name, note, FEWEST["charuco"], 1)


def _chequerboard(grey: Grey, target: Chequerboard, name: str) -> Sighting | NotFound:
    found = chequers.find_corners(grey, target.columns, target.rows)
    if not found:
        return NotFound(_blurred(grey) or "no chequerboard in the image; one that is evenly lit and not too small")
    cells, rough = _arrays(found)
    fewer = len(cells) < target.columns * target.rows and ends_all_round(grey, cells, rough, squares=True)
    if fewer or not fits(found, target.columns, target.rows, least=2):
        return _wrong_count(cells, target.columns, target.rows, "inner corners", fewer)
    steps = _steps(cells, rough)
    starts, ends = _across_squares(cells, rough)
    blur_px = edge_blur_px(grey, starts, ends)
    if blur_px > TOO_BLURRED * float(np.median(steps)):
        return NotFound(_too_coarse(blur_px, steps))
    cells = _turned(cells, target.columns, target.rows)
    turns = turns_alike(target) if _whole(cells, target.columns, target.rows) else 0
    if turns == 1 and (upright := by_colours(grey, cells, rough)) is not None:
        cells = upright
    elif turns == 1:
        turns = 2
    uv_px, covariance, good = _sharp(grey, rough, CORNER_RADIUS * steps, cells)
    plate = np.concatenate([cells * target.square_m, np.zeros((len(cells), 1))], axis=1)
    note = _note(int(good.sum()), target.columns * target.rows, blur_px)
    fewest = FEWEST["chequerboard"]
    return _sighting(grey, uv_px, plate, covariance, good, 0.0, name, note, fewest, turns)


def _discs(grey: Grey, target: CircleGrid, name: str) -> Sighting | NotFound:
    (columns, rows), step_m = lattice_of(target)
    found = find_discs(grey, columns, rows, step_m / target.diameter_m, len(target.places))
    if not found:
        none = "no lattice of discs in the image; one that is evenly lit and not too small"
        return NotFound(_staggered(grey, target) or _blurred(grey) or none)
    cells, rough = _arrays({cell: tuple(disc.centre_px.tolist()) for cell, disc in found.items()})
    places = _places(grey, cells, rough, target)
    if isinstance(places, NotFound):
        return places
    where = {(int(c), int(r)): k for k, (c, r) in enumerate(cells.tolist())}
    pairs = [(k, where[c + 1, r]) for (c, r), k in where.items() if (c + 1, r) in where]
    starts = rough[[a for a, _ in pairs]]
    blur_px = edge_blur_px(grey, starts, 0.5 * (starts + rough[[b for _, b in pairs]]))
    share = target.diameter_m / step_m
    steps = _steps(cells, rough)
    if blur_px > 2.0 * TOO_BLURRED * min(1.0 - share, 0.5 * share) * float(np.median(steps)):
        return NotFound(_too_coarse(blur_px, steps))
    noise = noise_of(grey)
    first = {(c - min(x for x, _ in found), r - min(y for _, y in found)): d for (c, r), d in found.items()}
    centres = [refined(grey, first[int(c), int(r)], noise) for c, r in cells.tolist()]
    good = np.array([centre is not None for centre in centres])
    uv_px = np.array([(np.nan, np.nan) if centre is None else centre[0] for centre in centres])
    covariance = np.array([np.eye(2) if centre is None else centre[1] for centre in centres])
    plate = np.concatenate([places * target.step_m, np.zeros((len(cells), 1))], axis=1)
    turns = turns_alike(target) if _whole(places, *(last + 1 for last in target.last)) else 0
    radius_m, note = 0.5 * target.diameter_m, _note(int(good.sum()), len(target.places), blur_px)
    fewest = FEWEST["circles"]
    return _sighting(grey, uv_px, plate, covariance, good, radius_m, name, note, fewest, turns)


def _places(grey: Grey, cells: NDArray[np.intp], rough: Array, target: CircleGrid) -> NDArray[np.intp] | NotFound:
    """Steps (n, 2) along the target's axes of the discs at cells of its lattice, or why it isn't this target."""
    columns, rows = target.columns, target.rows
    if isinstance(target, StaggeredCircles):
        places = places_of(cells, target)
        what = f"{len(cells)} discs on a lattice, but not as staggered as {name_of(target)}"
        return NotFound(what) if places is None else places
    seen, incomplete = cells.max(axis=0) + 1, len(cells) < columns * rows
    if incomplete and (reason := _staggered(grey, target)):
        return NotFound(reason)
    fewer = incomplete and ends_all_round(grey, cells, rough, squares=False)
    if fewer or max(seen) > max(columns, rows) or min(seen) > min(columns, rows):
        return _wrong_count(cells, columns, rows, "discs", fewer)
    return _turned(cells, columns, rows)


def _staggered(grey: Grey, target: CircleGrid) -> str:
    """The reason if the discs are staggered, but the target's aren't; otherwise empty."""
    if isinstance(target, StaggeredCircles):
        return ""
    staggered = StaggeredCircles(target.columns, target.rows, target.spacing_m, target.diameter_m)
    (columns, rows), step_m = lattice_of(staggered)
    found = find_discs(grey, columns, rows, step_m / target.diameter_m, len(staggered.places))
    if not found or len(found) <= _MOST_OF * len(staggered.places):
        return ""
    places = places_of(np.array(list(found), np.intp), staggered)
    return "" if places is None else f"the discs are staggered (asymmetric circles); --target {name_of(staggered)}"


def _sighting(
    grey: Grey,
    uv_px: Array,
    plate_m: Array,
    covariance: Array,
    good: NDArray[np.bool_],
    radius_m: float,
    name: str,
    note: str,
    fewest: int,
    turns: int,
) -> Sighting | NotFound:
    if good.sum() < fewest:
        return NotFound(f"{int(good.sum())} points of the target are sharp and free; at least {fewest}")
    size = (grey.shape[1], grey.shape[0])
    return Sighting(uv_px[good], plate_m[good], covariance[good], size, radius_m, name, note, turns)


def _arrays(lattice: Mapping[Index, tuple[float, ...]]) -> tuple[NDArray[np.intp], Array]:
    """Cells (n, 2), from 0 on, row by row, and their positions in the image (n, 2)."""
    order = sorted(lattice, key=lambda cell: (cell[1], cell[0]))
    cells = np.array(order, np.intp)
    return cells - cells.min(axis=0), np.array([lattice[cell] for cell in order])


def _whole(cells: NDArray[np.intp], columns: int, rows: int) -> bool:
    return tuple((np.ptp(cells, axis=0) + 1).tolist()) == (columns, rows)


def _turned(cells: NDArray[np.intp], columns: int, rows: int) -> NDArray[np.intp]:
    """Rotate by 90 degrees if that makes the target's columns run along x, as far as the visible part shows."""
    seen_columns, seen_rows = cells.max(axis=0) + 1
    if seen_columns <= columns and seen_rows <= rows and (seen_columns, seen_rows) != (rows, columns):
        return cells
    out: NDArray[np.intp] = np.stack([cells[:, 1], cells[:, 0].max() - cells[:, 0]], axis=1)
    return out


def _wrong_count(cells: NDArray[np.intp], columns: int, rows: int, what: str, ends: bool) -> NotFound:
    short, long = sorted((cells.max(axis=0) + 1).tolist())
    larger = long > max(columns, rows) or short > min(columns, rows)
    # The longer side first, as in the target.
    seen = f"{long} x {short}" if columns >= rows else f"{short} x {long}"
    wrong = f"the target shows {seen} {what}; it should have {columns} x {rows}"
    return NotFound(wrong, larger, (long, short) if ends and not larger else None)


def _steps(cells: NDArray[np.intp] | Array, points: Array) -> Array:
    """(n,) distance in px of each point to its nearest neighbour, per step of the lattice."""
    where, index = cKDTree(points).query(points, 2)
    away = np.linalg.norm(cells[index[:, 1]] - cells, axis=1)
    out: Array = where[:, 1] / np.maximum(away, 1.0)
    return out


def _across_squares(cells: NDArray[np.intp], points: Array) -> tuple[Array, Array]:
    """Ends (n, 2) of lines across edges: between two neighbouring corners, from one square to the next."""
    where = {(int(c), int(r)): k for k, (c, r) in enumerate(cells.tolist())}
    lines = []
    for (c, r), k in where.items():
        right, below = where.get((c + 1, r)), where.get((c, r + 1))
        if right is not None and below is not None:
            middle, half = 0.5 * (points[k] + points[right]), 0.4 * (points[below] - points[k])
            lines.append((middle - half, middle + half))
    ends = np.array(lines).reshape(-1, 2, 2)
    return ends[:, 0], ends[:, 1]


def _sharp(
    grey: Grey, rough: Array, radius_px: Array, cells: Array | NDArray[np.intp]
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Sub-pixel corners (n, 2) at lattice coordinates ``cells`` (n, 2), covariances (n, 2, 2), and which are good."""
    noise = noise_of(grey)
    first, _, asymmetry = chequers.centres_of_symmetry(grey, rough, radius_px, noise)
    good = _corners(grey, first, asymmetry, radius_px)
    # The bend of the lattice is known once its corners are.
    bend = np.zeros((len(rough), 3, 2))
    size = (grey.shape[1], grey.shape[0])
    bend[good] = bends(np.asarray(cells[good], np.float64), first[good], size)
    starts = np.where(good[:, None], first, rough)
    uv_px, covariance, asymmetry = chequers.centres_of_symmetry(grey, starts, radius_px, noise, bend)
    return uv_px, covariance, _corners(grey, uv_px, asymmetry, radius_px)


def _corners(grey: Grey, uv_px: Array, asymmetry: Array, radius_px: Array) -> NDArray[np.bool_]:
    """(n,) which points are corners and not occluded."""
    radius = np.clip(radius_px, chequers.SMALLEST_RADIUS_PX, chequers.LARGEST_RADIUS_PX)
    size = np.array(grey.shape[::-1])
    edge = np.minimum(uv_px, size - 1 - uv_px).min(axis=1)
    crosses, _ = chequers.crossing(grey, np.nan_to_num(uv_px, nan=-1e3), 0.8 * radius)
    good: NDArray[np.bool_] = (asymmetry < chequers.ASYMMETRIC) & (edge > radius) & crosses
    return good


def _note(count: int, total: int, blur_px: float = 0.0) -> str:
    notes = [] if count == total else [f"{count} of {total} points"]
    if blur_px > BLURRED_PX:
        notes.append(f"blurred (edges {blur_px:.1f} px)")
    return ", ".join(notes)


def _blurred(grey: Grey) -> str:
    """The reason if an image without target isn't sharp anywhere; otherwise empty."""
    blur_px = sharpest_blur_px(grey)
    return _too_blurred(blur_px) if blur_px > BLURRED_PX else ""


def _too_coarse(blur_px: float, steps: Array) -> str:
    """The reason if a target's edges are too wide for it: blurred, or too small in a sharp image."""
    if blur_px > BLURRED_PX:
        return _too_blurred(blur_px)
    return (
        f"the target is too small for its edges: its points lie {float(np.median(steps)):.0f} px apart, and edges have "
        f"a standard deviation of {blur_px:.1f} px; nearer to it, or sharper"
    )


def _too_blurred(blur_px: float) -> str:
    return (
        f"blurred: its sharpest edges have a standard deviation of {blur_px:.1f} px; an image in focus, without motion"
    )


LEAST_CONTRAST = 0.2
"""Minimum contrast of dark and light squares, over the range of their grey levels: less may be light and shadow."""
SURROUNDINGS_TOLERANCE = 0.3
"""How far the surroundings may differ from the plate's own ground, over the contrast."""
_ALL = 0.9


def ends_all_round(grey: Grey, cells: NDArray[np.intp], at: Array, squares: bool) -> bool:
    """True if a lattice (cells (n, 2) from 0 on, at (n, 2) px) has no gaps and the plate beyond all four sides is
    visible and bare.  False proves nothing: a finger, the image's border, or something else may hide the rest.

    ``squares``: the points are corners of squares, otherwise centres of discs.
    """
    columns, rows = (cells.max(axis=0) + 1).tolist()
    if len(cells) < columns * rows or min(columns, rows) < 3:
        return False
    grid = np.empty((rows, columns, 2))
    grid[cells[:, 1], cells[:, 0]] = at
    middles = 0.25 * (grid[1:, 1:] + grid[1:, :-1] + grid[:-1, 1:] + grid[:-1, :-1])
    if squares:
        ink, ground = np.percentile(_levels(grey, middles), [15.0, 85.0]).tolist()
    else:
        ink, ground = float(np.median(_levels(grey, grid))), float(np.median(_levels(grey, middles)))
    for turn in range(4):
        turned = np.rot90(grid, turn)
        edge, step = turned[0], turned[0] - turned[1]
        if squares:  # the centres of the squares that would follow those at the end of the pattern
            edge, step = 0.5 * (edge[1:] + edge[:-1]), 0.75 * (step[1:] + step[:-1])
        beyond = edge + step
        if ((beyond < 1.0) | (beyond > np.array(grey.shape[::-1]) - 2.0)).any():
            return False
        # Beyond a pattern of squares either colour is possible, but the same all along.
        shown, near = _levels(grey, beyond), SURROUNDINGS_TOLERANCE * abs(ground - ink)
        if max(np.mean(np.abs(shown - level) < near) for level in ((ground, ink) if squares else (ground,))) < _ALL:
            return False
    return True


def _levels(grey: Grey, where: Array) -> Array:
    at = where.reshape(1, -1, 2).astype(np.float32)
    out = cv2.remap(cv2.GaussianBlur(grey, (0, 0), 1.0), at[:, :, 0], at[:, :, 1], cv2.INTER_LINEAR)
    return np.asarray(out[0], np.float64)


def by_colours(grey: Grey, cells: NDArray[np.intp], at: Array) -> NDArray[np.intp] | None:
    """The corners (n, 2) of a whole board with one odd and one even number of them, which lie at (n, 2) px, rotated so
    that the square between the first ones along both axes is dark; None where the colours don't tell.
    """
    last = cells.max(axis=0)
    places = np.full((*(last + 1), 2), np.nan)
    places[cells[:, 0], cells[:, 1]] = at
    # The centre of a square from its four corners: perspective and lens hardly distort one square.
    middles = 0.25 * (places[:-1, :-1] + places[1:, :-1] + places[:-1, 1:] + places[1:, 1:])
    shown = np.isfinite(middles).all(axis=2)
    levels = grey[tuple(np.rint(middles[shown][:, k]).astype(int) for k in (1, 0))].astype(np.float64)
    even = np.indices(shown.shape).sum(axis=0)[shown] % 2 == 0
    if even.all() or not even.any():
        return None
    difference = float(np.median(levels[even]) - np.median(levels[~even]))
    if abs(difference) <= LEAST_CONTRAST * float(np.ptp(levels)):
        return None
    return last - cells if difference > 0.0 else cells
