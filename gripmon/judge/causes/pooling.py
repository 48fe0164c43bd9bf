"""Evidence of several frames combined: the median place of each piece of an edge, robust against single mistakes.

The baseline is where the edges are seen while all is well.  It contains the calibration's error and what the gripper
model leaves out: a bevel, shading or a reference that is off by a tenth of a millimetre shifts the edges before and
after alike.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gripmon.judge.causes.kernel import JAW, POSE
from gripmon.judge.causes.state import EdgeView, State, edge_places
from gripmon.model.camera import Camera
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, EdgeEvidence

EDGE_PIECES = 5
"""Pieces that an edge is divided into."""

SEEN_FRAME_SHARE = 1.0 / 3.0
"""Part of the frames in which a piece has to be seen, and which have to show so much of a finger."""

TEXTURE_SIGMA_SHARE = 0.5
"""Part of a stretch's own standard deviation that is the same in all frames: the texture on it."""

SEEN_STRETCHES, SEEN_EDGES, SEEN_SHARE = 3, 2, 0.25
"""Stretches of a finger, edges that they lie on, and inlier ratio of its search lines from which it counts as seen."""


@dataclass(frozen=True, slots=True)
class Pooled:
    """``evidence`` at the pose of the central frame (see :func:`pool`), with a stretch for each piece ``piece`` (s,) of
    an edge; ``absent``: fingers in view that are not seen; ``share`` (f,): inlier ratio of each finger's search lines
    at the finger's own place in enough of the frames, NaN where it isn't in view; ``blur_px2``: of the lens, None where
    it isn't known; ``noise``, ``brightest``, ``steepest`` and ``cells`` as in ``EdgeEvidence``, and ``wander`` (12, 16)
    of the cells from frame to frame; ``frames`` that it was made of; ``found``: in most of them the gripper was.
    """

    evidence: EdgeEvidence
    piece: NDArray[np.intp]
    absent: tuple[int, ...]
    share: Array
    blur_px2: float | None
    noise: float
    brightest: float
    steepest: float
    cells: Array
    wander: Array
    frames: int
    found: bool


def piece_of(edge: NDArray[np.intp], fraction: Array) -> NDArray[np.intp]:
    """(s,) number of the piece among all pieces of all edges."""
    return np.asarray(edge * EDGE_PIECES + np.minimum((fraction * EDGE_PIECES).astype(np.intp), EDGE_PIECES - 1))


