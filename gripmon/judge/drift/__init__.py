"""Has the camera moved?  A sequential test on the drift with a stated false-alarm rate, and the kind of motion."""

from gripmon.judge.drift.foresight import CORRELATION_FRAMES, Foresight, foresee
from gripmon.judge.drift.motion import USUAL_SQUARE, Baseline, MotionWatch
from gripmon.judge.drift.sequential import Finding, SequentialTest, warm_up
from gripmon.judge.drift.settings import DriftSettings

__all__ = [
    "CORRELATION_FRAMES",
    "USUAL_SQUARE",
    "Baseline",
    "DriftSettings",
    "Finding",
    "Foresight",
    "MotionWatch",
    "SequentialTest",
    "foresee",
    "warm_up",
]
