"""Outlines of two fingers in space, from their motion with the jaws: for fingers that are tapered or curved.

Where a finger moves by T (camera not turned), a point of it moves by ``T / depth`` in the image.  So each piece of the
outline across that motion shows its depth; along straight edges the inverse depth is linear in the image.  Assumption:
both fingers move equally far, in opposite directions, along the line between them.  Edges that move along themselves,
such as those across the jaws, show no depth; they are placed near the plane of the rest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.records import Array
from gripmon.teach.finger_depth import ALONG_RAD, FLAT_SIGMA_RAD, Outline, PlacedOutlines, innermost
from gripmon.teach.image_motion import STATIONS, normals, rough_shift_px
from gripmon.teach.image_outline import OpeningSeen
from gripmon.teach.silhouette import Stations, lines_in_image, measure_transitions
from gripmon.teach.straight_pieces import LEAST_SCATTER_PX

LARGEST_COMMON_MOTION = 0.2
"""Largest sum of both fingers' motions over their difference: it is 1 if one jaw is fixed, a few hundredths for tips at
different depths that move equally far."""
OFF_PLANE = 0.05
"""Standard deviation of an outline's points from a plane, over their distance: half of a finger 10 mm thick, 100 mm
away."""
INDEPENDENT_PX = 4.0
"""Neighbouring edge points have correlated errors: one per this length counts (as where chains are split)."""
TIP_SHARE = 0.1
"""Part of a finger's length that is its tip."""
_TURNS = 8
_ROUGHLY_PX = 30
"""Range, each way, in which the border of what is static is searched for before it is measured."""
_PARTS = ((0.0, 0.25), (0.25, 0.5), (0.5, 0.75))
"""Parts of a finger's length, from its tip, whose motions start the search."""


@dataclass
class _Unknowns:
    """Inverse depth ``q`` (v,) of all fingers' vertices, finger after finger; ``shift`` (o, 2): half of the tips'
    relative motion to each opening, x and y, at unit depth; ``slope_sigma`` (fingers, 2): of q's slopes over x and y.
    """

    q: Array
    shift: Array
    slope_sigma: Array


def place_by_motion(
    camera: Camera,
    fingers: Sequence[Outline],
    seen: OpeningSeen,
    around: Sequence[OpeningSeen],
    pose: tuple[Array, Array] | None,
) -> PlacedOutlines | None:
    """Two fingers in space; with ``pose``, the rotation (3, 3) and the TCP (3,) at unit depth, as a calibration has
    them.  None where this can't be determined: not two fingers, or fingers that don't move against each other.
    """
    if len(fingers) != 2 or not around:
        return None
    rough = np.array([
        [[rough_shift_px(f.mask, f.outwards, seen, other, part) for part in _PARTS] for f in seen.fingers]
        for other in around
    ]) / camera.fx_px  # fmt: skip
    tips = rough[:, :, 0]
    half = 0.5 * (tips[:, 1] - tips[:, 0])
    if (np.linalg.norm(tips.sum(axis=1), axis=1) > LARGEST_COMMON_MOTION * 2.0 * np.linalg.norm(half, axis=1)).any():
        return None
    far = int(np.linalg.norm(half, axis=1).argmax())
    start = np.concatenate([
        _roughly(finger, s * half[far], shifts)
        for finger, s, shifts in zip(fingers, (-1.0, 1.0), rough[far], strict=True)
    ])  # fmt: skip
    found = _solve(camera, fingers, seen, around, half, start)
    if found is None or found.slope_sigma.max() > FLAT_SIGMA_RAD:
        return None
    return _placed(fingers, found, pose)


def _roughly(finger: Outline, shift: Array, of_parts: Array) -> Array:
    """Inverse depths (v,), linear along the finger, from its parts' motions (p, 2) over the tip's ``shift`` (2,)."""
    middles = [0.5 * (near + far) for near, far in _PARTS]
    by_part = of_parts @ shift / float(shift @ shift)
    slope, at_tip = np.polyfit(middles, by_part, 1)
    ahead = finger.xy @ finger.outwards
    return np.asarray(at_tip + slope * (ahead.max() - ahead) / float(np.ptp(ahead)))


def _rays(finger: Outline) -> Array:
    return np.column_stack([finger.xy, np.ones(len(finger.xy))])


def _tips(finger: Outline) -> NDArray[np.intp]:
    """Vertices of its tip."""
    ahead = finger.xy @ finger.outwards
    return np.flatnonzero(ahead > ahead.max() - TIP_SHARE * float(np.ptp(ahead)))


def _between(fingers: Sequence[Outline], q: Sequence[Array]) -> Array:
    """Vector (3,) from the middle of the first finger to that of the other: mirror images have corresponding ones."""
    middles = []
    for finger, of_finger in zip(fingers, q, strict=True):
        points, ends = _rays(finger) / of_finger[:, None], np.reshape(finger.pieces, (-1, 2))
        middles.append(np.average(points[ends].mean(axis=1), axis=0, weights=finger.length_px))
    return np.asarray(middles[1] - middles[0])


