"""How fingers move with the jaw's opening, from images at several openings; the motion also gives their distance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.errors import NoResultError
from gripmon.model.records import Array
from gripmon.teach.image_outline import OpeningSeen
from gripmon.teach.matte import sets_refused
from gripmon.teach.silhouette import Stations, inner_side, lines_in_image, measure_transitions
from gripmon.teach.straight_pieces import WORST_RMS_PX, jackknife_sigma

SAME_OPENING_M = 5e-5
"""Openings closer than this count as one: about 0.2 px of each finger, 100 mm away."""
FEWEST_STATIONS = 20
STATIONS = 40
"""Number of stations on each edge."""
TIP_SHARE = 0.35
"""Part of a finger's length that is its tip, which is at one depth."""
MOST_TOGETHER = 0.55
"""Largest mean motion of the fingers over their relative motion: with one fixed jaw it is 0.5, known to a tenth."""
ROUGH_STEP_PX = 2.0
"""Resolution of a roughly known shift, which is searched for in images of half the size."""
_FAR_PX = 260
"""Search range for a finger, each way."""


@dataclass(frozen=True)
class FingerMoved:
    """``shift`` (3,) of a finger over the depth of its tip, camera axes; ``folds`` (f, 3), the same from each fold of
    the images; ``rms_px`` of the edge points about that motion.
    """

    shift: Array
    folds: Array
    rms_px: float

    @property
    def sigma(self) -> Array:
        return jackknife_sigma(self.folds)


def motion_of(
    camera: Camera,
    mask: NDArray[np.bool_],
    outwards: Array,
    points: Array,
    pieces: tuple[tuple[int, int], ...],
    first: OpeningSeen,
    other: OpeningSeen,
) -> FingerMoved | None:
    """The motion of a finger from one opening to another: its ``mask`` (h, w), ``outwards`` (2,) and ``points`` (v, 3),
    at unit depth, of the first opening, camera frame.  None where the other opening doesn't show it.
    """  # fmt: skip
    rough = rough_shift_px(mask, outwards, first, other)
    at = _samples(points, pieces)
    normal = normals(camera, at, mask)
    shift = np.array([rough[0], rough[1], 0.0]) / camera.fx_px * float(np.median(at[:, 2]))
    folds, rms = np.zeros((0, 3)), np.inf
    for turn in range(4):
        stations, design = _stations(camera, at, normal, shift, other.matte.mean.shape)
        found = measure_transitions(
            other.matte.images, stations, other.matte.noise, wide=turn < 2, blur_px=first.blur_px
        )
        usable = found.usable
        if np.count_nonzero(usable) < FEWEST_STATIONS:
            return None
        more, chosen = _least_squares(design, found.offset_px, usable)
        folds = np.array([shift + np.linalg.lstsq(design[chosen], f[chosen], rcond=None)[0] for f in found.folds_px])
        shift = shift + more
        rms = float(np.sqrt(np.square(found.offset_px[chosen] - design[chosen] @ more).mean()))
    return FingerMoved(shift, folds, rms)


def check_opened(moved: Mapping[float, Sequence[FingerMoved]], counts: Sequence[int]) -> None:
    """Raise :class:`~gripmon.model.errors.NoResultError` if sets of images (``counts`` images each), each with other
    static parts, don't show one gripper at several openings, whose fingers would move against each other.
    """
    if len(moved) + 1 < len(counts):
        raise sets_refused(counts)
    for fingers in moved.values():
        shifts = np.array([finger.shift for finger in fingers])
        together = float(np.linalg.norm(0.5 * (shifts.min(axis=0) + shifts.max(axis=0))))
        if max(finger.rms_px for finger in fingers) > WORST_RMS_PX:
            raise sets_refused(counts)
        if together > MOST_TOGETHER * float(np.linalg.norm(np.ptp(shifts, axis=0))):
            raise NoResultError(
                f"the images fall into sets of {' and '.join(map(str, counts))}, between which everything static "
                "moved together: the camera moved; a camera fixed to the gripper, only the jaws moving"
            )


def rough_shift_px(
    mask: NDArray[np.bool_],
    outwards: Array,
    first: OpeningSeen,
    other: OpeningSeen,
    part: tuple[float, float] = (0.0, TIP_SHARE),
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
    here = np.where(first.matte.still & mask, 255, 0).astype(np.uint8)[window]
    padded = cv2.copyMakeBorder(
        other.matte.still.astype(np.uint8) * 255, _FAR_PX, _FAR_PX, _FAR_PX, _FAR_PX, cv2.BORDER_REPLICATE
    )
    around = padded[top : bottom + 2 * _FAR_PX, left : right + 2 * _FAR_PX]
    half = [cv2.resize(i, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for i in (around, here, known * 255)]
    score = cv2.matchTemplate(
        half[0].astype(np.float32), half[1].astype(np.float32), cv2.TM_SQDIFF, mask=(half[2] > 127).astype(np.float32)
    )
    _, _, best, _ = cv2.minMaxLoc(score)
    return np.array([ROUGH_STEP_PX * best[0] - _FAR_PX, ROUGH_STEP_PX * best[1] - _FAR_PX])


def _samples(points: Array, pieces: tuple[tuple[int, int], ...]) -> Array:
    """Rows (n, 6) of a point in space and the direction of its edge, evenly spaced along the edges."""
    out = []
    for a, b in pieces:
        share = np.linspace(0.03, 0.97, STATIONS)[:, None]
        way = points[b] - points[a]
        out.append(np.column_stack([points[a] + share * way, np.tile(way, (len(share), 1))]))
    return np.vstack(out)


def normals(camera: Camera, at: Array, mask: NDArray[np.bool_]) -> Array:
    """Normals (n, 2) of the edges in the image, away from the finger."""
    uv, d_uv = camera.project_with_jacobian(at[:, :3])
    tangent = np.einsum("nij,nj->ni", d_uv, at[:, 3:])
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    return np.where(inner_side(uv, normal, mask)[:, None] > 0.0, -normal, normal)


def _stations(camera: Camera, at: Array, normal: Array, shift: Array, shape: tuple[int, ...]) -> tuple[Stations, Array]:
    uv, d_uv = camera.project_with_jacobian(at[:, :3] + shift)
    uv = np.nan_to_num(uv, nan=-1e3)
    return (
        Stations(uv, normal, lines_in_image(uv, normal, shape)),
        np.nan_to_num(np.einsum("ni,nij->nj", normal, d_uv)),
    )


def _least_squares(design: Array, offset: Array, usable: NDArray[np.bool_]) -> tuple[Array, NDArray[np.bool_]]:
    chosen = usable.copy()
    found: Array = np.zeros(3)
    for _ in range(8):
        found = np.linalg.lstsq(design[chosen], offset[chosen], rcond=None)[0]
        off = np.abs(offset - design @ found)
        again = usable & (off < max(3.0 * 1.4826 * float(np.median(off[usable])), 0.15))
        if np.count_nonzero(again) < FEWEST_STATIONS or (again == chosen).all():
            break
        chosen = again
    return found, chosen
