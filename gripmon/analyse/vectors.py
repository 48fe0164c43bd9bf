"""A recording as whitened vectors about one pose, without outlier frames; poses as vectors ``xi = (rho, omega)`` about
one of them, and back; means of blocks of frames, and interpolation between them.

About the pose ``T0`` a pose T is ``t = t0 + rho``, ``R = exp(omega) R0``.  The error that a covariance describes is
applied after that; to first order ``exp(e) exp(omega) = exp(omega + J(omega)^-1 e)`` with the left Jacobian J of SO(3)
(Solà, Deray and Atchuthan, "A micro Lie theory for state estimation in robotics", 2018, eq. 145).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from gripmon.analyse.smoothing import CHI2_MEDIAN, Bools, Ints, Smoothed, mean_squares, step_of
from gripmon.model.geometry import left_jacobians
from gripmon.model.records import Array

MIN_FRAMES = 3
MAX_GAP_S = 3600.0
"""Longer gaps count as this long: anything may have happened, and longer ones overflow."""
MAX_DISTANCE_M = 1e6
"""Transforms with a larger translation are rejected; their squares overflow."""
MIN_COVARIANCE_DIAGONAL, MIN_CORRELATION_EIGENVALUE = 1e-24, 1e-9
"""Least diagonal of a covariance (m², rad²: a picometre) and least eigenvalue of its correlations."""
OUTLIER_SIGMAS, OUTLIER_WINDOW_FRAMES, OUTLIER_MAX_FRAMES = 8.0, 9, 2
"""A frame farther than this from its window's median is an outlier if at most this many in a row are."""


@dataclass
class Run:
    """A recording in whitened vectors: ``y`` (n, 6), NaN where not measured; ``claimed``: reported variances."""

    time_s: Array
    origin_T: Array
    root: Array
    y: Array
    claimed: Array
    usable: Bools
    faults: list[str] = field(default_factory=list)

    @property
    def frame_s(self) -> float:
        """Median interval of the measured frames, s."""
        return step_of(self.time_s[self.usable])


