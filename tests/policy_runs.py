"""Frames for the policy, one every ``PERIOD_S``, and shorthands for what it answers."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from gripmon.policy import Evidence, Judgement, Policy, PolicySettings
from gripmon.records import AlertKind, Cause, State, Verdict

SETTINGS = PolicySettings(settle_frames=4, confirm_frames=2, hold_s=1.0, image_alert_after_s=0.5)
PERIOD_S = 0.125
SIGMA = np.array([4e-6, 4e-6, 1.5e-5, 3e-4, 3e-4, 1e-4])
"""What a frame of the simulated gripper is worth."""


def seen(
    x_mm: float = 0.0,
    *,
    turn_rad: float = 0.0,
    jumped: bool = False,
    sigma: np.ndarray = SIGMA,
    cause: Cause = Cause.CAMERA_MOUNT,
) -> Evidence:
    """A measured frame: the TCP shifted along the camera's x axis, turned about z."""
    shift = np.array([1e-3 * x_mm, 0.0, 0.0, 0.0, 0.0, turn_rad])
    return Evidence(shift, sigma, abs(1e-3 * x_mm), abs(turn_rad), jumped, cause)


@dataclass(frozen=True)
class Nothing:
    """A frame without a measurement; with a reason the image was refused."""

    refusal: str | None = None


HIDDEN, BLACK = Nothing(), Nothing("black")
TRACKING, DRIFTING, RECALIBRATING = State.TRACKING, State.DRIFTING, State.RECALIBRATING
ACQUIRING, OCCLUDED, LOST = State.ACQUIRING, State.OCCLUDED, State.LOST
VALID, SUSPECT, UNKNOWN = Verdict.VALID, Verdict.SUSPECT, Verdict.UNKNOWN


class Run:
    """Feeds frames, one every ``PERIOD_S``."""

    def __init__(self, settings: PolicySettings = SETTINGS, reference_sigma: np.ndarray | None = None) -> None:
        self.policy = Policy(settings, reference_sigma)
        self.now_s = 100.0
        self.measured_s: float | None = None

    def feed(self, frame: Evidence | Nothing) -> Judgement:
        self.now_s += PERIOD_S
        if isinstance(frame, Nothing):
            return self.policy.unmeasured(self.now_s, frame.refusal, self.measured_s)
        self.measured_s = self.now_s
        return self.policy.measured(frame)

    def feed_all(self, frames: Iterable[Evidence | Nothing]) -> list[Judgement]:
        return [self.feed(frame) for frame in frames]


def kinds(judgements: Iterable[Judgement]) -> list[AlertKind]:
    return [alert.kind for judgement in judgements for alert in judgement.alerts]


def settled(settings: PolicySettings = SETTINGS) -> Run:
    run = Run(settings)
    assert run.feed_all([seen()] * 3)[-1].state is TRACKING
    return run
