"""A simulated wrist camera with exact truth: two solid fingers before moving clutter, sensor, disturbances."""

from gripmon.simulator.builtin import DEFAULT_FPS, SCENARIO_NAMES, make_scenario
from gripmon.simulator.export import write_sequence
from gripmon.simulator.scenario import Scenario
from gripmon.simulator.sequence import Simulator
from gripmon.simulator.truth import FrameTruth, Hidden

__all__ = [
    "DEFAULT_FPS",
    "SCENARIO_NAMES",
    "FrameTruth",
    "Hidden",
    "Scenario",
    "Simulator",
    "make_scenario",
    "write_sequence",
]
