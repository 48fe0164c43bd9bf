"""What moved: competing models compared on the same edges, with probabilities."""

from gripmon.judge.causes.judge import CauseJudge, CauseSettings
from gripmon.judge.causes.watches import BlurWatch, FingerWatch, JawWatch, ResidualWatch, Watches

__all__ = ["BlurWatch", "CauseJudge", "CauseSettings", "FingerWatch", "JawWatch", "ResidualWatch", "Watches"]
