"""A simulated wrist camera with exact truth: two solid fingers in front of moving clutter, sensor, disturbances."""

from gripmon.simulate.bodies import FrameTruth, Hidden
from gripmon.simulate.builtin import DEFAULT_FPS, SCENARIO_NAMES, make_scenario
from gripmon.simulate.calibration_images import KINDS as CALIBRATION_KINDS
from gripmon.simulate.calibration_images import image_count, write_calibration_images
from gripmon.simulate.scenario import Scenario
from gripmon.simulate.sequence import PAPER_LENS, Rig, Simulator, paper_cam_T_grip, paper_rig, write_sequence

__all__ = [
    "CALIBRATION_KINDS",
    "DEFAULT_FPS",
    "PAPER_LENS",
    "SCENARIO_NAMES",
    "FrameTruth",
    "Hidden",
    "Rig",
    "Scenario",
    "Simulator",
    "image_count",
    "make_scenario",
    "paper_cam_T_grip",
    "paper_rig",
    "write_calibration_images",
    "write_sequence",
]
