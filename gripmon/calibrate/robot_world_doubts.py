"""Poses of arm and target that were meant otherwise than they are read: said, instead of a calibration from them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gripmon.calibrate import robot_world
from gripmon.calibrate.robot_world import FEWEST_POSES, RobotWorld
from gripmon.calibrate.sighting import CalibrationError
from gripmon.model.records import Array

FARTHEST_M = 20.0
"""No camera measures a target's pose beyond: such numbers are millimetres."""
SUSPECT_RAD = 0.02
"""What is left of the rotations (each axis) from which it is asked whether another reading fits."""
HOPELESS_RAD = 0.1
"""What no arm and no camera are off by."""
_BETTER = 0.1
_AGREEING = 0.7
_OFFSETS = (1, -1, 2, -2)


def check_target_scale(cam_T_target: Array) -> None:
    """ValueError for poses (n, 4, 4) of a target that no camera sees so far away."""
    far_m = float(np.median(np.linalg.norm(cam_T_target[:, :3, 3], axis=1)))
    if far_m > FARTHEST_M:
        raise ValueError(f"the target is {far_m:.4g} m from the camera (median): millimetres? metres")


def check_reading(found: RobotWorld, cam_T_target: Array, base_T_ee: Array) -> None:
    """:class:`CalibrationError` where large residuals go away if the poses (n, 4, 4) are read otherwise, and where they
    are larger than any arm's and camera's errors.
    """
    if found.rms_rad < SUSPECT_RAD:
        return
    left_deg = np.degrees(found.rms_rad)
    for text, target, arm in _readings(cam_T_target, base_T_ee):
        try:
            other = robot_world.refine(target, arm, robot_world.solve(target, arm))
        except CalibrationError:
            continue
        if other.rms_rad < _BETTER * found.rms_rad and other.used.mean() >= _AGREEING:
            raise CalibrationError(f"{text} ({np.degrees(other.rms_rad):.2g} degrees are left, else {left_deg:.2g})")
    if found.rms_rad > HOPELESS_RAD:
        raise CalibrationError(
            f"the poses of arm and target contradict each other: {left_deg:.2g} degrees are left on average; each "
            "target's pose with the arm's at that time"
        )


def _readings(cam_T_target: Array, base_T_ee: Array) -> Iterator[tuple[str, Array, Array]]:
    # Inverting the arm's poses or the target's comes to the same: which of them it is can't be told.
    text = (
        "the poses fit with the arm's or the target's inverted: base_T_ee and cam_T_target; or --eye-in-hand is missing"
    )
    yield f"{text}, or too much", cam_T_target, np.linalg.inv(base_T_ee)
    for offset in _OFFSETS:
        count = len(base_T_ee) - abs(offset)
        if count <= FEWEST_POSES:
            continue
        own, other = max(offset, 0), max(-offset, 0)
        which = "later" if offset > 0 else "earlier"
        text = f"arm and target are out of step: targets fit the arm's poses {abs(offset)} row(s) {which}"
        yield text, cam_T_target[other : other + count], base_T_ee[own : own + count]
