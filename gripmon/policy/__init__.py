"""What follows from what was measured: states, verdicts, and alerts with a life of their own."""

from gripmon.policy.alerts import AlertBook
from gripmon.policy.judging import NOT_THE_CAMERA, Evidence, Judgement, Policy
from gripmon.policy.settings import PolicySettings

__all__ = ["NOT_THE_CAMERA", "AlertBook", "Evidence", "Judgement", "Policy", "PolicySettings"]
