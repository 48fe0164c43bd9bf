"""SE(3) for every frame, compiled: same names as the functions of :mod:`gripmon.model.geometry`.

A transform is a contiguous float64 (4, 4) array here.
"""

from __future__ import annotations

import math

import numpy as np

from gripmon.model.compiled import compiled
from gripmon.model.geometry import SMALL_RAD
from gripmon.model.records import Array, Transform


@compiled
def quaternion_of(a_T_b: Array) -> tuple[float, float, float, float]:
    """Unit quaternion x, y, z, w with w >= 0 of a transform's rotation (Shepperd's method)."""
    a, b, c = a_T_b[0, 0], a_T_b[0, 1], a_T_b[0, 2]
    d, e, f = a_T_b[1, 0], a_T_b[1, 1], a_T_b[1, 2]
    g, h, i = a_T_b[2, 0], a_T_b[2, 1], a_T_b[2, 2]
    of_x, of_y, of_z, of_w = 1.0 + a - e - i, 1.0 - a + e - i, 1.0 - a - e + i, 1.0 + a + e + i
    largest = max(of_x, of_y, of_z, of_w)
    s = math.sqrt(largest)
    k = 0.5 / s
    if largest == of_x:
        x, y, z, w = 0.5 * s, (b + d) * k, (c + g) * k, (h - f) * k
    elif largest == of_y:
        x, y, z, w = (b + d) * k, 0.5 * s, (f + h) * k, (c - g) * k
    elif largest == of_z:
        x, y, z, w = (c + g) * k, (f + h) * k, 0.5 * s, (d - b) * k
    else:
        x, y, z, w = (h - f) * k, (c - g) * k, (d - b) * k, 0.5 * s
    n = 1.0 / math.sqrt(x * x + y * y + z * z + w * w)
    if w < 0.0:
        n = -n
    return x * n, y * n, z * n, w * n


@compiled
def _turn_between(from_T: Array, to_T: Array) -> Array:
    """(4, 4) with the rotation ``to_R from_R'``, no translation."""
    out = np.zeros((4, 4))
    for i in range(3):
        for j in range(3):
            out[i, j] = to_T[i, 0] * from_T[j, 0] + to_T[i, 1] * from_T[j, 1] + to_T[i, 2] * from_T[j, 2]
    out[3, 3] = 1.0
    return out


@compiled
def perturbation_between(from_T: Array, to_T: Array) -> Array:
    """``xi`` (6,) = (rho, omega) from one pose (4, 4) to another: ``to_t = from_t + rho``, ``to_R = exp(omega)
    from_R``.
    """
    x, y, z, w = quaternion_of(_turn_between(from_T, to_T))
    sine = math.sqrt(x * x + y * y + z * z)
    factor = 2.0 * math.atan2(sine, w) / sine if sine > SMALL_RAD else 2.0 / w
    out = np.empty(6)
    for i in range(3):
        out[i] = to_T[i, 3] - from_T[i, 3]
    out[3], out[4], out[5] = factor * x, factor * y, factor * z
    return out


@compiled
def perturb(a_T_b: Array, xi: Array) -> Array:
    """The pose (4, 4) after ``xi`` (6,) = (rho, omega), equations (11) to (13) with the exponential."""
    x, y, z = xi[3], xi[4], xi[5]
    squared = x * x + y * y + z * z
    angle = math.sqrt(squared)
    if angle < SMALL_RAD:
        s, c = 1.0 - squared / 6.0, 0.5 - squared / 24.0
    else:
        s, c = math.sin(angle) / angle, (1.0 - math.cos(angle)) / squared
    turn = (
        (1.0 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y),
        (c * x * y + s * z, 1.0 - c * (x * x + z * z), c * y * z - s * x),
        (c * x * z - s * y, c * y * z + s * x, 1.0 - c * (x * x + y * y)),
    )
    turned, out = np.empty((3, 3)), np.zeros((4, 4))
    for i in range(3):
        for j in range(3):
            turned[i, j] = turn[i][0] * a_T_b[0, j] + turn[i][1] * a_T_b[1, j] + turn[i][2] * a_T_b[2, j]
    # One Newton step towards the nearest rotation, so that rounding errors don't build up over millions of frames.
    for j in range(3):
        for k in range(3):
            square = turned[0, k] * turned[0, j] + turned[1, k] * turned[1, j] + turned[2, k] * turned[2, j]
            correction = (1.5 if j == k else 0.0) - 0.5 * square
            for i in range(3):
                out[i, j] += turned[i, k] * correction
    for i in range(3):
        out[i, 3] = a_T_b[i, 3] + xi[i]
    out[3, 3] = 1.0
    return out


@compiled
def motion_between(from_T: Array, to_T: Array) -> tuple[float, float]:
    """Length d (m) and angle delta (rad) of the motion from one pose (4, 4) to another, equation (14)."""
    turn = _turn_between(from_T, to_T)
    x, y, z, w = quaternion_of(turn)
    square = 0.0
    for i in range(3):
        way = to_T[i, 3] - (turn[i, 0] * from_T[0, 3] + turn[i, 1] * from_T[1, 3] + turn[i, 2] * from_T[2, 3])
        square += way * way
    return math.sqrt(square), 2.0 * math.atan2(math.sqrt(x * x + y * y + z * z), w)


def to_record(a_T_b: Array) -> Transform:
    """A pose (4, 4) as it is published."""
    x, y, z = a_T_b[:3, 3].tolist()
    return Transform((x, y, z), quaternion_of(a_T_b))


def warm_up() -> None:
    """Compile the functions, or load them from the cache."""
    here = np.eye(4)
    motion_between(here, perturb(here, perturbation_between(here, here)))
    to_record(here)
