"""Where everything is at a time: a closed function of scenario, seed and time, without images."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from gripmon.model.camera import Camera
from gripmon.model.geometry import exp_rotation, make_transform
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array
from gripmon.simulate import disturbance
from gripmon.simulate.scenario import BentFinger, MountMotion, Scenario

_TIP_SHARE = 0.1  # fraction of a finger's length that counts as its tip, and as its root
_SCATTER_RAD, _SCATTER_M = math.radians(1.0), 2e-3  # of the calibrations of pairs, standard deviation of each axis


@dataclass(frozen=True, slots=True)
class SceneState:
    """All poses at one time.  ``grip_T_finger`` (f, 4, 4) maps a finger's points at nominal opening to where they are,
    with jaws and bends; ``bend`` (f, 4, 4) has the bends only.  ``covers``: index in the scenario, pose; ``props``
    likewise, with poses in the gripper frame.
    """

    time_s: float
    cam_T_grip: Array
    reference_cam_T_grip: Array
    jaw_opening_m: float
    grip_T_finger: Array
    bend: Array
    points_grip_m: Array
    cam_T_object: Array | None
    covers: tuple[tuple[int, Array], ...]
    props: tuple[tuple[int, Array], ...] = ()


class Scene:
    """Evaluates a scenario.  Raises ValueError if it doesn't fit gripper or calibration."""

    def __init__(
        self, camera: Camera, gripper: Gripper, nominal_cam_T_grip: Array, scenario: Scenario, seed: int
    ) -> None:
        self._gripper, self._nominal, self._scenario, self._seed = gripper, nominal_cam_T_grip, scenario, seed
        if not nominal_cam_T_grip[2, 3] > 0.0:
            raise ValueError("cam_T_grip: the TCP lies behind the camera; translation z > 0")
        self._pivot_m = np.array(scenario.pivot_cam_m)
        self._full = tuple(disturbance.full_motion(s, self._pivot_m, nominal_cam_T_grip[:3, 3]) for s in scenario.mount)
        self._bends = tuple(self._prepare_bend(b) for b in scenario.bent_fingers)
        self._nominal_points_m = gripper.points_grip_m(None)
        self.view_half = view_half(camera)
        self._check_jaw()

    def at(self, time_s: float) -> SceneState:
        """The state at a time since the first frame."""
        scenario = self._scenario
        reference, cam_T_grip = self._poses(time_s)
        opening = disturbance.jaw_opening_m(scenario.jaw, self._gripper.jaw_nominal_m, time_s)
        moved = self._gripper.points_grip_m(opening) - self._nominal_points_m
        grip_T_finger = np.tile(np.eye(4), (len(self._gripper.finger_ids), 1, 1))
        bend = grip_T_finger.copy()
        for finger in range(len(grip_T_finger)):
            own = self._gripper.point_finger == finger
            grip_T_finger[finger, :3, 3] = moved[own][0]
        for script, (finger, turn, root) in zip(scenario.bent_fingers, self._bends, strict=True):
            factor = disturbance.smooth_step(time_s, script.start_s, script.time_s)
            bend[finger] = disturbance.about_pivot(factor * turn, np.zeros(3), root) @ bend[finger]
        grip_T_finger = grip_T_finger @ bend
        of_point = grip_T_finger[self._gripper.point_finger]
        points = np.einsum("pij,pj->pi", of_point[:, :3, :3], self._nominal_points_m) + of_point[:, :3, 3]
        return SceneState(
            time_s,
            cam_T_grip,
            reference,
            opening,
            grip_T_finger,
            bend,
            points,
            self._object(cam_T_grip, time_s),
            self._covers(time_s),
            self._props(time_s),
        )

    def events(self, time_s: float) -> tuple[str, ...]:
        """Labels of what happens at a time, in the order of the scenario's sections."""
        scenario = self._scenario
        labels = [label for script in scenario.mount for label in disturbance.law_events(script, time_s)]
        labels += [f"bent:{b.finger}" for b in scenario.bent_fingers if time_s > b.start_s]
        if scenario.pairs is not None:
            labels.append("after" if self._pair_frame(time_s) % 2 else "before")
        knots = scenario.jaw.knots
        if any(t0 < time_s < t1 and a != b for (t0, a), (t1, b) in itertools.pairwise(knots)):
            labels.append("jaw_moves")
        if scenario.grasped is not None and scenario.grasped.arrive_s[0] < time_s < scenario.grasped.leave_s[1]:
            held = scenario.grasped.arrive_s[1] <= time_s <= scenario.grasped.leave_s[0]
            labels.append("object_between" if held else "object_moves")
        labels += ["prop" for p in scenario.props if p.start_s <= time_s < p.end_s]
        labels += [c.kind for c in scenario.covers if disturbance.pulse(time_s, c.start_s, c.end_s, c.move_s) > 0.0]
        labels += ["light_step" for s in scenario.light.steps if 0.0 <= time_s - s.at_s < 1.0]
        labels += ["shadow" for s in scenario.light.shadows if s.start_s < time_s < s.end_s]
        if disturbance.defocus_sigma_px(scenario.defocus, time_s) > 0.0:
            labels.append("defocus")
        return tuple(labels)

    def _poses(self, time_s: float) -> tuple[Array, Array]:
        """Reference calibration and true pose."""
        if self._scenario.pairs is None:
            reference = self._nominal
        else:
            reference, motion = self._pair(self._pair_frame(time_s))
            if motion is not None:
                return reference, motion @ reference
        return reference, disturbance.mount_motion(self._scenario.mount, self._full, self._pivot_m, time_s) @ reference

    def _pair_frame(self, time_s: float) -> int:
        return math.floor(time_s * self._scenario.fps + 0.5)

    def _pair(self, frame: int) -> tuple[Array, Array | None]:
        """Calibration of a pair, and the disturbance's motion if the frame is the second."""
        pairs = self._scenario.pairs
        assert pairs is not None
        rng = np.random.default_rng([self._seed, 2, frame // 2])
        shift = np.array(pairs.tcp_shift_m) + rng.normal(0.0, pairs.tcp_shift_sigma_m, 2)
        turn = exp_rotation(rng.normal(0.0, _SCATTER_RAD, 3))
        reference = make_transform(
            turn @ self._nominal[:3, :3], self._nominal[:3, 3] + rng.normal(0.0, _SCATTER_M, 3)
        )
        if frame % 2 == 0:
            return reference, None
        motion = MountMotion(tcp_shift_m=(float(shift[0]), float(shift[1])))
        rotation, translation = disturbance.full_motion(motion, self._pivot_m, reference[:3, 3])
        return reference, disturbance.about_pivot(rotation, translation, self._pivot_m)

    def _prepare_bend(self, script: BentFinger) -> tuple[int, Array, Array]:
        """Finger index, rotation vector about its root that shifts its tip sideways, and root; gripper frame."""
        if script.finger not in self._gripper.finger_ids:
            raise ValueError(
                f"bent_fingers: there is no finger '{script.finger}'; one of {', '.join(self._gripper.finger_ids)}"
            )
        finger = self._gripper.finger_ids.index(script.finger)
        points = self._gripper.points_grip_m(None)[self._gripper.point_finger == finger]
        z = points[:, 2]
        reach = _TIP_SHARE * (z.max() - z.min())
        tip, root = points[z >= z.max() - reach].mean(axis=0), points[z <= z.min() + reach].mean(axis=0)
        lever, shift = tip - root, np.array(script.tip_shift_m)
        turned = lever + shift - lever * float(lever @ shift) / float(lever @ lever)
        axis = np.cross(lever, turned)
        sine = float(np.linalg.norm(axis))
        turn = axis * (math.atan2(sine, float(lever @ turned)) / sine) if sine > 0.0 else np.zeros(3)
        return finger, turn, root

    def _object(self, cam_T_grip: Array, time_s: float) -> Array | None:
        """Pose of the object's frame (its centre); None if the scenario has none, or while it is away."""
        grasped = self._scenario.grasped
        if grasped is None or not grasped.arrive_s[0] < time_s < grasped.leave_s[1]:
            return None
        away = disturbance.object_distance_m(grasped, time_s)
        centre = np.array([0.0, grasped.side_m, grasped.depth_m - 0.5 * grasped.size_m[2] + away])
        return cam_T_grip @ make_transform(np.eye(3), centre)

    def _covers(self, time_s: float) -> tuple[tuple[int, Array], ...]:
        """Covers in view with the poses of their frames: x points to where they come from, the leading side is -x."""
        out = []
        for index, cover in enumerate(self._scenario.covers):
            share = disturbance.pulse(time_s, cover.start_s, cover.end_s, cover.move_s)  # how far it has moved in
            if share > 0.0:
                turn = {"right": 0.0, "bottom": 0.5, "left": 1.0, "top": 1.5}[cover.side] * math.pi
                c, s = round(math.cos(turn)), round(math.sin(turn))
                rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
                reach = COVER_TRAVEL * float(np.max(self.view_half[1])) * cover.distance_m
                start = np.array([*self.view_half[0], 1.0]) * cover.distance_m
                offset = rotation @ np.array([0.26 * reach - share * cover.reach * reach, 0.0, 0.0])
                out.append((index, make_transform(rotation, start + offset)))
        return tuple(out)

    def _props(self, time_s: float) -> tuple[tuple[int, Array], ...]:
        """Props that are present, with their poses in the gripper frame."""
        out = []
        for index, prop in enumerate(self._scenario.props):
            offset_m = disturbance.prop_offset_m(prop, time_s)
            if offset_m is not None:
                turn = exp_rotation(np.radians(prop.turn_deg))
                out.append((index, make_transform(turn, np.array(prop.centre_m) + offset_m)))
        return tuple(out)

    def _check_jaw(self) -> None:
        low, high = self._gripper.jaw_min_m, self._gripper.jaw_max_m
        knots = self._scenario.jaw.knots
        if knots and not self._gripper.has_jaw:
            raise ValueError("jaw.knots: the gripper has no jaw; no knots")
        if any(t1 <= t0 for (t0, _), (t1, _) in itertools.pairwise(knots)):
            raise ValueError("jaw.knots: times don't ascend; rows sorted by time")
        for _, opening in knots:
            if not low <= opening <= high:
                raise ValueError(f"jaw.knots: opening {opening} m is outside the gripper's jaw, {low} to {high} m")


# Travel of a cover's leading side in half views, from outside the view to far beyond it.
COVER_TRAVEL = 4.2


def view_half(camera: Camera) -> tuple[Array, Array]:
    """Centre (2,) and half extents (2,) of the field of view in ideal coordinates."""
    u, v = np.meshgrid(np.linspace(0, camera.width_px - 1, 9), np.linspace(0, camera.height_px - 1, 9))
    xy = camera.undistort(np.stack([u.ravel(), v.ravel()], axis=1))
    xy = xy[np.isfinite(xy).all(axis=1)]
    low, high = xy.min(axis=0), xy.max(axis=0)
    return 0.5 * (low + high), 0.5 * (high - low)
