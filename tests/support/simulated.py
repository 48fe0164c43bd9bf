"""Cameras, grippers and scenarios that the simulator's tests share; plain ones leave nothing but outlines."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from gripmon.daemon.config import read_gripper
from gripmon.model.camera import BrownConradyLens, LensSettings
from gripmon.model.gripper import Gripper
from gripmon.simulate import PAPER_LENS, Scenario, Simulator, paper_cam_T_grip, paper_rig
from gripmon.simulate.scenario import Background, FingerLook, Sensor
from support.grippers import gripper_from_dict

BOX_FINGERS = Path(__file__).resolve().parents[2] / "configs" / "grippers" / "two_box_fingers.yaml"
STRONG_LENS = BrownConradyLens(
    width_px=768,
    height_px=576,
    fx_px=760.0,
    fy_px=757.0,
    cx_px=380.2,
    cy_px=290.6,
    coefficients=(-0.32, 0.11, 0.0015, -0.001),
)
nominal_cam_T_grip = paper_cam_T_grip
PLAIN_TABLE = Background(kind="plain", contrast=0.0, level_dn=180.0, boxes=0, cables=0, motion="still")
PLAIN_FINGERS = FingerLook(texture=0.0, carriers=False)
IDEAL_SENSOR = Sensor(read_noise_dn=0.0, shot_noise_dn=0.0, vignetting=0.0, exposure_time_s=0.0)


def plain_scenario(**settings: object) -> Scenario:
    """Even fingers before an even table, no noise; settings replace these."""
    sections = {"name": "plain", "background": PLAIN_TABLE, "fingers": PLAIN_FINGERS, "sensor": IDEAL_SENSOR}
    return Scenario(**{**sections, **settings})  # type: ignore[arg-type]


def box_model(bevel_m: float = 0.0) -> dict[str, Any]:
    """The file of the box fingers as values, with a bevel of that width on every edge."""
    model: dict[str, Any] = yaml.safe_load(BOX_FINGERS.read_text())
    for edge in model["edges"].values():
        edge["bevel_m"] = bevel_m
    return model


@functools.lru_cache(maxsize=8)
def bevelled(width_m: float) -> Gripper:
    """The box fingers, every edge cut off by a bevel."""
    return gripper_from_dict(box_model(width_m))


def sharp_gripper() -> Gripper:
    """The box fingers without bevels."""
    return bevelled(0.0)


def simulator(
    scenario: Scenario,
    *,
    lens: LensSettings = PAPER_LENS,
    seed: int = 1,
    sharp: bool = True,
    cam_T_grip: np.ndarray | None = None,
) -> Simulator:
    gripper = sharp_gripper() if sharp else read_gripper(BOX_FINGERS)
    return paper_rig(gripper, cam_T_grip, lens).simulator(scenario, seed)
