"""SE(3) in plain arrays, for the per-frame path.  Elsewhere use ``scipy.spatial.transform``.

A transform is a 4x4 float64 array ``a_T_b`` that maps homogeneous coordinates in frame b to frame a.  A perturbation of
a transform is ``xi = (rho, omega)``: ``t_true = t + rho`` and ``R_true = exp(omega) R``, both in axes of frame a, as in
the published covariance.
"""

from __future__ import annotations

import math

import numpy as np

from gripmon.model.records import Array, Transform

SMALL_RAD = 1e-8
UNIT_TOLERANCE = 0.01
"""Largest difference of a written quaternion's length from 1: files of four digits are rounded."""
_IDENTITY = np.eye(4)
_THREE_HALVES = 1.5 * np.eye(3)


def skew(v: Array) -> Array:
    """(..., 3) -> (..., 3, 3) with ``skew(a) @ b == cross(a, b)``."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def exp_rotation(omega: Array) -> Array:
    """Rotation vector (3,), rad -> rotation matrix (3, 3).  Rodrigues; exact to rounding near zero."""
    x, y, z = float(omega[0]), float(omega[1]), float(omega[2])
    squared = x * x + y * y + z * z
    angle = math.sqrt(squared)
    if angle < SMALL_RAD:
        s, c = 1.0 - squared / 6.0, 0.5 - squared / 24.0
    else:
        s, c = math.sin(angle) / angle, (1.0 - math.cos(angle)) / squared
    return np.array(
        [
            [1.0 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y],
            [c * x * y + s * z, 1.0 - c * (x * x + z * z), c * y * z - s * x],
            [c * x * z - s * y, c * y * z + s * x, 1.0 - c * (x * x + y * y)],
        ]
    )


def left_jacobians(omega: Array) -> Array:
    """Rotation vectors (n, 3), rad -> left Jacobians J (n, 3, 3): ``exp(omega + d) = exp(J d) exp(omega)``, small d."""
    angle = np.linalg.norm(omega, axis=1)
    small = angle < 1e-6  # rad: the next term of the series is below rounding
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 0.5, (1.0 - np.cos(safe)) / safe**2)[:, None, None]
    second = np.where(small, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)[:, None, None]
    cross = skew(omega)
    return np.asarray(np.eye(3) + first * cross + second * (cross @ cross))


def seen_from(cam_T_b: Array, points_b: Array) -> tuple[Array, Array]:
    """Ideal coordinates (n, 2) of points (n, 3), and their derivatives (n, 2, 6) by a perturbation of the pose."""
    turned = points_b @ cam_T_b[:3, :3].T
    points = turned + cam_T_b[:3, 3]
    xy = points[:, :2] / points[:, 2:]
    by_point = np.zeros((len(points), 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = 1.0 / points[:, 2]
    by_point[:, :, 2] = -xy / points[:, 2:]
    return xy, np.concatenate([by_point, -by_point @ skew(turned)], axis=2)


def log_rotation(rotation: Array) -> Array:
    """Rotation matrix (3, 3) -> rotation vector (3,), angle in [0, pi]."""
    x, y, z, w = quaternion_xyzw(rotation)
    sine = math.sqrt(x * x + y * y + z * z)
    factor = 2.0 * math.atan2(sine, w) / sine if sine > SMALL_RAD else 2.0 / w
    return np.array([factor * x, factor * y, factor * z])


def rotation_angle(rotation: Array) -> float:
    """Angle of a rotation matrix, rad, in [0, pi]."""
    x, y, z, w = quaternion_xyzw(rotation)
    return 2.0 * math.atan2(math.sqrt(x * x + y * y + z * z), w)


def quaternion_xyzw(rotation: Array) -> tuple[float, float, float, float]:
    """Rotation matrix (3, 3) -> unit quaternion with w >= 0 (Shepperd's method: the largest component first)."""
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    squares = (1.0 + a - e - i, 1.0 - a + e - i, 1.0 - a - e + i, 1.0 + a + e + i)
    largest = max(range(4), key=squares.__getitem__)
    s = math.sqrt(squares[largest])
    k = 0.5 / s
    if largest == 3:
        q = ((h - f) * k, (c - g) * k, (d - b) * k, 0.5 * s)
    elif largest == 0:
        q = (0.5 * s, (b + d) * k, (c + g) * k, (h - f) * k)
    elif largest == 1:
        q = ((b + d) * k, 0.5 * s, (f + h) * k, (c - g) * k)
    else:
        q = ((c + g) * k, (f + h) * k, 0.5 * s, (d - b) * k)
    n = math.copysign(1.0 / math.sqrt(sum(v * v for v in q)), q[3] if q[3] != 0.0 else 1.0)
    return (q[0] * n, q[1] * n, q[2] * n, q[3] * n)


def rotation_from_xyzw(quaternion: tuple[float, float, float, float]) -> Array:
    """Quaternion x, y, z, w (any length but zero) -> rotation matrix (3, 3)."""
    x, y, z, w = quaternion
    n = x * x + y * y + z * z + w * w
    if not n > 0.0:
        raise ValueError("a quaternion of length zero is not a rotation")
    s = 2.0 / n
    return np.array(
        [
            [1.0 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
            [s * (x * y + z * w), 1.0 - s * (x * x + z * z), s * (y * z - x * w)],
            [s * (x * z - y * w), s * (y * z + x * w), 1.0 - s * (x * x + y * y)],
        ]
    )


def make_transform(rotation: Array, translation_m: Array) -> Array:
    """(3, 3) and (3,) -> ``a_T_b`` (4, 4)."""
    out = _IDENTITY.copy()
    out[:3, :3] = rotation
    out[:3, 3] = translation_m
    return out


def invert(a_T_b: Array) -> Array:
    """``a_T_b`` -> ``b_T_a``."""
    b_R_a = a_T_b[:3, :3].T
    return make_transform(b_R_a, -b_R_a @ a_T_b[:3, 3])


def inverse_jacobian(a_T_b: Array) -> Array:
    """Jacobian (6, 6) of the error ``(rho', omega')`` of ``b_T_a`` by that of ``a_T_b``, each in its own axes.

    From ``t_true = t + rho`` and ``R_true = exp(omega) R`` follows to first order, for the inverse, ``rho' = -R^T rho -
    R^T [t]x omega`` and ``omega' = -R^T omega``.
    """
    turn = a_T_b[:3, :3].T
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = -turn
    out[:3, 3:] = -turn @ skew(a_T_b[:3, 3])
    return out


def perturb(a_T_b: Array, xi: Array) -> Array:
    """Apply ``xi = (rho, omega)`` (6,): translation plus rho, rotation exp(omega) from the left, re-orthonormalised."""
    rotation = exp_rotation(xi[3:]) @ a_T_b[:3, :3]
    # One Newton step towards the nearest rotation, so that rounding errors don't build up over millions of frames.
    rotation = rotation @ (_THREE_HALVES - 0.5 * (rotation.T @ rotation))
    return make_transform(rotation, a_T_b[:3, 3] + xi[:3])


def perturbation_between(from_T: Array, to_T: Array) -> Array:
    """The ``xi`` (6,) with ``perturb(from_T, xi) == to_T``."""
    out = np.empty(6)
    out[:3] = to_T[:3, 3] - from_T[:3, 3]
    out[3:] = log_rotation(to_T[:3, :3] @ from_T[:3, :3].T)
    return out


def to_vector(values: Array) -> tuple[float, float, float]:
    """An array (3,) as plain numbers."""
    x, y, z = values.tolist()
    return x, y, z


def to_record(a_T_b: Array) -> Transform:
    return Transform(to_vector(a_T_b[:3, 3]), quaternion_xyzw(a_T_b[:3, :3]))


def from_record(transform: Transform) -> Array:
    return make_transform(rotation_from_xyzw(transform.rotation_xyzw), np.array(transform.translation_m))
