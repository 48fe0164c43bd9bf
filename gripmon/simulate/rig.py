"""Where every simulated scene comes from: a rig, of camera, gripper and where they are, that a scenario happens to."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gripmon.model.camera import Camera, LensSettings, PaperLens, make_camera
from gripmon.model.geometry import make_transform
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array
from gripmon.simulate.render import Backdrop
from gripmon.simulate.scenario import Scenario
from gripmon.simulate.sequence import Simulator

PAPER_LENS = PaperLens(
    width_px=768, height_px=576, fx_px=962.0, fy_px=962.0, cx_px=383.5, cy_px=287.5, kappa_per_px2=1.9e-7
)
"""That of the self-viewing paper, and of what was measured with others."""


def paper_cam_T_grip(tilt_deg: float = 32.0, tcp_m: tuple[float, float, float] = (0.0004, 0.0013, 0.115)) -> Array:
    """Pose (4, 4) of a gripper tilted about the camera's x axis, as in the paper."""
    c, s = math.cos(math.radians(tilt_deg)), math.sin(math.radians(tilt_deg))
    return make_transform(np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]), np.array(tcp_m))


@dataclass(frozen=True)
class Rig:
    """A wrist camera, its gripper, and ``cam_T_grip`` (4, 4) before any disturbance."""

    camera: Camera
    gripper: Gripper
    cam_T_grip: Array

    @property
    def jaw_opening_m(self) -> float:
        """Nearly fully open, so that the fingers are near the image's borders and leave a plate visible; nominal for
        a gripper without a jaw.
        """
        low, high = self.gripper.jaw_min_m, self.gripper.jaw_max_m
        return low + 5.0 / 6.0 * (high - low) if self.gripper.has_jaw else self.gripper.jaw_nominal_m

    def simulator(self, scenario: Scenario, seed: int = 0, backdrop: Backdrop | None = None) -> Simulator:
        """The frames of a scenario and their truth.  ``backdrop`` replaces the scenario's table.  ValueError if the
        scenario doesn't fit the gripper, or the gripper has no closed convex fingers.
        """
        return Simulator(self.camera, self.gripper, self.cam_T_grip, scenario, seed, backdrop)


def paper_rig(gripper: Gripper, cam_T_grip: Array | None = None, lens: LensSettings = PAPER_LENS) -> Rig:
    """A gripper before the paper's camera, at :func:`paper_cam_T_grip` if no pose is given."""
    return Rig(make_camera(lens), gripper, paper_cam_T_grip() if cam_T_grip is None else cam_T_grip)
