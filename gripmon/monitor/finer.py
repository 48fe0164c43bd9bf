"""The gripper's look as a measurement: it refines what the edges show, and says when the gripper looks different."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.gripper import Gripper
from gripmon.model.poses import perturbation_between
from gripmon.model.records import Alert, AlertKind, Array, Cause, Frame, Image, Severity
from gripmon.monitor.refits import reaching
from gripmon.monitor.standing import Standing
from gripmon.track.look import GripperLook, LookAlignment, LookFusion, LookMotion, another_background

DIFFERENT = 0.5
"""Share of a finger's blocks that look otherwise than at first, from which it looks different: grasps hide a half."""

DIFFERENT_S = 300.0
"""For how long it does, or the look contradicts the edges, until that is told and the look learnt again, s: robots hold
what they grasp for seconds or a minute.
"""


class FinerLook:
    """Refines one monitor's poses.  ``look`` tells one background from another; ``floor`` (6, 6): the systematic part
    of the edges' covariance.
    """

    def __init__(self, camera: Camera, gripper: Gripper, look: GripperLook, floor: Array):
        self._names, self._has_jaw = gripper.finger_ids, gripper.has_jaw
        self._look, self._floor = look, floor
        self._alignment = LookAlignment(camera, gripper)
        self._fusion = LookFusion(float(np.linalg.norm(gripper.points_grip_m(None), axis=1).mean()))
        self._pending: tuple[Image, Array, float | None, float, LookMotion | None] | None = None
        self._behind: NDArray[np.float32] | None = None
        self._since_s = np.full(len(self._names) + 1, np.inf)  # each finger, and all of it
        self._due: list[Alert] = []

    def refine(self, frame: Frame, standing: Standing, now_s: float) -> Standing:
        """The same with the pose as edges and look have it together, and bounds that are by as much wider as that is
        from the edges'; unchanged where the look has nothing to say, or contradicts them.
        """
        self._pending = None
        if not standing.believed or frame.image is None:
            return standing
        refined, (opening_m, sigma_m) = None, self._opening(frame, standing)
        motion = self._alignment.measure(frame.image, standing.cam_T_grip, opening_m, sigma_m)
        if motion is not None:
            of_background = standing.covariance - self._floor
            refined = self._fusion.fuse(standing.cam_T_grip, of_background, motion)
        pose = standing.cam_T_grip if refined is None else refined[0]
        # A copy: learning can wait, and the caller may read the next image into the same memory.
        self._pending = frame.image.copy(), pose, opening_m, now_s, motion
        if refined is None:
            return standing
        away = perturbation_between(standing.cam_T_grip, pose)
        wider = reaching(standing.protection, away, standing.protection.hypothesis)
        return replace(standing, cam_T_grip=pose, protection=wider, of_change=refined[1] + self._floor)

    def learn(self) -> None:
        """Learn from the newest frame if its background is a new one."""
        pending, self._pending = self._pending, None
        if pending is None:
            return
        image, cam_T_grip, opening_m, now_s, motion = pending
        behind = self._look.behind(image, cam_T_grip, opening_m)
        before, self._behind = self._behind, behind
        if before is not None and len(before) == len(behind) and not another_background(behind, before):
            self._behind = before
            return
        if motion is not None:
            self._fusion.learn()
        self._alignment.learn(image, cam_T_grip, opening_m)
        self._tell(self._alignment.renewed > DIFFERENT, now_s)

    def _opening(self, frame: Frame, standing: Standing) -> tuple[float | None, float]:
        """The jaw's opening with its standard deviation, m: as earlier frames showed it, which errs alike in all."""
        measurement = standing.measurement
        if not self._has_jaw:
            return None, 0.0
        if frame.jaw_opening_m is None:
            return measurement.jaw_opening_m, math.sqrt(measurement.covariance[6, 6])
        return measurement.jaw_known_m, measurement.jaw_known_sigma_m

    def told(self) -> list[Alert]:
        """What there is to tell since the last call."""
        due, self._due = self._due, []
        return due

    def _tell(self, different: NDArray[np.bool_], now_s: float) -> None:
        """Fingers (f,) that look different, and a look that contradicts the edges, once they have for long enough."""
        self._since_s = np.where(
            np.append(different, self._fusion.contradicts), np.minimum(self._since_s, now_s), np.inf
        )
        long = now_s - self._since_s >= DIFFERENT_S
        if not long.any():
            return
        names = [f"finger {name}" for name, now in zip(self._names, long[:-1].tolist(), strict=True) if now]
        text = f"the gripper looks different: {', '.join(names)}, for {now_s - self._since_s[long].min():.0f} s"
        if long[-1]:
            text = "the gripper's look contradicts its edges, which count alone while it is learnt again"
            self._alignment.forget()
            self._fusion.forget()
        self._due.append(Alert(AlertKind.GRIPPER, Cause.UNKNOWN, Severity.WARNING, text))
        self._alignment.renew()
        self._since_s[:] = np.inf