def prepare(stamp_ns: Ints, cam_T_grip: Array, covariance: Array, measured: Bools) -> Run:
    stamp_ns = np.asarray(stamp_ns, np.int64)
    usable = np.asarray(measured, bool) & np.isfinite(cam_T_grip).all(axis=(1, 2))
    faults = []
    near = usable & (np.abs(cam_T_grip[:, :3, 3]) < MAX_DISTANCE_M).all(axis=1)
    if (bad := int((usable & ~near).sum())) > 0:
        faults.append(
            f"the transforms of {bad} frames reach {MAX_DISTANCE_M:.0e} m or farther: these frames were not used"
        )
    usable = near
    known = usable & are_definite(covariance)
    if (bad := int((usable & ~known).sum())) > 0:
        faults.append(f"the covariances of {bad} frames aren't positive definite: these frames were not used")
    usable = known
    if usable.sum() < MIN_FRAMES:
        raise ValueError("; ".join([f"only {usable.sum()} frames were measured; at least {MIN_FRAMES}", *faults]))
    step_ns = np.diff(stamp_ns)
    back = int((step_ns < 0).sum())
    if back:
        faults.append(f"time runs backwards {back} times: frames count in the order of their numbers there")
    ahead = step_ns[step_ns > 0]
    usual_ns = int(np.median(ahead)) if len(ahead) else 1
    if len(ahead) and ahead.max() > 1e9 * MAX_GAP_S:
        often = int((ahead > 1e9 * MAX_GAP_S).sum())
        faults.append(f"{often} gaps are longer than {MAX_GAP_S:.0f} s: each counts as that long")
    step_ns = np.minimum(np.where(step_ns < 0, usual_ns, step_ns), round(1e9 * MAX_GAP_S))
    time_s = 1e-9 * np.concatenate([[0.0], np.cumsum(step_ns, dtype=float)])
    good = np.flatnonzero(usable)
    origin_T = np.eye(4)
    some = good[:: max(len(good) // 2000, 1)]
    origin_T[:3, :3] = Rotation.from_matrix(cam_T_grip[some, :3, :3]).mean().as_matrix()
    origin_T[:3, 3] = np.median(cam_T_grip[some, :3, 3], axis=0)
    vectors = to_vectors(origin_T, cam_T_grip[good])
    own = covariances_to_vectors(covariance[good], vectors)
    variances = np.einsum("nii->ni", own)
    scale = np.median(variances / np.median(variances, axis=0), axis=1)
    usual = scale <= np.quantile(scale, 0.9)
    root = np.linalg.cholesky((own[usual] / scale[usual, None, None]).mean(axis=0))
    inverse = np.linalg.inv(root)
    y, claimed = np.full((len(stamp_ns), 6), np.nan), np.full((len(stamp_ns), 6), np.inf)
    y[good] = vectors @ inverse.T
    claimed[good] = np.einsum("ij,njk,ik->ni", inverse, own, inverse, optimize=True)
    return Run(time_s, origin_T, root, y, claimed, usable, faults)


def are_definite(covariance: Array) -> Bools:
    """Which of the matrices (n, 6, 6) are finite and positive definite, by the eigenvalues of their correlations."""
    out = np.isfinite(covariance).all(axis=(1, 2))
    out &= (np.einsum("nii->ni", covariance) > MIN_COVARIANCE_DIAGONAL).all(axis=1)
    index = np.flatnonzero(out)
    sigma = np.sqrt(np.einsum("nii->ni", covariance[index]))
    correlation = covariance[index] / (sigma[:, :, None] * sigma[:, None, :])
    symmetric = (np.abs(correlation - np.swapaxes(correlation, 1, 2)) < MIN_CORRELATION_EIGENVALUE**0.5).all(
        axis=(1, 2)
    )
    out[index] = symmetric & (np.linalg.eigvalsh(correlation)[:, 0] > MIN_CORRELATION_EIGENVALUE)
    return out


def outlier_frames(run: Run) -> Bools:
    """Outliers: frames far from their neighbours on both sides, singly or in pairs."""
    out = np.zeros(len(run.y), bool)
    good = np.flatnonzero(run.usable)
    if len(good) < 2 * OUTLIER_WINDOW_FRAMES:
        return out
    y = run.y[good]
    off = y - median_filter(y, size=(OUTLIER_WINDOW_FRAMES, 1), mode="nearest")
    usual = np.sqrt(np.median(off * off, axis=0) / CHI2_MEDIAN) + 1e-9
    local = np.sqrt(median_filter(off * off, size=(65, 1), mode="nearest") / CHI2_MEDIAN)
    far = (np.abs(off) > OUTLIER_SIGMAS * np.maximum(usual, local)).any(axis=1)
    far &= (off * off / run.claimed[good]).max(axis=1) > 4.0
    crowd = np.convolve(far, np.ones(17), mode="same")
    # Several frames in a row are motion; a single one is not.
    out[good[far & (crowd <= OUTLIER_MAX_FRAMES)]] = True
    return out


def to_vectors(origin_T: Array, poses: Array) -> Array:
    """(n, 4, 4) -> (n, 6)."""
    turn = poses[:, :3, :3] @ origin_T[:3, :3].T
    return np.concatenate([poses[:, :3, 3] - origin_T[:3, 3], Rotation.from_matrix(turn).as_rotvec()], axis=1)


def to_poses(origin_T: Array, vectors: Array) -> Array:
    """(n, 6) -> (n, 4, 4)."""
    out = np.zeros((len(vectors), 4, 4))
    out[:, 3, 3] = 1.0
    out[:, :3, :3] = (Rotation.from_rotvec(vectors[:, 3:]) * Rotation.from_matrix(origin_T[:3, :3])).as_matrix()
    out[:, :3, 3] = origin_T[:3, 3] + vectors[:, :3]
    return out


def covariances_to_vectors(covariance: Array, vectors: Array) -> Array:
    """Covariances (n, 6, 6) of poses' errors -> those of the vectors (n, 6)."""
    return _mapped(covariance, np.linalg.inv(left_jacobians(vectors[:, 3:])))


def covariances_to_poses(covariance: Array, vectors: Array) -> Array:
    """The inverse of :func:`covariances_to_vectors`."""
    return _mapped(covariance, left_jacobians(vectors[:, 3:]))


def _mapped(covariance: Array, turn: Array) -> Array:
    out = covariance.copy()
    out[:, 3:, :] = turn @ out[:, 3:, :]
    out[:, :, 3:] = out[:, :, 3:] @ np.swapaxes(turn, -1, -2)
    return out


GAP_BLOCKS = 4.0
"""Multiple of the median block interval that makes a gap, in which additional states are placed."""
MAX_GAP_PLACES = 200


class Blocks:
    """Means of up to ``size`` neighbouring frames of a segment."""

    def __init__(self, run: Run, good: Ints, segment: Ints, size: int, y: Array, swing: Array):
        count = len(good)
        new = np.diff(segment, prepend=-1) > 0
        new |= np.diff(run.time_s[good], prepend=-np.inf) > GAP_BLOCKS * size * run.frame_s
        start = np.maximum.accumulate(np.where(new, np.arange(count), 0))
        self._at = np.flatnonzero((np.arange(count) - start) % size == 0)
        self._count = np.diff(np.append(self._at, count)).astype(float)
        self._size, self._y = size, y
        noise = run.claimed[good] + swing
        weight = 1.0 / noise
        total = np.add.reduceat(weight, self._at, axis=0)
        self.mean = np.add.reduceat(weight * y, self._at, axis=0) / total
        self.time_s = np.add.reduceat(run.time_s[good], self._at) / self._count
        self.segment = segment[self._at]
        self._noise = 1.0 / total
        self._swing = np.add.reduceat(swing, self._at, axis=0) / self._count[:, None]

    def variance(self, white: Array) -> Array:
        """(m, 6) of the blocks' own errors; ``white`` (6,): that of a full block."""
        return np.maximum(white * self._size * self._noise, 1e-6) + self._swing

    def frame_variance(self) -> Array:
        """(6,) of frames about the mean of their block, robust against outliers."""
        if self._size == 1:
            return np.zeros(6)
        number = np.repeat(np.arange(len(self._at)), self._count.astype(int))
        off = self._y - self.mean[number]
        full = self._count[number] == self._size
        return mean_squares(off[full] if full.any() else off, trimmed=True)


def with_gaps(run: Run, time_s: Array) -> tuple[Array, Ints]:
    """Block times with additional ones in long gaps and beyond both ends; and the indices of the blocks in them."""
    usual = step_of(time_s)
    extra = []
    edges = np.concatenate([[min(run.time_s[0], time_s[0])], time_s, [max(run.time_s[-1], time_s[-1])]])
    for begin, end in pairwise(edges.tolist()):
        if end - begin > GAP_BLOCKS * usual:
            places = min(int((end - begin) / usual), MAX_GAP_PLACES)
            extra.append(np.linspace(begin, end, places + 2)[1:-1])
    both = np.concatenate([time_s, *extra])
    order = np.argsort(both, kind="stable")
    where = np.empty(len(both), np.int64)
    where[order] = np.arange(len(both))
    return both[order], where[: len(time_s)]


def at(time_s: Array, segment: Ints, smoothed: Smoothed, wanted_s: Array, wanted_segment: Ints) -> tuple[Array, Array]:
    """x (k, 6) and its variance (k, 6) at any times, from the neighbouring states of the same segment."""
    first = np.searchsorted(segment, wanted_segment, side="left")
    last = np.searchsorted(segment, wanted_segment, side="right") - 1
    after = np.clip(np.searchsorted(time_s, wanted_s, side="left"), first, last)
    before = np.clip(after - 1, first, last)
    inside = (after > before) & (wanted_s >= time_s[before]) & (wanted_s <= time_s[after])
    nearest = np.where(np.abs(time_s[after] - wanted_s) < np.abs(wanted_s - time_s[before]), after, before)
    elapsed_s = (wanted_s - time_s[nearest])[:, None]
    p = smoothed.covariance[nearest]
    x = smoothed.x[nearest] + elapsed_s * smoothed.rate[nearest]
    variance = p[..., 0, 0] + 2.0 * elapsed_s * p[..., 0, 1] + elapsed_s * elapsed_s * p[..., 1, 1]
    span = np.where(inside, time_s[after] - time_s[before], 1.0)
    f = (np.where(inside, wanted_s - time_s[before], 0.0) / np.where(span > 0.0, span, 1.0))[:, None]
    between = (1.0 - f) * smoothed.x[before] + f * smoothed.x[after]
    spread = (1.0 - f) * smoothed.covariance[before][..., 0, 0] + f * smoothed.covariance[after][..., 0, 0]
    return np.where(inside[:, None], between, x), np.where(inside[:, None], spread, variance)
