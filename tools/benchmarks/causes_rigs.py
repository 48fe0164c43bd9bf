"""What ``tools/bench causes`` looks at: a gripper before a camera with a lens, a pose, an opening and a background."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from benchmarks.drawn import Place, Rng, in_view, lenses, reference
from benchmarks.fingers import bevelled, gripper_models, gripper_of, wedge_fingers
from benchmarks.scenes import ordinary_look
from gripmon import simulate
from gripmon.model.camera import Camera, LensSettings, make_camera
from gripmon.model.geometry import exp_rotation
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array
from gripmon.simulate import Scenario, Simulator
from gripmon.simulate.scenario import JawScript, Light

WELL, AFTER = 24, 24
"""Frames before and after it."""

JAW_NOISE_M = 3e-5


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
        shown = simulate.Rig(camera, self.gripper, self.cam_T_grip if pose is None else pose)
        return shown.simulator(scenario, self.seed)

    @property
    def at_s(self) -> float:
        """When it goes wrong: between two frames."""
        return (WELL - 0.5) / self.scenario.fps


def draw_rig(rng: Rng, reported: bool) -> Rig:
    """Everything that is drawn before what goes wrong; ``reported``: the robot has to report the opening."""
    lens, models = list(lenses().values())[int(rng.integers(3))], [*gripper_models(), wedge_fingers()]
    model = models[int(rng.integers(4))]
    if model is not models[-1] and rng.random() < 0.5:
        model = bevelled(model, float(rng.uniform(0.0, 3e-4)))
    gripper, camera = gripper_of(model), make_camera(lens)
    cam_T_grip, opening_m = _placed(rng, camera, gripper)
    how = ("exact", "noisy", "unreported")[int(rng.integers(2 if reported else 3))]
    later_m = opening_m + (float(rng.uniform(-3e-3, 3e-3)) if rng.random() < 0.3 else 0.0)
    later_m = min(max(later_m, gripper.jaw_min_m + 1e-3), gripper.jaw_max_m - 1e-3)
    fps = float(rng.uniform(10.0, 22.0))
    background, fingers, sensor = ordinary_look(rng)
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
    start = reference(rng, cam_T_grip)
    sigma_m = 0.0 if how == "exact" else JAW_NOISE_M if how == "noisy" else 5e-5
    return Rig(camera.settings, gripper, cam_T_grip, start, scenario, sigma_m, int(rng.integers(2**31)))


def _placed(rng: Rng, camera: Camera, gripper: Gripper) -> tuple[Array, float]:
    """A pose and an opening at which all fingertips are in the image."""
    front = gripper.corner_points[gripper.points_grip_m(None)[gripper.corner_points, 2] > -0.02]

    def draw(rng: Rng) -> Place:
        turn = exp_rotation(np.deg2rad([rng.uniform(25.0, 40.0), rng.uniform(-5.0, 5.0), rng.uniform(-5.0, 5.0)]))
        tcp_m = np.array([rng.uniform(-4e-3, 4e-3), rng.uniform(-4e-3, 4e-3), rng.uniform(0.085, 0.13)])
        low, high = gripper.jaw_min_m + 2e-3, gripper.jaw_max_m - 2e-3
        opening_m = float(rng.uniform(max(low, gripper.jaw_nominal_m - 8e-3), min(high, gripper.jaw_nominal_m + 8e-3)))
        return Place(turn, tcp_m, opening_m, gripper.points_grip_m(opening_m)[front])

    return in_view(rng, camera, draw)
