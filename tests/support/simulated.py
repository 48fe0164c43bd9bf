"""Cameras, grippers and scenarios that the simulator's tests share; plain ones leave nothing but outlines."""

from __future__ import annotations

import functools
from pathlib import Path

import msgspec
import numpy as np
import yaml

from gripmon.daemon.config import read_gripper
from gripmon.model.camera import BrownConradyLens, LensSettings, PaperLens, make_camera
from gripmon.model.gripper import Gripper, GripperModel
from gripmon.simulate import Scenario, Simulator
from gripmon.simulate.scenario import Background, FingerLook, Sensor

BOX_FINGERS = Path(__file__).resolve().parents[2] / "configs" / "grippers" / "two_box_fingers.yaml"
PAPER_LENS = PaperLens(
    width_px=768, height_px=576, fx_px=962.0, fy_px=962.0, cx_px=383.5, cy_px=287.5, kappa_per_px2=1.9e-7
)
STRONG_LENS = BrownConradyLens(
    width_px=768,
    height_px=576,
    fx_px=760.0,
    fy_px=757.0,
    cx_px=380.2,
    cy_px=290.6,
    coefficients=(-0.32, 0.11, 0.0015, -0.001),
)
PLAIN_TABLE = Background(kind="plain", contrast=0.0, level_dn=180.0, boxes=0, cables=0, motion="still")
PLAIN_FINGERS = FingerLook(texture=0.0, carriers=False)
IDEAL_SENSOR = Sensor(read_noise_dn=0.0, shot_noise_dn=0.0, vignetting=0.0, exposure_time_s=0.0)


def plain_scenario(**settings: object) -> Scenario:
    """Even fingers before an even table, no noise; settings replace these."""
    sections = {"name": "plain", "background": PLAIN_TABLE, "fingers": PLAIN_FINGERS, "sensor": IDEAL_SENSOR}
    return Scenario(**{**sections, **settings})  # type: ignore[arg-type]


def nominal_cam_T_grip(
    tilt_deg: float = 32.0, tcp_m: tuple[float, float, float] = (0.0004, 0.0013, 0.115)
) -> np.ndarray:
    """Camera tilted about its x axis against the gripper, as in the paper."""
    c, s = np.cos(np.deg2rad(tilt_deg)), np.sin(np.deg2rad(tilt_deg))
    cam_T_grip = np.eye(4)
    cam_T_grip[:3, :3] = [[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]
    cam_T_grip[:3, 3] = tcp_m
    return cam_T_grip


@functools.lru_cache(maxsize=1)
def sharp_gripper() -> Gripper:
    """The box fingers without bevels."""
    model = yaml.safe_load(BOX_FINGERS.read_text())
    for edge in model["edges"].values():
        edge.pop("bevel_m", None)
    return Gripper(msgspec.convert(model, GripperModel))


def simulator(
    scenario: Scenario,
    *,
    lens: LensSettings = PAPER_LENS,
    seed: int = 1,
    sharp: bool = True,
    cam_T_grip: np.ndarray | None = None,
) -> Simulator:
    gripper = sharp_gripper() if sharp else read_gripper(BOX_FINGERS)
    return Simulator(
        make_camera(lens), gripper, nominal_cam_T_grip() if cam_T_grip is None else cam_T_grip, scenario, seed
    )
