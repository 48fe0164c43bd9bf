"""What may have moved, and by what order of size."""

from __future__ import annotations

import numpy as np

from gripmon.laser.watch.world import CAMERA, COUNT, LASER, PLANE
from gripmon.model.records import Array, Cause

KINDS: tuple[tuple[Cause, slice, float], ...] = (
    (Cause.CAMERA_MOUNT, CAMERA, 0.3),
    (Cause.PLANE_MOVED, PLANE, 0.3),
    (Cause.LASER_MOVED, LASER, 0.3),
    (Cause.UNKNOWN, slice(0, COUNT), 0.1),
)
"""Cause, what of the parameters moves, and its share beforehand; the last one is several of them at once, which is how
an arm that was moved or has lost its zero looks as well.
"""

BACK = len(KINDS)
"""Kind of a belief that everything is where it was calibrated again."""

SCALES = ((1e-3, 1.5e-3), (1e-2, 1.5e-2), (1e-1, 1.5e-1))
"""Standard deviations (m, rad) of motions that are looked for: a mount that gives way, a knock, a fall."""

_RAD = np.array([False] * 3 + [True] * 3 + [True, True, False] + [True, True, False, False])


def assumed(kind: int, scale: int) -> Array:
    """(13, 13): covariance of a motion."""
    metres, radians = SCALES[scale]
    variance = np.zeros(COUNT)
    moves = KINDS[kind][1]
    variance[moves] = np.square(np.where(_RAD, radians, metres))[moves]
    return np.diag(variance)


def newborn() -> tuple[Array, Array, Array, Array]:
    """Of all kinds and scales: kind (m,), scale (m,), logarithm of the share (m,), covariance (m, 13, 13)."""
    pairs = [(kind, scale) for kind in range(len(KINDS)) for scale in range(len(SCALES))]
    shares = np.array([KINDS[kind][2] / len(SCALES) for kind, _ in pairs])
    return (
        np.array([kind for kind, _ in pairs]),
        np.array([scale for _, scale in pairs]),
        np.log(shares),
        np.stack([assumed(kind, scale) for kind, scale in pairs]),
    )
