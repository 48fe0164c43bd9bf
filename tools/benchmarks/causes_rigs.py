"""What ``tools/bench causes`` looks at: a gripper before a camera with a lens, a pose, an opening and a background."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from benchmarks.jumps import rigs
from benchmarks.scenes import _look, bevelled, gripper_models
from gripmon.model.camera import LensSettings, make_camera
from gripmon.model.geometry import exp_rotation, make_transform, perturb
from gripmon.model.gripper import Gripper, GripperModel
from gripmon.model.records import Array
from gripmon.simulate import Scenario, Simulator
from gripmon.simulate.scenario import JawScript, Light

WELL, AFTER = 24, 24
"""Frames before and after it."""

START_SIGMA = np.array([1e-4] * 3 + [1e-3] * 3)
"""By how much the reference is wrong, per axis, m and rad; the monitor knows this."""

JAW_NOISE_M = 3e-5
_BORDER_PX = 14.0
Rng = np.random.Generator


@dataclass(frozen=True)
class Rig:
    """What is watched: the reference is ``start_cam_T_grip``; ``jaw_sigma_m``: the setting for the opening."""

    camera_settings: LensSettings
    gripper: Gripper
    cam_T_grip: Array
    start_cam_T_grip: Array
    scenario: Scenario
    jaw_sigma_m: float
    seed: int

    def simulator(self, lens: LensSettings | None = None, pose: Array | None = None, **changes: Any) -> Simulator:
        """The same scene with changes."""
        scenario = msgspec.structs.replace(self.scenario, **changes)
        camera = make_camera(lens or self.camera_settings)
        return Simulator(camera, self.gripper, self.cam_T_grip if pose is None else pose, scenario, self.seed)

    @property
    def at_s(self) -> float:
        """When it goes wrong: between two frames."""
        return (WELL - 0.5) / self.scenario.fps


def draw_rig(rng: Rng, reported: bool) -> Rig:
    """Everything that is drawn before what goes wrong; ``reported``: the robot has to report the opening."""
    lens = _lenses()[int(rng.integers(3))]
    model = [*gripper_models(), rigs()["wedges"].gripper.model][int(rng.integers(4))]
    if isinstance(model, dict):
        model = bevelled(model, float(rng.uniform(0.0, 3e-4))) if rng.random() < 0.5 else model
        model = msgspec.convert(model, GripperModel)
    gripper, camera = Gripper(model), make_camera(lens)
    cam_T_grip, opening_m = _placed(rng, lens, gripper)
    how = ("exact", "noisy", "unreported")[int(rng.integers(2 if reported else 3))]
    later_m = opening_m + (float(rng.uniform(-3e-3, 3e-3)) if rng.random() < 0.3 else 0.0)
    later_m = min(max(later_m, gripper.jaw_min_m + 1e-3), gripper.jaw_max_m - 1e-3)
    fps = float(rng.uniform(10.0, 22.0))
    background, fingers, sensor = _look(rng)
    motion = ("still", "wander", "linear", "stop_and_go")[int(rng.integers(4))]
    plain = rng.random() < 0.15
    background = msgspec.structs.replace(
        background, motion=motion, **({"kind": "plain", "boxes": 0, "cables": 0} if plain else {})
    )
    sensor = msgspec.structs.replace(sensor, read_noise_dn=float(rng.uniform(0.5, 2.5)))
    jaw = JawScript(
        knots=((0.0, opening_m), ((WELL + AFTER) / fps, later_m)),
        reported=how != "unreported",
        reported_noise_m=JAW_NOISE_M if how == "noisy" else 0.0,
    )
    scenario = Scenario(
        name="causes",
        fps=fps,
        duration_s=(WELL + AFTER) / fps,
        background=background,
        fingers=fingers,
        sensor=sensor,
        jaw=jaw,
        light=Light(flicker=float(rng.uniform(0.0, 0.05))),
    )
    start = perturb(cam_T_grip, rng.normal(0.0, START_SIGMA))
    sigma_m = 0.0 if how == "exact" else JAW_NOISE_M if how == "noisy" else 5e-5
    return Rig(camera.settings, gripper, cam_T_grip, start, scenario, sigma_m, int(rng.integers(2**31)))


def _lenses() -> tuple[LensSettings, ...]:
    return tuple(rig.lens for rig in rigs().values())


def _placed(rng: Rng, lens: LensSettings, gripper: Gripper) -> tuple[Array, float]:
    """A pose and an opening at which all fingertips are in the image."""
    camera = make_camera(lens)
    points = gripper.points_grip_m(None)
    for _ in range(5000):
        turn = exp_rotation(np.deg2rad([rng.uniform(25.0, 40.0), rng.uniform(-5.0, 5.0), rng.uniform(-5.0, 5.0)]))
        tcp_m = np.array([rng.uniform(-4e-3, 4e-3), rng.uniform(-4e-3, 4e-3), rng.uniform(0.085, 0.13)])
        low, high = gripper.jaw_min_m + 2e-3, gripper.jaw_max_m - 2e-3
        opening_m = float(rng.uniform(max(low, gripper.jaw_nominal_m - 8e-3), min(high, gripper.jaw_nominal_m + 8e-3)))
        front = gripper.corner_points[points[gripper.corner_points, 2] > -0.02]
        uv = camera.project(gripper.points_grip_m(opening_m)[front] @ turn.T + tcp_m)
        limit = np.array([camera.width_px, camera.height_px]) - 1.0 - _BORDER_PX
        if (uv > _BORDER_PX).all() and (uv < limit).all():
            return make_transform(turn, tcp_m), opening_m
    raise ValueError(f"gripper {gripper.name} does not fit into the image")
