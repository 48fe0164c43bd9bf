"""What moved: competing models compared on the same edges, with probabilities."""

from gripmon.judge.causes.judge import NOT_THE_CAMERA, CauseJudge, CauseSettings
from gripmon.judge.causes.kernel import warm_up
from gripmon.judge.causes.watches import BlurWatch, FingerWatch, JawWatch, ResidualWatch, Watches

__all__ = [
    "NOT_THE_CAMERA",
    "BlurWatch",
    "CauseJudge",
    "CauseSettings",
    "FingerWatch",
    "JawWatch",
    "ResidualWatch",
    "Watches",
    "warm_up",
]
