"""A recording as whitened vectors about one pose; poses as vectors ``xi = (rho, omega)`` about one of them, and back.

About the pose ``T0`` a pose T is ``t = t0 + rho``, ``R = exp(omega) R0``.  The error that a covariance describes is
applied after that; to first order ``exp(e) exp(omega) = exp(omega + J(omega)^-1 e)`` with the left Jacobian J of SO(3)
(Solà, Deray and Atchuthan, "A micro Lie theory for state estimation in robotics", 2018, eq. 145).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gripmon.model.geometry import left_jacobians
from gripmon.model.records import Array

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

MIN_FRAMES = 3
MAX_GAP_S = 3600.0
"""Longer gaps count as this long: anything may have happened, and longer ones overflow."""
MAX_DISTANCE_M = 1e6
"""Transforms with a larger translation are rejected; their squares overflow."""
MIN_COVARIANCE_DIAGONAL, MIN_CORRELATION_EIGENVALUE = 1e-24, 1e-9
"""Least diagonal of a covariance (m², rad²: a picometre) and least eigenvalue of its correlations."""


@dataclass
class Run:
    """A recording in whitened vectors: ``y`` (n, 6), NaN where not measured; ``claimed`` (n, 6): reported variances in
    units of the usual one, infinite there; ``root`` (6, 6): from whitened vectors to m and rad.
    """

    time_s: Array
    origin_T: Array
    root: Array
    y: Array
    claimed: Array
    usable: Bools
    faults: tuple[str, ...]

    @property
    def frame_s(self) -> float:
        """Median interval of the measured frames, s; 1 if none differ."""
        steps = np.diff(self.time_s[self.usable])
        return float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 1.0


def prepare(stamp_ns: Ints, cam_T_grip: Array, covariance: Array, measured: Bools) -> Run:
    """Whiten a recording by its own mean covariance.  ValueError if fewer than :data:`MIN_FRAMES` frames are left."""
    faults = []
    usable = np.asarray(measured, bool) & np.isfinite(cam_T_grip).all(axis=(1, 2))
    for holds, wrong in (
        (
            (np.abs(cam_T_grip[:, :3, 3]) < MAX_DISTANCE_M).all(axis=1),
            f"the transforms of {{}} frames reach {MAX_DISTANCE_M:.0e} m or farther: these frames were not used",
        ),
        (are_definite(covariance), "the covariances of {} frames aren't positive definite: these frames were not used"),
    ):
        if bad := int((usable & ~holds).sum()):
            faults.append(wrong.format(bad))
        usable &= holds
    if usable.sum() < MIN_FRAMES:
        raise ValueError("; ".join([f"only {usable.sum()} frames were measured; at least {MIN_FRAMES}", *faults]))
    good = np.flatnonzero(usable)
    some = good[:: max(len(good) // 2000, 1)]
    origin_T = np.eye(4)
    origin_T[:3, :3] = Rotation.from_matrix(cam_T_grip[some, :3, :3]).mean().as_matrix()
    origin_T[:3, 3] = np.median(cam_T_grip[some, :3, 3], axis=0)
    vectors = to_vectors(origin_T, cam_T_grip[good])
    own = covariances_to_vectors(covariance[good], vectors)
    variances = np.einsum("nii->ni", own)
    scale = np.median(variances / np.median(variances, axis=0), axis=1)
    root = np.linalg.cholesky((own / scale[:, None, None]).mean(axis=0))
    inverse = np.linalg.inv(root)
    y, claimed = np.full((len(usable), 6), np.nan), np.full((len(usable), 6), np.inf)
    y[good] = vectors @ inverse.T
    claimed[good] = np.einsum("ij,njk,ik->ni", inverse, own, inverse, optimize=True)
    time_s = _straightened(np.asarray(stamp_ns, np.int64), faults)
    return Run(time_s, origin_T, root, y, claimed, usable, tuple(faults))


def _straightened(stamp_ns: Ints, faults: list[str]) -> Array:
    """Seconds since the first frame, never falling."""
    step_ns = np.diff(stamp_ns)
    ahead = step_ns[step_ns > 0]
    usual_ns = int(np.median(ahead)) if len(ahead) else 1
    if back := int((step_ns < 0).sum()):
        faults.append(f"time runs backwards {back} times: frames count in the order of their numbers there")
    if often := int((ahead > 1e9 * MAX_GAP_S).sum()):
        faults.append(f"{often} gaps are longer than {MAX_GAP_S:.0f} s: each counts as that long")
    step_ns = np.minimum(np.where(step_ns < 0, usual_ns, step_ns), round(1e9 * MAX_GAP_S))
    return np.asarray(1e-9 * np.concatenate([[0.0], np.cumsum(step_ns, dtype=float)]))


def are_definite(covariance: Array) -> Bools:
    """Which of the matrices (n, 6, 6) are finite and positive definite, by the eigenvalues of their correlations."""
    out = np.isfinite(covariance).all(axis=(1, 2))
    out &= (np.einsum("nii->ni", covariance) > MIN_COVARIANCE_DIAGONAL).all(axis=1)
    index = np.flatnonzero(out)
    sigma = np.sqrt(np.einsum("nii->ni", covariance[index]))
    correlation = covariance[index] / (sigma[:, :, None] * sigma[:, None, :])
    skew = np.abs(correlation - np.swapaxes(correlation, 1, 2)).max(axis=(1, 2), initial=0.0)
    least = np.linalg.eigvalsh(correlation)[:, 0]
    out[index] = (skew < MIN_CORRELATION_EIGENVALUE**0.5) & (least > MIN_CORRELATION_EIGENVALUE)
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
