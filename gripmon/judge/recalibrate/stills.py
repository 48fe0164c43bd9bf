"""Frames of a camera that stands still, combined: the average of the tracked poses, and the corners' mean positions.

Every frame has two kinds of error: one that changes from frame to frame, from noise and a moving background, and one
that doesn't, from texture, light and a static background.  The frames' claimed covariances hold both; their scatter
shows the first, and averaging reduces only that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.judge.smoothing import GATE_SQUARE
from gripmon.model.geometry import perturb, perturbation_between
from gripmon.model.records import Array, EdgeSums

LASTING_SHARE = 0.25
"""Least part of a claimed variance that averaging never removes, however much of it the frames' scatter explains."""

NEIGHBOURS, MOST_ALIKE = 2.0, 0.9
"""Least number of consecutive frames that count as one, since their changing errors are correlated, too; and the
largest correlation of neighbours that a few frames can show.
"""

FIRST_FRAMES = 3
"""Number of first frames; if their claimed covariance is larger, it is taken for all frames."""

FEWEST_SEEN = 0.2
"""Least part of the frames in which a corner must be usable."""


@dataclass(frozen=True, slots=True)
class StillFrame:
    """What one measured frame gives: the tracked ``cam_T_grip`` (4, 4) with the ``covariance`` (6, 6) of its error; the
    corners' positions ``points_grip_m`` (c, 3) at the frame's jaw opening; ``usable`` (c,), those that were measured,
    at ``xy`` (c, 2) in ideal coordinates, with the joint covariance ``covariance_xy`` (2k, 2k) of the k usable ones;
    the ``edges``' sums, None where they weren't asked for.
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
    """Mean ``cam_T_grip`` (4, 4) of the tracked poses with the ``covariance`` (6, 6) of its error, lasting part
    included; ``covariance_at_last`` is the same once ``most_frames`` are averaged.  ``way`` (6,) is the displacement
    from the mean of the first half to that of the second, ``trend`` its square, normalised by the frames' own scatter;
    ``outlying``: part of the frames whose pose lies far from the others'.
    """

    cam_T_grip: Array
    covariance: Array
    covariance_at_last: Array
    way: Array
    trend: float
    outlying: float


def average(frames: list[StillFrame], most_frames: int) -> Average:
    """Weighted mean of the tracked poses of at least four frames, without those far from the median."""
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
    # Later frames may claim to know more, e.g. of the jaw opening, but they learnt it from images with the same error.
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
    """Covariance (m, m) of the mean of ``count`` consecutive values, each with an error of the ``claimed`` covariance
    (m, m); ``values`` (n, m) are n of them.

    Works along each common axis of the claimed covariance and the values' scatter; v is the scatter in units of what is
    claimed.  The part that doesn't scatter, 1 - v, but at least :data:`LASTING_SHARE`, stays.  The part v is divided by
    the number of independent values that the correlation of neighbours leaves.
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
    """Number of consecutive values (n,) that count as one independent value: from the correlation of neighbours, as in
    a first-order autoregression; at least :data:`NEIGHBOURS`.
    """
    squares = float(values @ values)
    if not squares > 0.0:
        return NEIGHBOURS
    count = len(values)
    correlation = float(values[1:] @ values[:-1]) / squares
    # A short series shows too little correlation (Marriott and Pope 1954).
    correlation = min(correlation + (1.0 + 3.0 * correlation) / count, MOST_ALIKE)
    return max((1.0 + correlation) / (1.0 - correlation), NEIGHBOURS)


def larger(covariance: Array, other: Array) -> Array:
    """The larger of two covariances (m, m) along each of their common axes."""
    factor = np.linalg.cholesky(covariance)
    inverse = np.linalg.inv(factor)
    part, axes = np.linalg.eigh(inverse @ other @ inverse.T)
    axes = factor @ axes
    return np.asarray((axes * np.maximum(part, 1.0)) @ axes.T)


def _middle(frames: list[StillFrame]) -> Array:
    """Pose of the frame whose TCP is nearest to the median."""
    tcp_m = np.array([f.cam_T_grip[:3, 3] for f in frames])
    distance = np.linalg.norm(tcp_m - np.median(tcp_m, axis=0), axis=1)
    return frames[int(np.argmin(distance))].cam_T_grip


@dataclass(frozen=True, slots=True)
class MeanCorners:
    """The k corners that enough frames show: their indices ``corner`` (k,), mean ``points_grip_m`` (k, 3), mean ``xy``
    (k, 2) with the joint covariance (2k, 2k) of its error.
    """

    corner: NDArray[np.intp]
    points_grip_m: Array
    xy: Array
    covariance_xy: Array

    def of(self, taken: NDArray[np.bool_]) -> MeanCorners:
        """Only those of the mask ``taken`` (k,)."""
        both = np.repeat(taken, 2)
        return MeanCorners(
            self.corner[taken], self.points_grip_m[taken], self.xy[taken], self.covariance_xy[np.ix_(both, both)]
        )


def mean_corners(frames: list[StillFrame], cam_T_grip: Array) -> MeanCorners:
    """Corners averaged over the frames: their mean offset from where ``cam_T_grip`` projects them at each frame's own
    jaw opening, added to the projection of their mean points.  Frames in which a corner lies far from its median don't
    count for it.

    The pose only relates the corners at different openings: its error cancels to first order.
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
    # As if each corner had been seen once, all in one frame: the lasting part of their errors is in every frame.
    once = np.sqrt(np.repeat(times, 2))
    claimed = np.linalg.inv(information / np.outer(once, once))
    left = max(1.0 - part, LASTING_SHARE) + part * NEIGHBOURS / max(int(times.min(initial=len(frames))), 1)
    points = np.array([f.points_grip_m[corner] for f in frames]) * usable[:, corner, None]
    points_grip_m = points.sum(axis=0) / times[:, None]
    xy = _image(points_grip_m, cam_T_grip) + mean.reshape(-1, 2)
    return MeanCorners(corner, points_grip_m, xy, claimed * left)


def _sums(frames: list[StillFrame], off_xy: Array, usable: NDArray[np.bool_]) -> tuple[Array, Array, float]:
    """Over all frames: information (2k, 2k) of the k corners usable in any, information times offset (2k,), and the
    scatter about their medians over what is claimed.
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
    """Mask (n, c) of corners that lie more than five standard deviations from their median over the frames."""
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
