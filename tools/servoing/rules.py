"""What a controller may do by a verdict: the table of the README, as a function."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

from gripmon.model.records import Verdict


class Action(enum.StrEnum):
    """What is allowed until the next transform comes."""

    GO = "go"
    SLOW = "slow"
    STOP = "stop"


@dataclass(frozen=True)
class Limits:
    """``max_age_s``: a transform that is older is not a transform.  ``clearance_m``: how far the fingers may be off
    without touching anything, to which three standard deviations of a suspect transform are held.
    """

    max_age_s: float = 0.2
    clearance_m: float = 1e-3
    slow: float = 0.25
    """Share of the usual speed by a suspect transform."""

    def speed(self, action: Action) -> float:
        return {Action.GO: 1.0, Action.SLOW: self.slow, Action.STOP: 0.0}[action]


def action_for(
    verdict: Verdict | None, *, age_s: float, sigma_m: float | None, moving: bool, limits: Limits | None = None
) -> Action:
    """``verdict`` None: nothing has come.  ``age_s`` of the transform: from the future it is as bad as an old one,
    since its age isn't known.  ``sigma_m``: largest standard deviation of its position, None if there is no transform.
    ``moving``: whether a motion is under way; a suspect transform begins none.
    """
    limits = limits or Limits()
    if verdict is None or verdict is Verdict.UNKNOWN or sigma_m is None or not math.isfinite(sigma_m):
        return Action.STOP
    if not abs(age_s) <= limits.max_age_s:
        return Action.STOP
    if verdict is Verdict.VALID:
        return Action.GO
    return Action.SLOW if moving and 3.0 * sigma_m <= limits.clearance_m else Action.STOP


def may_grasp(verdict: Verdict | None, action: Action) -> bool:
    """Fingers close by a valid transform only."""
    return verdict is Verdict.VALID and action is Action.GO
