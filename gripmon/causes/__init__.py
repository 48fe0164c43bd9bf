"""What moved: competing models compared on the same edges, with probabilities."""

from gripmon.causes.judge import CauseJudge, CauseSettings
from gripmon.causes.watches import BlurWatch, FingerWatch, JawWatch, ResidualWatch, Watches

__all__ = ["BlurWatch", "CauseJudge", "CauseSettings", "FingerWatch", "JawWatch", "ResidualWatch", "Watches"]