def _solve(
    camera: Camera, fingers: Sequence[Outline], seen: OpeningSeen, around: Sequence[OpeningSeen], half: Array, q: Array
) -> _Unknowns | None:
    """Gauss-Newton with a new measurement in each iteration; None where too little of a finger is seen."""
    first = np.concatenate([[0], np.cumsum([len(f.xy) for f in fingers])])
    count, openings = int(first[-1]), len(around)
    size = count + 3 * len(fingers) + 2 * openings
    shift, sigma, rise = half, np.zeros((2, 2)), np.zeros(2)
    for turn in range(_TURNS):
        way = _between(fingers, [q[first[k] : first[k + 1]] for k in range(2)])
        # A motion with a slope in depth lowers the depths found by the same slope: half of it makes both agree.
        rise = 0.5 * (rise + way[2] * way[:2] / float(way[:2] @ way[:2]))
        rows, values = _expected(fingers, first, q, size)
        for o, other in enumerate(around):
            for k, finger in enumerate(fingers):
                got = _measured(
                    camera, finger, seen, other, k, q[first[k] : first[k + 1]], shift[o], rise, turn < _TURNS // 2
                )
                if got is None:
                    return None
                at_q, at_shift, off = got
                row = np.zeros((len(off), size))
                row[:, first[k] : first[k + 1]] = at_q
                row[:, size - 2 * (openings - o) : size - 2 * (openings - o) + 2] = at_shift
                rows.append(row)
                values.append(off)
        design, value = np.vstack(rows), np.concatenate(values)
        step = np.linalg.lstsq(design, value, rcond=None)[0]
        q = np.clip(q + step[:count], 0.3, 3.0)
        shift = shift + step[count + 3 * len(fingers) :].reshape(openings, 2)
        covariance = np.linalg.pinv(design.T @ design)
        sigma = np.array(
            [_slope_sigma(f, covariance[a:b, a:b]) for f, a, b in zip(fingers, first, first[1:], strict=False)]
        )
    return _Unknowns(q, shift, sigma)


def _slope_sigma(finger: Outline, covariance: Array) -> Array:
    """Standard deviations (2,) of the slopes of the inverse depths over x and y, from their covariance (v, v)."""
    slopes = np.linalg.pinv(np.column_stack([np.ones(len(finger.xy)), finger.xy]))[1:]
    return np.asarray(np.sqrt(np.diag(slopes @ covariance @ slopes.T)))


def _expected(fingers: Sequence[Outline], first: Array, q: Array, size: int) -> tuple[list[Array], list[Array]]:
    """Prior rows on the next step: inverse depths near a plane of each finger (whose constant and slopes are unknowns,
    too), with mean 1.
    """
    count = int(first[-1])
    row, value = np.zeros((count, size)), np.zeros(count)
    for k, finger in enumerate(fingers):
        own = slice(int(first[k]), int(first[k + 1]))
        row[own, own] = np.eye(len(finger.xy)) / OFF_PLANE
        value[own] = -q[own] / OFF_PLANE
        middle = finger.xy.mean(axis=0)
        plane = np.column_stack([np.ones(len(finger.xy)), finger.xy - middle])
        row[own, count + 3 * k : count + 3 * k + 3] = -plane / OFF_PLANE
    mean = np.zeros((1, size))
    mean[0, :count] = 1e3 / count
    return [row, mean], [value, np.array([1e3 * (1.0 - q.mean())])]


