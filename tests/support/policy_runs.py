"""Frames for the policy, one every ``PERIOD_S``, and shorthands for what it answers."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from gripmon.judge.policy import Evidence, Judgement, Policy, PolicySettings
from gripmon.model.records import (
    Alert,
    AlertEvent,
    AlertKind,
    Cause,
    CauseWeight,
    Creep,
    Explanation,
    Motion,
    Protection,
    State,
    Verdict,
    Vibration,
)

SETTINGS = PolicySettings(
    settle_frames=4, confirm_frames=2, hold_s=1.0, image_alert_after_s=0.5, update_alert_s=1.0, clear_alert_s=0.25
)
"""Two frames pass before an alert is cleared in the third."""

PERIOD_S = 0.125
SIGMA = np.array([4e-6, 4e-6, 1.5e-5, 3e-4, 3e-4, 1e-4])
"""What a frame of the simulated gripper is worth."""

BOUNDED = Protection(2e-4, 3e-3, 1e-5, "nothing is wrong")
"""Well within the alert limits."""
BEYOND = Protection(2e-3, 3e-3, 1e-5, "finger left is not where its model says")


def seen(
    x_mm: float = 0.0,
    *,
    turn_rad: float = 0.0,
    present: bool | None = None,
    kind: AlertKind = AlertKind.STEP,
    jumped: bool = False,
    sigma: np.ndarray = SIGMA,
    creep_mm_per_min: float | None = None,
    vibration: Vibration | None = None,
    explanation: Explanation | None = None,
    astray: bool = False,
    stream_at_fault: bool = False,
    protection: Protection | None = BOUNDED,
    where_it_was: bool = False,
    unproven: bool = False,
    believed: bool = True,
) -> Evidence:
    """A measured frame: the TCP shifted along the camera's x axis, turned about z; any shift is one that the drift test
    has found unless ``present`` says otherwise.
    """
    shift = np.array([1e-3 * x_mm, 0.0, 0.0, 0.0, 0.0, turn_rad])
    creep = None
    if creep_mm_per_min is not None:
        kind, velocity = AlertKind.CREEP, np.array([1e-3 * creep_mm_per_min / 60.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        creep = Creep(velocity, 0.0)
    motion = Motion(bool(shift.any()) if present is None else present, kind, shift, sigma, 8, creep=creep)
    return Evidence(
        shift,
        sigma,
        abs(1e-3 * x_mm),
        abs(turn_rad),
        motion._replace(vibration=vibration),
        jumped,
        explanation or Explanation(),
        astray,
        stream_at_fault,
        protection,
        where_it_was,
        believed=believed,
        unproven=unproven,
    )


def explained(cause: Cause, part: str | None = None, probability: float = 0.97) -> Explanation:
    """A probable cause, and what is left for the unknown."""
    probable = CauseWeight(cause, probability, part)
    others = CauseWeight(Cause.UNKNOWN, 1.0 - probability)
    return Explanation((probable, others), probable, f"{cause} it is")


BENT, KNOCKED = explained(Cause.FINGER_BENT, "left"), explained(Cause.CAMERA_MOUNT)
PERHAPS_BENT = replace(BENT, text="perhaps a finger", confirmed=False)


@dataclass(frozen=True)
class Nothing:
    """A frame without a measurement; with a reason the image was refused."""

    refusal: str | None = None
    explanation: Explanation | None = None


HIDDEN, BLACK = Nothing(), Nothing("black")
TRACKING, DRIFTING, RECALIBRATING = State.TRACKING, State.DRIFTING, State.RECALIBRATING
ACQUIRING, OCCLUDED, LOST = State.ACQUIRING, State.OCCLUDED, State.LOST
VALID, SUSPECT, UNKNOWN = Verdict.VALID, Verdict.SUSPECT, Verdict.UNKNOWN
RAISED, UPDATED, CLEARED = AlertEvent.RAISED, AlertEvent.UPDATED, AlertEvent.CLEARED


class Run:
    """Feeds frames, one every ``PERIOD_S``."""

    def __init__(self, settings: PolicySettings = SETTINGS, *, may_recalibrate: bool = True) -> None:
        self.policy = Policy(settings, may_recalibrate)
        self.now_s = 100.0
        self.measured_s: float | None = None

    @property
    def stamp_ns(self) -> int:
        return round(1e9 * self.now_s)

    def feed(self, frame: Evidence | Nothing) -> Judgement:
        self.now_s += PERIOD_S
        if isinstance(frame, Nothing):
            return self.policy.unmeasured(self.now_s, self.stamp_ns, frame.refusal, self.measured_s, frame.explanation)
        self.measured_s = self.now_s
        return self.policy.measured(frame, self.now_s, self.stamp_ns)

    def feed_all(self, frames: Iterable[Evidence | Nothing]) -> list[Judgement]:
        return [self.feed(frame) for frame in frames]

    def feed_stream(self, *faults: tuple[str, Cause, str]) -> tuple[Alert, ...]:
        self.now_s += PERIOD_S
        return self.policy.stream(faults, self.now_s, self.stamp_ns)


def told(alerts: Iterable[Alert]) -> list[tuple[AlertKind, AlertEvent]]:
    return [(alert.kind, alert.event) for alert in alerts]


def alerts_of(judgements: Iterable[Judgement]) -> list[Alert]:
    return [alert for judgement in judgements for alert in judgement.alerts]


def kinds(judgements: Iterable[Judgement]) -> list[tuple[AlertKind, AlertEvent]]:
    return told(alerts_of(judgements))


def settled(settings: PolicySettings = SETTINGS, *, may_recalibrate: bool = True) -> Run:
    run = Run(settings, may_recalibrate=may_recalibrate)
    assert run.feed_all([seen()] * 3)[-1].state is TRACKING
    return run
