"""A simulated wrist camera with exact truth: two solid fingers before moving clutter, sensor, disturbances."""

from gripmon.simulate.builtin import DEFAULT_FPS, SCENARIO_NAMES, make_scenario
from gripmon.simulate.export import write_sequence
from gripmon.simulate.scenario import Scenario
from gripmon.simulate.sequence import Simulator
from gripmon.simulate.truth import FrameTruth, Hidden

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
