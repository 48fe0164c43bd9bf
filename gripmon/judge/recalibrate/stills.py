"""Frames of a camera that stands still, taken together: the tracked poses' average, and the corners' mean places.

Both kinds of error are in every frame: one that changes from frame to frame, as noise and a moving background do, and
one that doesn't, as texture, light and a background that stands still.  What the frames' covariances claim holds both;
what their scatter shows is the first, and only that becomes less by averaging.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.judge.smoothing import GATE_SQUARE
from gripmon.model.geometry import perturb, perturbation_between
from gripmon.model.records import Array, EdgeSums

LASTING_SHARE = 0.25
"""Part of a claimed variance that averaging never removes, however much of it the frames' scatter explains."""

NEIGHBOURS, MOST_ALIKE = 2.0, 0.9
"""Frames in a row that count as one at least, since their changing errors are alike, too; and the largest correlation
of neighbours that a few frames can tell.
"""

FIRST_FRAMES = 3
"""First frames, whose claims are taken for those of all if they are larger."""

FEWEST_SEEN = 0.2
"""Part of the frames in which a corner must be usable."""


@dataclass(frozen=True, slots=True)
class StillFrame:
    """What one measured frame gives: the tracked ``cam_T_grip`` (4, 4) with the ``covariance`` (6, 6) of its error; the
    corners' places ``points_grip_m`` (c, 3) at the frame's jaw opening; ``usable`` (c,) those that were measured, at
    ``xy`` (c, 2) in ideal coordinates, with the joint covariance ``covariance_xy`` (2k, 2k) of the k usable ones; what
    the ``edges`` say, None where no one asked.
    """

    seq: int
    stamp_ns: int
    cam_T_grip: Array
    covariance: Array
    points_grip_m: Array
    usable: NDArray[np.bool_]
    xy: Array
    covariance_xy: Array
    edges: EdgeSums | None = None


@dataclass(frozen=True, slots=True)
class Average:
    """Mean ``cam_T_grip`` (4, 4) of the tracked poses with the honest ``covariance`` (6, 6) of its error;
    ``covariance_at_last`` the same once ``most_frames`` were averaged.  ``way`` (6,) from the mean of the first half to
    that of the second, and its squared size ``trend`` over the frames' own scatter; ``outlying``: part of the frames
    whose pose doesn't belong to the others'.
    """

    cam_T_grip: Array
    covariance: Array
    covariance_at_last: Array
    way: Array
    trend: float
    outlying: float


def average(frames: list[StillFrame], most_frames: int) -> Average:
    """Weighted mean of the tracked poses of at least four frames, without those that lie far from the middle."""
    middle_T = _middle(frames)
    xis = np.array([perturbation_between(middle_T, f.cam_T_grip) for f in frames])
    weights = np.array([np.linalg.inv(f.covariance) for f in frames])
    centre = np.median(xis, axis=0)
    far = np.einsum("ni,nij,nj->n", xis - centre, weights, xis - centre) > GATE_SQUARE
    outlying = float(far.mean())
    if np.count_nonzero(~far) >= 4:
        xis, weights = xis[~far], weights[~far]
    claimed = np.linalg.inv(weights.mean(axis=0))
    mean = np.linalg.solve(weights.sum(axis=0), np.einsum("nij,nj->i", weights, xis))
    # What later frames claim to know better, of the jaw's opening say, they have learnt from pictures that err alike.
    claimed = larger(claimed, np.mean([f.covariance for f in frames[:FIRST_FRAMES]], axis=0))
    scatter = np.cov(xis.T)
    half = len(xis) // 2
    way = xis[-half:].mean(axis=0) - xis[:half].mean(axis=0)
    trend = float(way @ np.linalg.solve(scatter * (2.0 * NEIGHBOURS / half) + 1e-6 * claimed, way))
    return Average(
        perturb(middle_T, mean),
        averaged_covariance(claimed, xis, len(xis)),
        averaged_covariance(claimed, xis, max(most_frames, len(xis))),
        way,
        trend,
        outlying,
    )


def averaged_covariance(claimed: Array, values: Array, count: int) -> Array:
    """Covariance (m, m) of the mean of ``count`` values in a row whose error has the ``claimed`` covariance each, as n
    of them, ``values`` (n, m), show.

    Along each common axis of what is claimed and of the values' scatter, with v the scatter in units of what is
    claimed: what doesn't scatter, 1 - v, but at least :data:`LASTING_SHARE`, stays as it is, and v becomes less as
    the mean of so many independent values as the values' own likeness from one to the next leaves.
    """
    factor = np.linalg.cholesky(claimed)
    off = np.linalg.solve(factor, (values - values.mean(axis=0)).T)
    part, axes = np.linalg.eigh(off @ off.T / (len(values) - 1))
    part = np.maximum(part, 0.0)
    alike = np.array([_alike(row) for row in axes.T @ off])
    left = np.maximum(1.0 - part, LASTING_SHARE) + part * np.minimum(alike / count, 1.0)
    axes = factor @ axes
    return np.asarray((axes * left) @ axes.T)


def _alike(values: Array) -> float:
    """How many values (n,) in a row count as one: from the correlation of neighbours, as if all of it were handed on
    from one to the next.
    """
    squares = float(values @ values)
    if not squares > 0.0:
        return NEIGHBOURS
    count = len(values)
    correlation = float(values[1:] @ values[:-1]) / squares
    # A short series shows too little of it (Marriott and Pope 1954).
    correlation = min(correlation + (1.0 + 3.0 * correlation) / count, MOST_ALIKE)
    return max((1.0 + correlation) / (1.0 - correlation), NEIGHBOURS)


