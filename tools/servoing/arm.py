"""A six-axis arm with the gripper on its flange: kinematics by Pinocchio, damped least squares, limits.

Link lengths are the published Denavit-Hartenberg parameters of a UR5e; every joint turns by no more than its range and
no faster than its rate.  The arm follows a commanded rate at once and without error.
"""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin

from gripmon.model.geometry import make_transform
from gripmon.model.records import Array

DH = (
    (0.1625, 0.0, math.pi / 2),
    (0.0, -0.425, 0.0),
    (0.0, -0.3922, 0.0),
    (0.1333, 0.0, math.pi / 2),
    (0.0997, 0.0, -math.pi / 2),
    (0.0996, 0.0, 0.0),
)
"""Of each joint: d (m), a (m), alpha (rad)."""

FLANGE_T_GRIP = make_transform(np.eye(3), np.array([0.0, 0.0, 0.16]))
"""The tool: known and rigid, unlike the camera's mount."""

LIMIT_RAD = np.array([2.0 * math.pi, 2.0 * math.pi, math.pi, 2.0 * math.pi, 2.0 * math.pi, 2.0 * math.pi])
RATE_RAD_PER_S = np.full(6, math.pi)
HOME_RAD = np.radians([0.0, -90.0, -100.0, -80.0, 90.0, 0.0])
"""Elbow up, the gripper down."""

_DAMPING = 0.02
_REACHED = 1e-10


class Arm:
    """Pure functions of joint angles ``q`` (6,), rad."""

    def __init__(self) -> None:
        model = pin.Model()
        parent, placement = 0, pin.SE3.Identity()
        for number, (d_m, a_m, alpha_rad) in enumerate(DH):
            parent = model.addJoint(parent, pin.JointModelRZ(), placement, f"joint_{number + 1}")
            placement = pin.SE3(pin.utils.rotate("x", alpha_rad), np.array([a_m, 0.0, d_m]))
        tool = placement * pin.SE3(FLANGE_T_GRIP)
        self._frame = model.addFrame(pin.Frame("grip", parent, 0, tool, pin.FrameType.OP_FRAME))
        self._model, self._data = model, model.createData()

    def base_T_grip(self, q: Array) -> Array:
        """Forward kinematics, (4, 4)."""
        pin.framesForwardKinematics(self._model, self._data, q)
        pose: Array = self._data.oMf[self._frame].homogeneous.copy()
        return pose

    def jacobian(self, q: Array) -> Array:
        """(6, 6): the TCP's velocity (m/s), then its turning (rad/s), in gripper axes, for each joint's rate."""
        matrix: Array = pin.computeFrameJacobian(self._model, self._data, q, self._frame, pin.ReferenceFrame.LOCAL)
        return matrix.copy()

    def rates(self, q: Array, twist: Array) -> Array:
        """Joint rates (6,) for a twist of the gripper in its own axes, by damped least squares.

        Damping keeps the rates small near a singularity, where the twist is then not met.  Rates past a joint's are all
        scaled alike, so that the direction stays.
        """
        jacobian = self.jacobian(q)
        rates = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + _DAMPING**2 * np.eye(6), twist)
        return rates / max(1.0, float((np.abs(rates) / RATE_RAD_PER_S).max()))

    def moved(self, q: Array, rates: Array, time_s: float) -> tuple[Array, bool]:
        """Joint angles after a while, and whether a joint was stopped by its range."""
        free = q + rates * time_s
        stopped = np.clip(free, -LIMIT_RAD, LIMIT_RAD)
        return stopped, bool((stopped != free).any())

    def reach(self, base_T_grip: Array, q: Array) -> Array | None:
        """Joint angles for a pose, by Newton's steps from ``q``; None if it can't be reached from there."""
        for _ in range(200):
            error = twist_to(self.base_T_grip(q), base_T_grip)
            if float(np.abs(error).max()) < _REACHED:
                return q
            q, stopped = self.moved(q, self.rates(q, error), 1.0)
            if stopped:
                return None
        return None

    def dexterity(self, q: Array) -> float:
        """Smallest singular value of the Jacobian: 0 in a singularity."""
        return float(np.linalg.svd(self.jacobian(q), compute_uv=False)[-1])


def twist_to(a_T_from: Array, a_T_to: Array) -> Array:
    """The constant twist (6,) in axes of ``from``, velocity first, that takes one frame to the other in one second."""
    twist: Array = pin.log6(pin.SE3(a_T_from).actInv(pin.SE3(a_T_to))).vector
    return twist
