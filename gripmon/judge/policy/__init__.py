"""What follows from what was measured: states, verdicts, and alerts with a life of their own."""

from gripmon.judge.policy.alerts import AlertBook
from gripmon.judge.policy.judging import NO_REFERENCE, Evidence, Judgement, Policy, past_alert_limit
from gripmon.judge.policy.settings import PolicySettings

__all__ = ["NO_REFERENCE", "AlertBook", "Evidence", "Judgement", "Policy", "PolicySettings", "past_alert_limit"]
