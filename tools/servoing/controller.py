"""Position-based visual servo: the error is a pose, ``grip_T_object``; the gripper's twist is proportional to it."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from gripmon.client import Reading
from gripmon.model.geometry import from_record, invert, make_transform
from gripmon.model.records import Array, Transform, Verdict
from servoing.arm import Arm, twist_to
from servoing.rules import Action, Limits, action_for, may_grasp
from servoing.stage import APPROACH_S, BEGIN_S, standoff_m

GAIN_PER_S = 3.0
FASTEST_M_PER_S, FASTEST_RAD_PER_S = 0.1, 0.5
COMMAND_LIFE_S = 0.1
"""A command that isn't renewed for so long stops the arm: a frame or a message may be missing."""

SETTLED_S, SETTLED_M, SETTLED_RAD = 0.5, 2e-5, 1e-3
"""The fingers close when the error as the controller sees it, averaged over so long, is below this."""


@dataclass(frozen=True)
class Given:
    """What a controller receives with a frame: ``cam_T_grip`` (4, 4) or None, its uncertainty, and its reference."""

    cam_T_grip: Array | None
    verdict: Verdict
    sigma_m: float | None
    age_s: float = 0.0
    reference: tuple[str, int] = ("", 0)


def given_by(reading: Reading, age_s: float, *, smoothed: bool) -> Given:
    """What the monitor's client has read, as the controller takes it; what the client refuses is unknown.

    Without an average, the frame's own transform is used.
    """
    average = reading.smoothed if smoothed else None
    pose = reading.transform if average is None else Transform(average.translation_m, average.rotation_xyzw)
    covariance = reading.covariance if average is None else average.covariance
    reference = (reading.reference_id, reading.revision)
    if not reading.usable or pose is None or covariance is None:
        return Given(None, Verdict.UNKNOWN, None, age_s, reference)
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(np.reshape(covariance, (6, 6))[:3, :3])[-1]))
    return Given(from_record(pose), reading.verdict, sigma_m, age_s, reference)


class Servo:
    """One arm, its controller, and where its joints are."""

    def __init__(self, arm: Arm, q: Array, fps: float, limits: Limits | None = None) -> None:
        self.q, self.action, self.grasped = q, Action.STOP, False
        self.stopped_by_range = False
        self._arm, self._limits = arm, limits or Limits()
        self._rates = np.zeros(6)
        self._progress_s = 0.0
        self._base_T_object: Array | None = None
        self._reference: tuple[str, int] | None = None
        self._errors: deque[Array] = deque(maxlen=max(round(SETTLED_S * fps), 2))

    def advance(self, time_s: float) -> None:
        """Joints turn on by the last command, until the next frame or until the command is too old."""
        self.q, stopped = self._arm.moved(self.q, self._rates, min(time_s, COMMAND_LIFE_S))
        self.stopped_by_range |= stopped

    def decide(self, now_s: float, step_s: float, given: Given, cam_T_object: Array | None) -> None:
        """The command until the next frame.

        ``cam_T_object`` is seen in the same image as the fingertips.  Where it isn't, the arm goes on to where it was
        seen last, since the object doesn't move and the arm knows its own motion.
        """
        self._rates = np.zeros(6)
        moving, self.action = self.action is not Action.STOP, Action.STOP
        if self.grasped or now_s < BEGIN_S:
            return
        self.action = action_for(
            given.verdict, age_s=given.age_s, sigma_m=given.sigma_m, moving=moving, limits=self._limits
        )
        if given.reference != self._reference:
            # What was seen by the transforms of another reference is not carried over into those of this one.
            self._reference, self._base_T_object = given.reference, None
            self._errors.clear()
        if self.action is not Action.STOP and given.cam_T_grip is not None and cam_T_object is not None:
            self._base_T_object = self._arm.base_T_grip(self.q) @ invert(given.cam_T_grip) @ cam_T_object
        if self._base_T_object is None:
            self.action = Action.STOP
        if self.action is Action.STOP:
            self._errors.clear()
            return
        speed = self._limits.speed(self.action)
        self._progress_s = min(self._progress_s + speed * min(step_s, COMMAND_LIFE_S), APPROACH_S)
        error = self._error()
        self._settle(error, given.verdict)
        if not self.grasped:
            self._rates = self._arm.rates(self.q, speed * _limited(GAIN_PER_S * error))

    def _error(self) -> Array:
        """Twist (6,) in one second from the gripper to where the approach wants it now."""
        assert self._base_T_object is not None
        before_T = make_transform(np.eye(3), np.array([0.0, 0.0, -standoff_m(self._progress_s)]))
        return twist_to(self._arm.base_T_grip(self.q), self._base_T_object @ before_T)

    def _settle(self, error: Array, verdict: Verdict) -> None:
        """Close the fingers if everything has been right for long enough."""
        if self._progress_s < APPROACH_S or not may_grasp(verdict, self.action):
            self._errors.clear()
            return
        self._errors.append(error)
        if len(self._errors) == self._errors.maxlen:
            mean = np.mean(self._errors, axis=0)
            self.grasped = bool(np.linalg.norm(mean[:3]) < SETTLED_M and np.linalg.norm(mean[3:]) < SETTLED_RAD)


def _limited(twist: Array) -> Array:
    """The twist within the arm's speeds, its direction kept."""
    linear, angular = float(np.linalg.norm(twist[:3])), float(np.linalg.norm(twist[3:]))
    return twist / max(1.0, linear / FASTEST_M_PER_S, angular / FASTEST_RAD_PER_S)
