"""Fingertip meters, poses and rendered pictures that the tests of corners, search and monitor share."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from gripmon.daemon.config import read_gripper
from gripmon.model.camera import Camera, FisheyeLens, LensSettings, make_camera
from gripmon.model.gripper import Gripper
from gripmon.model.records import Image
from gripmon.simulate import Scenario, Simulator, paper_rig
from gripmon.track.edges import FingertipMeter, Measurement, MeasurementSettings, Patience
from support.simulated import BOX_FINGERS, PAPER_LENS, nominal_cam_T_grip, sharp_gripper

FISHEYE_LENS = FisheyeLens(
    width_px=768,
    height_px=576,
    fx_px=640.0,
    fy_px=640.0,
    cx_px=380.0,
    cy_px=290.0,
    coefficients=(0.03, -0.02, 0.004, 0.0),
)
WIDE_LENS = FisheyeLens(width_px=640, height_px=540, fx_px=230.0, fy_px=230.0, cx_px=320.0, cy_px=270.0)
"""Its image reaches beyond the 89 degrees at which the model ends."""
NARROW = Patience(when_doubtful=False, when_lost=False)
EVERYWHERE = Patience(when_doubtful=True, when_lost=True)
USUAL_SHARE = 0.9
JAW_SIGMA_M = 5e-5


def moved(pose: np.ndarray, xi: np.ndarray) -> np.ndarray:
    """A pose whose TCP has moved by ``xi[:3]`` and that has turned about it by ``xi[3:]``, by SciPy."""
    out = np.array(pose)
    out[:3, :3] = Rotation.from_rotvec(xi[3:]).as_matrix() @ pose[:3, :3]
    out[:3, 3] += xi[:3]
    return out


def difference(from_T: np.ndarray, to_T: np.ndarray) -> np.ndarray:
    """The ``xi`` (6,) that ``moved`` takes from one pose to the other."""
    turn = Rotation.from_matrix(to_T[:3, :3] @ from_T[:3, :3].T).as_rotvec()
    return np.concatenate([to_T[:3, 3] - from_T[:3, 3], turn])


@lru_cache(maxsize=8)
def box_gripper(sharp: bool = True) -> Gripper:
    return sharp_gripper() if sharp else read_gripper(BOX_FINGERS)


def meter(
    gripper: Gripper | None = None,
    lens: LensSettings = PAPER_LENS,
    settings: MeasurementSettings | None = None,
) -> FingertipMeter:
    return FingertipMeter(make_camera(lens), gripper or box_gripper(), settings or MeasurementSettings(), JAW_SIGMA_M)


def measure(
    image: Image,
    cam_T_grip: np.ndarray | None = None,
    *,
    using: FingertipMeter | None = None,
    jaw_opening_m: float = 0.034,
    patience: Patience = NARROW,
) -> Measurement:
    """A measurement about an expected pose, the nominal one if None; by a new meter if none is given."""
    pose = nominal_cam_T_grip() if cam_T_grip is None else cam_T_grip
    return (using or meter()).measure(image, pose, jaw_opening_m, USUAL_SHARE, patience)


@lru_cache(maxsize=64)
def picture(scenario: Scenario, index: int = 0, seed: int = 1, lens: LensSettings = PAPER_LENS) -> np.ndarray:
    """A rendered image that no one may change, of the sharp box fingers at the nominal pose."""
    image = simulated(scenario, seed, lens).render(index)
    image.flags.writeable = False
    return image


@lru_cache(maxsize=4)
def simulated(scenario: Scenario, seed: int = 1, lens: LensSettings = PAPER_LENS) -> Simulator:
    return paper_rig(box_gripper(), lens=lens).simulator(scenario, seed)


def corners_px(camera: Camera, gripper: Gripper, cam_T_grip: np.ndarray) -> np.ndarray:
    points = gripper.points_grip_m(0.034)[gripper.corner_points]
    return camera.project(points @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3])