def pool(frames: Sequence[EdgeEvidence], camera: Camera, gripper: Gripper) -> Pooled:
    """One or more frames as one, at the pose of the central one; vibration between them averages out.

    Not at the newest's pose: a frame in which too little agreed may have the gripper anywhere.
    """
    midst = frames[_midst(frames, gripper)]
    base = _state(midst, midst, gripper)
    places, residuals, fractions, sigmas, details = [], [], [], [], []
    for frame in frames:
        frame = _without(frame, absent_fingers(frame, gripper), gripper)
        if not len(frame.edge):
            continue
        residual, fraction = EdgeView(camera, gripper, frame).beside(_state(frame, midst, gripper))
        places.append(piece_of(frame.edge, frame.fraction))
        residuals.append(residual)
        fractions.append(fraction)
        sigmas.append(frame.sigma_px)
        details.append(np.column_stack([frame.per_px, frame.spread_px, frame.blur_px2, frame.across]))
    absences = [absent_fingers(frame, gripper) for frame in frames]
    often = tuple(f for f in range(len(gripper.finger_ids)) if 2 * sum(f in a for a in absences) > len(frames))
    share, found = _share(frames), 2 * sum(frame.found for frame in frames) > len(frames)
    noise = float(np.median([frame.noise for frame in frames]))
    brightest = float(np.median([frame.brightest for frame in frames]))
    steepest = float(np.median([frame.steepest for frame in frames]))
    cells = np.array([frame.cells for frame in frames])
    image = noise, brightest, steepest, np.median(cells, axis=0), np.ptp(cells, axis=0)
    if not places:
        nothing = _only(midst, np.zeros(len(midst.edge), dtype=bool))
        return Pooled(nothing, np.zeros(0, np.intp), often, share, None, *image, len(frames), found)
    piece, residual, fraction = np.concatenate(places), np.concatenate(residuals), np.concatenate(fractions)
    sigma, detail = np.concatenate(sigmas), np.concatenate(details)
    numbers, count = np.unique(piece, return_counts=True)
    numbers = numbers[count >= SEEN_FRAME_SHARE * len(frames)]
    numbers = numbers[~np.isin(gripper.edge_finger[numbers // EDGE_PIECES], often)]
    rows = [np.flatnonzero(piece == number) for number in numbers]

    def middle(values: Array) -> Array:
        return np.array([np.median(values[own], axis=0) for own in rows]).reshape(len(rows), *values.shape[1:])

    shift_px, at, own_px, other = middle(residual), middle(fraction), middle(sigma), middle(detail)
    size = np.array([len(own) for own in rows])
    # Standard error of a median, from the scatter as it is; a single frame has its own.
    scatter_px = np.array(
        [1.4826 * np.median(np.abs(residual[own] - r)) for own, r in zip(rows, shift_px, strict=True)]
    )
    scatter_px = np.where(size >= 3, scatter_px, own_px)
    edge = numbers // EDGE_PIECES
    xy, across_xy = edge_places(gripper, base, edge, at)
    per_px = other[:, 0]
    evidence = replace(
        midst,
        edge=edge,
        fraction=at,
        xy=xy + (shift_px * per_px)[:, None] * across_xy,
        per_px=per_px,
        sigma_px=np.hypot(1.25 * scatter_px / np.sqrt(size), TEXTURE_SIGMA_SHARE * own_px),
        spread_px=other[:, 1],
        blur_px2=other[:, 2],
        across=other[:, 3:],
    )
    blur_px2 = isotropic_blur_px2(evidence)
    return Pooled(evidence, numbers, often, share, blur_px2, *image, len(frames), found)


def _share(frames: Sequence[EdgeEvidence]) -> Array:
    """(f,) what the shares reach in as many of the frames as a piece has to be seen in; NaN without such frames."""
    shares = np.sort(np.nan_to_num([frame.finger_share for frame in frames], nan=-1.0), axis=0)
    reached = shares[-math.ceil(SEEN_FRAME_SHARE * len(frames))]
    return np.where(reached >= 0.0, reached, np.nan)


def absent_fingers(evidence: EdgeEvidence, gripper: Gripper) -> tuple[int, ...]:
    """Fingers that should be in view and are not seen."""
    count = len(gripper.finger_ids)
    stretches = np.bincount(gripper.edge_finger[evidence.edge], minlength=count)
    edges = np.bincount(gripper.edge_finger[np.unique(evidence.edge)], minlength=count)
    sampled = np.isfinite(evidence.finger_share)
    seen = (stretches >= SEEN_STRETCHES) & (edges >= SEEN_EDGES)
    seen &= np.nan_to_num(evidence.finger_share) >= SEEN_SHARE
    return tuple(np.flatnonzero(sampled & ~seen).tolist())


def isotropic_blur_px2(evidence: EdgeEvidence) -> float | None:
    """The least variance of the edges' blur over all directions in the image; None with too few directions.

    Motion smears edges along one direction only; a lens out of focus blurs all of them.
    """
    if len(evidence.edge) < 6:
        return None
    angle = 2.0 * np.arctan2(evidence.across[:, 1], evidence.across[:, 0])
    design = np.column_stack([np.ones(len(angle)), np.cos(angle), np.sin(angle)])
    if np.linalg.cond(design) > 10.0:
        return None
    weight = np.ones(len(angle))
    for _ in range(8):  # towards least absolute deviations: an edge beside another one looks wide
        terms = np.linalg.lstsq(design * weight[:, None], evidence.blur_px2 * weight, rcond=None)[0]
        rest = np.abs(evidence.blur_px2 - design @ terms)
        weight = 1.0 / np.sqrt(np.maximum(rest, 0.02))
    return max(float(terms[0] - np.hypot(terms[1], terms[2])), 0.0)


def _midst(frames: Sequence[EdgeEvidence], gripper: Gripper) -> int:
    """Number of the frame whose pose is nearest to those of all frames; of equals the newest."""
    points = gripper.points_grip_m(None)
    places = np.array([points @ frame.cam_T_grip[:3, :3].T + frame.cam_T_grip[:3, 3] for frame in frames])
    away_m = [float(np.linalg.norm(places - own, axis=2).mean(axis=1).sum()) for own in places]
    return len(frames) - 1 - int(np.argmin(away_m[::-1]))


def _state(frame: EdgeEvidence, base: EdgeEvidence, gripper: Gripper) -> State:
    """Where the frame ``base`` has everything, with the opening as it was reported, or seen, in another."""
    opening_m = frame.jaw_opening_m
    if frame.jaw_reported_m is not None and base.jaw_reported_m is not None:
        opening_m = base.jaw_opening_m + frame.jaw_reported_m - base.jaw_reported_m
    opening_m = min(max(opening_m, gripper.jaw_min_m), gripper.jaw_max_m)
    return State(base.cam_T_grip, opening_m, 0.0, np.zeros((len(gripper.finger_ids), 6)))


def _without(evidence: EdgeEvidence, fingers: tuple[int, ...], gripper: Gripper) -> EdgeEvidence:
    """Without the stretches of fingers that are not seen."""
    return _only(evidence, ~np.isin(gripper.edge_finger[evidence.edge], fingers)) if fingers else evidence


def _only(evidence: EdgeEvidence, kept: NDArray[np.bool_]) -> EdgeEvidence:
    names = ("edge", "fraction", "xy", "per_px", "sigma_px", "spread_px", "blur_px2", "across")
    return replace(evidence, **{name: getattr(evidence, name)[kept] for name in names})


@dataclass(frozen=True, slots=True)
class Baseline:
    """``motion`` (m,) of the unknowns from the reference; ``bias_px`` of each piece of an edge beyond that, and
    ``sigma_px`` of it, both (pieces,), NaN where none was seen; the openings that were reported and seen then;
    blur, noise, ``steepest``, ``cells`` and ``wander`` as in :class:`Pooled`.
    """

    motion: Array
    bias_px: Array
    sigma_px: Array
    jaw_reported_m: float | None
    jaw_opening_m: float
    blur_px2: float | None
    noise: float
    steepest: float
    cells: Array
    wander: Array

    @classmethod
    def of(cls, pooled: Pooled, motion: Array, residual_px: Array, edges: int) -> Baseline:
        bias_px, sigma_px = np.full(edges * EDGE_PIECES, np.nan), np.full(edges * EDGE_PIECES, np.nan)
        bias_px[pooled.piece], sigma_px[pooled.piece] = residual_px, pooled.evidence.sigma_px
        then = pooled.evidence
        image = pooled.blur_px2, pooled.noise, pooled.steepest, pooled.cells, pooled.wander
        return cls(motion, bias_px, sigma_px, then.jaw_reported_m, then.jaw_opening_m, *image)

    def start(self, state: State, reported: bool, gripper: Gripper) -> State:
        """Where everything stands if nothing has moved; ``state``: if the reference and the report are right."""
        motion = np.zeros_like(self.motion)
        motion[POSE] = self.motion[POSE]
        if reported:
            motion[JAW] = self.motion[JAW]
        return state.moved(motion, gripper)

    def known(self, piece: NDArray[np.intp]) -> NDArray[np.bool_]:
        """(s,) whether pieces were seen."""
        return np.isfinite(self.bias_px[piece])

    def bias_of(self, piece: NDArray[np.intp]) -> tuple[Array, Array]:
        """(s,) bias and its standard deviation in px; of a piece that wasn't seen that of its edge, else zero."""
        bias_px, sigma_px = self.bias_px[piece], self.sigma_px[piece]
        by_edge = self.bias_px.reshape(-1, EDGE_PIECES)
        for k in np.flatnonzero(~np.isfinite(bias_px)):
            own = by_edge[piece[k] // EDGE_PIECES]
            own = own[np.isfinite(own)]
            bias_px[k], sigma_px[k] = (float(np.median(own)), 0.0) if len(own) else (0.0, 0.0)
        return bias_px, sigma_px
