"""What moved: competing models compared on the same edges, with probabilities."""

from gripmon.causes.blur import BlurWatch
from gripmon.causes.judge import CauseJudge, CauseSettings

__all__ = ["BlurWatch", "CauseJudge", "CauseSettings"]
