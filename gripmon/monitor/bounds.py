"""How far off a pose may be, and the motion since the reference, from its fits under all that may be wrong."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array, Protection
from gripmon.monitor.common import CommonError
from gripmon.monitor.since import AtReference, Bounds, Opened
from gripmon.track.integrity.frame_kernel import First
from gripmon.track.integrity.level_kernel import Bound

SIGMA_INFLATION = 1.2
"""Factor on standard deviations so that a normal distribution bounds the tails of the edges' errors."""

UNBOUNDED_M, UNBOUNDED_RAD = 1.0, 3.0
"""Published where there is no bound."""


class ModelError(NamedTuple):
    """The gripper file's error: each finger longer or shorter by a standard deviation ``sigma_m``, along ``axis_grip``
    (3,); ``finger`` (e,): which of the ``fingers`` each edge belongs to; ``common``: None where there is no such error.
    ``first``: what was measured at the reference, None until a frame proves a pose, and the reference (4, 4).
    """

    sigma_m: float
    axis_grip: Array
    finger: NDArray[np.intp]
    fingers: int
    common: CommonError | None
    first: tuple[AtReference | None, Array] = (None, np.eye(4))

    @property
    def parts(self) -> int:
        """Number of the gripper's parts that may be off: its fingers, and its edges each by itself."""
        return self.fingers + len(self.finger)

    def differences(self, cam_T_grip: Array, opened: Opened, swing: Array) -> First:
        """What makes fits near a pose (4, 4) fits of the motion since the reference.  ``swing`` (6,): variances of the
        mount's vibration.
        """
        first, reference_T = self.first
        if first is not None:
            return first.differences(cam_T_grip, reference_T, opened, self.common, swing)
        begun, nowhere = (np.zeros((0, 6)), np.zeros((0, 6, 6)), np.zeros((0, self.parts, 6))), np.zeros(6)
        return begun, np.eye(6), np.zeros((0, 6, 3)), nowhere, nowhere[:3], nowhere[:3], nowhere

    def alike(self, cam_T_grip: Array) -> tuple[Array, Array]:
        """What all fits near a pose (4, 4) are off by: by standard deviations (p, 6), and by these lengths (2,)."""
        common = self.common
        return (np.zeros((0, 6)), np.zeros(2)) if common is None else (common.alike(cam_T_grip), common.farther)


def unbounded(risk: float, why: str) -> Bounds:
    """Both bounds where there are none, and why."""
    none = Protection(UNBOUNDED_M, UNBOUNDED_RAD, risk, why)
    return Bounds(none, none)


def protection_of(bound: Bound, names: tuple[str, ...], risk: float) -> Protection:
    """The protection levels, m and rad, at an integrity ``risk``, with the name of what the position's owes most to."""
    position_m, rotation_rad, number = bound
    why = names[number] if number >= 0 else ""
    return Protection(min(position_m, UNBOUNDED_M), min(rotation_rad, UNBOUNDED_RAD), risk, why)


def reaching(bound: Protection, away: Array, hypothesis: str) -> Protection:
    """A pose's bound, increased to include another pose, ``away`` (6,) from it."""
    return Protection(
        bound.position_m + float(np.linalg.norm(away[:3])),
        bound.rotation_rad + float(np.linalg.norm(away[3:])),
        bound.risk,
        hypothesis,
    )


def larger(one: Protection, other: Protection) -> Protection:
    """The larger of two bounds, for position and for rotation; the hypothesis is that of the larger position."""
    first, second = (one, other) if one.position_m >= other.position_m else (other, one)
    return Protection(first.position_m, max(first.rotation_rad, second.rotation_rad), first.risk, first.hypothesis)