def larger(covariance: Array, other: Array) -> Array:
    """(m, m) the larger of two covariances along each of their common axes."""
    factor = np.linalg.cholesky(covariance)
    inverse = np.linalg.inv(factor)
    part, axes = np.linalg.eigh(inverse @ other @ inverse.T)
    axes = factor @ axes
    return np.asarray((axes * np.maximum(part, 1.0)) @ axes.T)


def _middle(frames: list[StillFrame]) -> Array:
    """The frame's pose whose TCP is nearest to the median of all."""
    tcp_m = np.array([f.cam_T_grip[:3, 3] for f in frames])
    distance = np.linalg.norm(tcp_m - np.median(tcp_m, axis=0), axis=1)
    return frames[int(np.argmin(distance))].cam_T_grip


@dataclass(frozen=True, slots=True)
class MeanCorners:
    """The k corners that most frames show: their indices ``corner`` (k,), mean ``points_grip_m`` (k, 3), mean ``xy``
    (k, 2) with the joint covariance (2k, 2k) of its error.
    """

    corner: NDArray[np.intp]
    points_grip_m: Array
    xy: Array
    covariance_xy: Array

    def of(self, taken: NDArray[np.bool_]) -> MeanCorners:
        """Only those ``taken`` (k,)."""
        both = np.repeat(taken, 2)
        return MeanCorners(
            self.corner[taken], self.points_grip_m[taken], self.xy[taken], self.covariance_xy[np.ix_(both, both)]
        )


def mean_corners(frames: list[StillFrame], cam_T_grip: Array) -> MeanCorners:
    """Corners averaged over the frames: their mean distance from where ``cam_T_grip`` puts them at each frame's own jaw
    opening, added to where it puts their mean points.  A corner's frames that lie far from its median don't count.

    The pose only carries the corners from one opening to the others: an error of it cancels to first order.
    """
    off_xy = np.array([f.xy - _image(f.points_grip_m, cam_T_grip) for f in frames])
    usable = np.array([f.usable for f in frames])
    off_xy[~usable] = 0.0
    usable &= ~_astray(frames, off_xy)
    usable[:, usable.mean(axis=0) < FEWEST_SEEN] = False
    corner = np.flatnonzero(usable.any(axis=0))
    times = usable[:, corner].sum(axis=0)
    information, pull, part = _sums(frames, off_xy, usable)
    mean = np.linalg.solve(information, pull)
    # As if each corner had been seen once, and all together: what lasts of their errors is in every frame.
    once = np.sqrt(np.repeat(times, 2))
    claimed = np.linalg.inv(information / np.outer(once, once))
    left = max(1.0 - part, LASTING_SHARE) + part * NEIGHBOURS / max(int(times.min(initial=len(frames))), 1)
    points = np.array([f.points_grip_m[corner] for f in frames]) * usable[:, corner, None]
    points_grip_m = points.sum(axis=0) / times[:, None]
    xy = _image(points_grip_m, cam_T_grip) + mean.reshape(-1, 2)
    return MeanCorners(corner, points_grip_m, xy, claimed * left)


def _sums(frames: list[StillFrame], off_xy: Array, usable: NDArray[np.bool_]) -> tuple[Array, Array, float]:
    """Over all frames: information (2k, 2k) of the k corners usable in any, information times offset (2k,), and the
    scatter about their medians in units of what is claimed.
    """
    ever = usable.any(axis=0)
    middle = np.zeros(off_xy.shape[1:])
    for c in np.flatnonzero(ever):
        middle[c] = np.median(off_xy[usable[:, c], c], axis=0)
    information, pull = np.zeros((middle.size, middle.size)), np.zeros(middle.size)
    squares, values = 0.0, 0
    for frame, off, taken in zip(frames, off_xy, usable, strict=True):
        rows = np.flatnonzero(np.repeat(taken, 2))
        among = np.repeat(taken[frame.usable], 2)
        weight = np.linalg.inv(frame.covariance_xy[np.ix_(among, among)])
        information[np.ix_(rows, rows)] += weight
        pull[rows] += weight @ off.ravel()[rows]
        rest = (off - middle).ravel()[rows]
        squares, values = squares + float(rest @ weight @ rest), values + len(rows)
    both = np.flatnonzero(np.repeat(ever, 2))
    return information[np.ix_(both, both)], pull[both], squares / max(values, 1)


def _astray(frames: list[StillFrame], off_xy: Array) -> NDArray[np.bool_]:
    """(n, c) corners that lie further from their median over the frames than five standard deviations."""
    usable = np.array([f.usable for f in frames])
    middle = np.zeros(off_xy.shape[1:])
    for c in np.flatnonzero(usable.any(axis=0)):
        middle[c] = np.median(off_xy[usable[:, c], c], axis=0)
    x, y = np.moveaxis(off_xy - middle, 2, 0)
    own = np.tile(np.eye(2), (*usable.shape, 1, 1))
    for n, frame in enumerate(frames):
        count = int(np.count_nonzero(frame.usable))
        each = np.arange(count)
        own[n, frame.usable] = frame.covariance_xy.reshape(count, 2, count, 2)[each, :, each]
    xx, xy, yy = own[..., 0, 0], own[..., 0, 1], own[..., 1, 1]
    far = x * x * yy - 2.0 * x * y * xy + y * y * xx > 25.0 * (xx * yy - xy * xy)
    return np.asarray(usable & far)


def _image(points_grip_m: Array, cam_T_grip: Array) -> Array:
    points = points_grip_m @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3]
    return np.asarray(points[:, :2] / points[:, 2:])
