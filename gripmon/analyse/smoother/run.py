"""A recording as whitened vectors about one pose, the frames that are plainly wrong left out."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from gripmon.analyse.smoother import chart
from gripmon.model.records import Array

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

LEAST_FRAMES = 3
LONGEST_GAP_S = 3600.0
"""Beyond, everything may have happened: more time in a gap says no more, and ends what numbers can hold."""
FARTHEST_M = 1e6
"""A transform that reaches farther is none, and its squares end what numbers can hold."""
LEAST_VARIANCE, LEAST_EIGENVALUE = 1e-24, 1e-9
"""Of a covariance (m², rad²: a picometre, no camera's) and of its correlations: below, it is taken for none."""
WILD, WILD_NEIGHBOURS, WILD_RUN = 8.0, 9, 2
"""A frame so many standard deviations off the median of its neighbours is wrong if no more than this many in a row
are, and few are around."""


@dataclass
class Run:
    """A recording in whitened vectors: ``y`` (n, 6), NaN where nothing was measured, with the variances ``claimed``."""

    time_s: Array
    origin_T: Array
    root: Array
    y: Array
    claimed: Array
    usable: Bools
    faults: list[str] = field(default_factory=list)

    @property
    def frame_s(self) -> float:
        """Usual interval of the frames that were measured."""
        steps = np.diff(self.time_s[self.usable])
        steps = steps[steps > 0.0]
        return float(np.median(steps)) if len(steps) else 1.0


def prepare(stamp_ns: Ints, cam_T_grip: Array, covariance: Array, measured: Bools) -> Run:
    stamp_ns = np.asarray(stamp_ns, np.int64)
    usable = np.asarray(measured, bool) & np.isfinite(cam_T_grip).all(axis=(1, 2))
    faults = []
    near = usable & (np.abs(cam_T_grip[:, :3, 3]) < FARTHEST_M).all(axis=1)
    if (bad := int((usable & ~near).sum())) > 0:
        faults.append(f"the transforms of {bad} frames reach {FARTHEST_M:.0e} m or farther: these frames were not used")
    usable = near
    known = usable & are_definite(covariance)
    if (bad := int((usable & ~known).sum())) > 0:
        faults.append(f"the covariances of {bad} frames aren't positive definite: these frames were not used")
    usable = known
    if usable.sum() < LEAST_FRAMES:
        raise ValueError("; ".join([f"only {usable.sum()} frames were measured; at least {LEAST_FRAMES}", *faults]))
    step_ns = np.diff(stamp_ns)
    back = int((step_ns < 0).sum())
    if back:
        faults.append(f"time runs backwards {back} times: frames count in the order of their numbers there")
    ahead = step_ns[step_ns > 0]
    usual_ns = int(np.median(ahead)) if len(ahead) else 1
    if len(ahead) and ahead.max() > 1e9 * LONGEST_GAP_S:
        often = int((ahead > 1e9 * LONGEST_GAP_S).sum())
        faults.append(f"{often} gaps are longer than {LONGEST_GAP_S:.0f} s: each counts as that long")
    step_ns = np.minimum(np.where(step_ns < 0, usual_ns, step_ns), round(1e9 * LONGEST_GAP_S))
    time_s = 1e-9 * np.concatenate([[0.0], np.cumsum(step_ns, dtype=float)])
    good = np.flatnonzero(usable)
    origin_T = np.eye(4)
    some = good[:: max(len(good) // 2000, 1)]
    origin_T[:3, :3] = Rotation.from_matrix(cam_T_grip[some, :3, :3]).mean().as_matrix()
    origin_T[:3, 3] = np.median(cam_T_grip[some, :3, 3], axis=0)
    vectors = chart.to_vectors(origin_T, cam_T_grip[good])
    own = chart.covariances_to_vectors(covariance[good], vectors)
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
    out &= (np.einsum("nii->ni", covariance) > LEAST_VARIANCE).all(axis=1)
    index = np.flatnonzero(out)
    sigma = np.sqrt(np.einsum("nii->ni", covariance[index]))
    correlation = covariance[index] / (sigma[:, :, None] * sigma[:, None, :])
    symmetric = (np.abs(correlation - np.swapaxes(correlation, 1, 2)) < LEAST_EIGENVALUE**0.5).all(axis=(1, 2))
    out[index] = symmetric & (np.linalg.eigvalsh(correlation)[:, 0] > LEAST_EIGENVALUE)
    return out


def wild_frames(run: Run) -> Bools:
    """Frames that lie off their neighbours on both sides, alone or in pairs."""
    out = np.zeros(len(run.y), bool)
    good = np.flatnonzero(run.usable)
    if len(good) < 2 * WILD_NEIGHBOURS:
        return out
    y = run.y[good]
    off = y - median_filter(y, size=(WILD_NEIGHBOURS, 1), mode="nearest")
    usual = np.sqrt(np.median(off * off, axis=0) / 0.4549) + 1e-9
    local = np.sqrt(median_filter(off * off, size=(65, 1), mode="nearest") / 0.4549)
    far = (np.abs(off) > WILD * np.maximum(usual, local)).any(axis=1)
    far &= (off * off / run.claimed[good]).max(axis=1) > 4.0
    crowd = np.convolve(far, np.ones(17), mode="same")
    # A short swing is motion; a frame by itself is not.
    out[good[far & (crowd <= WILD_RUN)]] = True
    return out