def _measured(
    camera: Camera,
    finger: Outline,
    seen: OpeningSeen,
    other: OpeningSeen,
    k: int,
    q: Array,
    shift: Array,
    rise: Array,
    roughly: bool,
) -> tuple[Array, Array, Array] | None:
    """Derivatives of a finger's edge points at another opening by its inverse depths (n, v) and by the shift (n, 2),
    and their offsets (n,) from the prediction; each over its standard deviation.
    """
    pieces = np.reshape(finger.pieces, (-1, 2))
    share = np.tile(np.linspace(0.03, 0.97, STATIONS), len(pieces))[:, None]
    ends = np.repeat(pieces, STATIONS, axis=0)
    rays = _rays(finger)
    ray = (1.0 - share) * rays[ends[:, 0]] + share * rays[ends[:, 1]]
    here = (1.0 - share) * q[ends[:, :1]] + share * q[ends[:, 1:]]
    side = (-1.0, 1.0)[k]
    moved = side * np.array([*shift, float(rise @ shift)])
    points = ray / here
    across = normals(camera, np.column_stack([points, rays[ends[:, 1]] - rays[ends[:, 0]]]), seen.fingers[k].mask)
    uv, d_uv = camera.project_with_jacobian(points + moved)
    uv = np.nan_to_num(uv, nan=-1e3)
    stations = Stations(uv, across, lines_in_image(uv, across, other.matte.mean.shape))
    if roughly:
        off = _border(other.matte.still, stations)
        usable = stations.inside & np.isfinite(off)
    else:
        found = measure_transitions(other.matte.images, stations, other.matte.noise, wide=False, blur_px=seen.blur_px)
        off, usable = found.offset_px, found.usable
    if np.count_nonzero(usable) < STATIONS:
        return None
    per_m = np.einsum("ni,nij->nj", across, np.nan_to_num(d_uv))
    per_q = np.einsum("nj,nj->n", per_m, -points / here)
    at_q = np.zeros((len(ray), len(rays)))
    row = np.arange(len(ray))
    np.add.at(at_q, (row, ends[:, 0]), (1.0 - share[:, 0]) * per_q)
    np.add.at(at_q, (row, ends[:, 1]), share[:, 0] * per_q)
    at_shift = side * (per_m[:, :2] + per_m[:, 2:] * rise)
    off = np.where(usable, off, 0.0)
    scatter = max(1.4826 * float(np.median(np.abs(off[usable] - np.median(off[usable])))), LEAST_SCATTER_PX)
    each = np.repeat(finger.length_px / (STATIONS * INDEPENDENT_PX), STATIONS)
    robust = 1.0 / np.maximum(np.abs(off) / (2.0 * scatter), 1.0)
    worth = np.where(usable, np.sqrt(each * robust), 0.0) / scatter
    return at_q * worth[:, None], at_shift * worth[:, None], off * worth


def _border(still: NDArray[np.bool_], stations: Stations) -> Array:
    """Distance (n,) along the normals to the nearest end of what is static, whole pixels; infinite without one."""
    steps = np.arange(-_ROUGHLY_PX, _ROUGHLY_PX + 1)
    at = np.rint(stations.uv_px[:, None] + steps[:, None] * stations.normal[:, None]).astype(int)
    at = np.clip(at, 0, np.array(still.shape[::-1]) - 1)
    here = still[at[..., 1], at[..., 0]]
    ends = here[:, :-1] & ~here[:, 1:]
    away = np.where(ends, steps[:-1] + 0.5, np.inf)
    return np.asarray(np.take_along_axis(away, np.abs(away).argmin(axis=1)[:, None], axis=1)[:, 0])


def _placed(fingers: Sequence[Outline], found: _Unknowns, pose: tuple[Array, Array] | None) -> PlacedOutlines:
    """The result, with axes: x as the jaws move, z along the fingers."""
    first = np.concatenate([[0], np.cumsum([len(f.xy) for f in fingers])])
    q = [found.q[first[k] : first[k + 1]] for k in range(len(fingers))]
    points = [_rays(f) / qf[:, None] for f, qf in zip(fingers, q, strict=True)]
    if pose is None:
        across = _between(fingers, q)
        shift = found.shift[int(np.linalg.norm(found.shift, axis=1).argmax())]
        shift = shift * np.sign(float(shift @ across[:2]))
        across = np.array([*shift, float(shift @ across[:2]) * across[2] / float(across[:2] @ across[:2])])
        across /= np.linalg.norm(across)
        along = np.sum([_along(f, p) for f, p in zip(fingers, points, strict=True)], axis=0)
        along = along - across * float(along @ across)
        along /= np.linalg.norm(along)
        rotation = np.column_stack([across, np.cross(along, across), along])
        tcp = np.mean(innermost([p[_tips(f)] for f, p in zip(fingers, points, strict=True)]), axis=0)
        tcp = tcp + along * (max(float((p @ along).max()) for p in points) - float(along @ tcp))
    else:
        rotation, tcp = pose
        # The outermost point lies as far out as the TCP.
        scale = float(rotation[:, 2] @ tcp) / max(float((p @ rotation[:, 2]).max()) for p in points)
        points = [p * scale for p in points]
    points, tcp = [p / tcp[2] for p in points], tcp / tcp[2]
    slopes = np.sqrt(np.square(found.slope_sigma).mean(axis=0))
    sigma = np.array([slopes[1], slopes[0], 0.0]) if pose is None else np.zeros(3)
    return PlacedOutlines(tuple(points), tuple(f.pieces for f in fingers), rotation, tcp, False, sigma, by_motion=True)


def _along(finger: Outline, points: Array) -> Array:
    """Unit vector (3,) along a finger: the mean of its long sides, so that a taper is symmetric to it."""
    total = np.zeros(3)
    for (a, b), length in zip(finger.pieces, finger.length_px.tolist(), strict=True):
        way, shown = points[b] - points[a], finger.xy[b] - finger.xy[a]
        part = float(shown @ finger.outwards) / float(np.linalg.norm(shown))
        if abs(part) > math.cos(ALONG_RAD):
            total += math.copysign(length, part) * way / np.linalg.norm(way)
    return np.asarray(total / max(float(np.linalg.norm(total)), 1e-12))
