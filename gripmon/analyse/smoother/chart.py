"""Many poses at once as vectors ``xi = (rho, omega)`` about one of them, and back.

About the pose ``T0`` a pose T is ``t = t0 + rho``, ``R = exp(omega) R0``.  The error that a covariance speaks of is
applied after that; to first order ``exp(e) exp(omega) = exp(omega + J(omega)^-1 e)`` with the left Jacobian J of SO(3)
(Solà, Deray and Atchuthan, "A micro Lie theory for state estimation in robotics", 2018, eq. 145).
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from gripmon.model.geometry import skew
from gripmon.model.records import Array

_SMALL_RAD = 1e-6


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


def jacobians(omega: Array) -> Array:
    """Left Jacobians (n, 3, 3) of rotation vectors (n, 3)."""
    angle = np.linalg.norm(omega, axis=1)
    safe = np.where(angle > _SMALL_RAD, angle, 1.0)
    first = np.where(angle > _SMALL_RAD, (1.0 - np.cos(safe)) / safe**2, 0.5)
    second = np.where(angle > _SMALL_RAD, (safe - np.sin(safe)) / safe**3, 1.0 / 6.0)
    cross = skew(omega)
    return np.asarray(np.eye(3) + first[:, None, None] * cross + second[:, None, None] * (cross @ cross))


def covariances_to_vectors(covariance: Array, vectors: Array) -> Array:
    """Covariances (n, 6, 6) of poses' errors -> those of the vectors (n, 6)."""
    return _mapped(covariance, np.linalg.inv(jacobians(vectors[:, 3:])))


def covariances_to_poses(covariance: Array, vectors: Array) -> Array:
    """The way back."""
    return _mapped(covariance, jacobians(vectors[:, 3:]))


def _mapped(covariance: Array, turn: Array) -> Array:
    out = covariance.copy()
    out[:, 3:, :] = turn @ out[:, 3:, :]
    out[:, :, 3:] = out[:, :, 3:] @ np.swapaxes(turn, -1, -2)
    return out
