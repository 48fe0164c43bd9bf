"""Has the camera moved?  A sequential test on the drift with a stated rate of false alarms, and what kind of motion it
was."""

from gripmon.drift.baseline import Baseline
from gripmon.drift.foresight import CORRELATION_FRAMES, Foresight, foresee
from gripmon.drift.motion import MotionWatch
from gripmon.drift.sequential import Finding, SequentialTest
from gripmon.drift.settings import DriftSettings

__all__ = [
    "CORRELATION_FRAMES",
    "Baseline",
    "DriftSettings",
    "Finding",
    "Foresight",
    "MotionWatch",
    "SequentialTest",
    "foresee",
]
