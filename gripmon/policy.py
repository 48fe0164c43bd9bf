"""Judging what was measured: states, verdicts, alerts, and when to recalibrate.

Drift is decided by a sequential test, not by a bare threshold.  For every axis and sign the log-likelihood ratio of
"shifted by the smallest drift worth noticing" against "not shifted" is summed up and cut at zero (CUSUM, Page 1954).
Without drift such a sum of independent frames reaches ``h`` after exp(h) frames on average or later (Lorden 1971), so
that ``h`` follows from the false alarms a day that are tolerated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from gripmon.records import Alert, AlertKind, Array, Cause, Severity, State, Verdict


class PolicySettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What is noticed, and what is done then."""

    smallest_drift_m: Annotated[
        float,
        Meta(
            gt=0.0, le=0.1, description="smallest shift of the TCP, along any camera axis, that is worth an alert (m)"
        ),
    ] = 1e-4
    smallest_drift_rad: Annotated[
        float, Meta(gt=0.0, le=1.0, description="smallest rotation about any camera axis that is worth an alert (rad)")
    ] = 3e-3
    false_alarms_per_day: Annotated[
        float, Meta(gt=0.0, le=1000.0, description="drift alarms a day that an unmoved camera may give (1/day)")
    ] = 0.01
    frames_per_s: Annotated[
        float, Meta(gt=0.0, le=2000.0, description="frame rate that this is reckoned for (1/s)")
    ] = 60.0
    limit_m: Annotated[
        float,
        Meta(gt=0.0, le=1.0, description="motion d of equation (14) past which the reference is measured anew (m)"),
    ] = 2.5e-3
    limit_rad: Annotated[
        float,
        Meta(
            gt=0.0,
            le=3.0,
            description="rotation delta of equation (14) past which the reference is measured anew (rad)",
        ),
    ] = 0.02
    recalibrate: Annotated[
        bool, Meta(description="true: past the limit take the new pose as reference; false: only alert")
    ] = True
    settle_frames: Annotated[
        int,
        Meta(
            ge=1, le=10000, description="frames that the gripper must stand still in the image before a recalibration"
        ),
    ] = 20
    correlation_frames: Annotated[
        float,
        Meta(ge=1.0, le=10000.0, description="so many frames in a row err together, since the background stands still"),
    ] = 10.0
    confirm_frames: Annotated[
        int, Meta(ge=1, le=1000, description="frames that must agree after a jump before the transform counts as valid")
    ] = 2
    hold_s: Annotated[
        float,
        Meta(ge=0.0, le=3600.0, description="how long the last transform is held when nothing can be measured (s)"),
    ] = 1.0
    hold_m_per_sqrt_s: Annotated[
        float,
        Meta(gt=0.0, le=1.0, description="growth of a held transform's position sigma (m per square root of a second)"),
    ] = 2e-4
    hold_rad_per_sqrt_s: Annotated[
        float,
        Meta(
            gt=0.0, le=3.0, description="growth of a held transform's rotation sigma (rad per square root of a second)"
        ),
    ] = 2e-3
    image_alert_after_s: Annotated[
        float, Meta(ge=0.0, le=3600.0, description="refused frames for so long give an alert (s)")
    ] = 1.0
    suspect_sigma_m: Annotated[
        float, Meta(gt=0.0, le=1.0, description="a transform whose TCP is less certain than this is suspect (m)")
    ] = 1e-4


GRIPPER_CAUSES = (Cause.FINGER_BENT, Cause.JAW_OPENING)
"""Causes of a drift that lie in the gripper: the camera may be where it was, and is not calibrated anew."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """What one measured frame says: ``shift`` (6,) of the transform against the reference with ``sigma`` (6,), the
    motion ``d_m`` and ``delta_rad`` of equation (14), whether the pose jumped against the previous frame, what
    would explain a drift, and whether the gripper contradicts its model (a finger or the jaw is not where it should
    be).
    """

    shift: Array
    sigma: Array
    d_m: float
    delta_rad: float
    jumped: bool
    cause: Cause
    gripper_astray: bool = False


@dataclass(frozen=True, slots=True)
class Judgement:
    state: State
    verdict: Verdict
    alerts: tuple[Alert, ...]
    recalibrate: bool = False


class DriftTest:
    """Twelve one-sided CUSUMs: three shifts and three rotations, both signs."""

    def __init__(self, settings: PolicySettings):
        self.smallest = np.array([settings.smallest_drift_m] * 3 + [settings.smallest_drift_rad] * 3)
        self._correlation_frames = settings.correlation_frames
        frames_a_day = 86400.0 * settings.frames_per_s
        self.threshold = math.log(2 * len(self.smallest) * frames_a_day / settings.false_alarms_per_day)
        self._sums = np.zeros((2, 6))
        self._established = np.zeros((2, 6), dtype=bool)

    def add(self, shift: Array, sigma: Array) -> bool:
        """One frame's shift against the reference (6,) and its standard deviations; True while a drift is
        established: from the threshold on until all that spoke for it is taken back.
        """
        # Frames that err together tell no more than one of them.
        gain = self.smallest / (sigma * sigma * self._correlation_frames)
        centred, half = gain * shift, 0.5 * gain * self.smallest
        # No single frame may decide: whatever it says counts for at most a fifth of the threshold.
        limit = 0.2 * self.threshold
        for sums, evidence in ((self._sums[0], centred - half), (self._sums[1], -centred - half)):
            np.maximum(evidence, -limit, out=evidence)
            np.minimum(evidence, limit, out=evidence)
            sums += evidence
        np.maximum(self._sums, 0.0, out=self._sums)
        np.minimum(self._sums, self.threshold, out=self._sums)
        self._established &= self._sums > 0.0
        self._established |= self._sums >= self.threshold
        return bool(self._established.any())

    @property
    def suspicious(self) -> bool:
        """Whether anything speaks for a drift just now."""
        return bool(self._sums.any())

    def reset(self) -> None:
        self._sums[:] = 0.0
        self._established[:] = False


class Baseline:
    """The part of the shift that an inexact reference explains.

    A calibration is off by some tenths of a millimetre from the start, which is no drift.  The mean shift of the
    first frames is taken for that error if the reference's own uncertainty allows it (four standard deviations on
    every axis), else nothing is.
    """

    def __init__(self, reference_sigma: Array | None, frames: int):
        self._allowed = None if reference_sigma is None else 4.0 * reference_sigma
        self._frames = frames
        self._first: list[Array] = []
        self._error: Array = np.zeros(6)

    def subtract(self, shift: Array) -> Array | None:
        """The shift (6,) less the reference's error; None while that isn't known yet."""
        if self._allowed is not None:
            self._first.append(shift)
            if len(self._first) < self._frames:
                return None
            mean = np.mean(self._first, axis=0)
            self._error = mean if (np.abs(mean) <= self._allowed).all() else np.zeros(6)
            self._allowed = None
        return shift - self._error


class Policy:
    """The states ``acquiring -> tracking <-> drifting -> recalibrating -> tracking``, ``occluded`` and ``lost``.

    A function of the frames so far: time is the frames' own.
    """

    def __init__(self, settings: PolicySettings, reference_sigma: Array | None = None):
        """``reference_sigma`` (6,): standard deviations of the reference's error, m and rad; None if it counts as
        exact.
        """
        self._settings = settings
        self.test = DriftTest(settings)
        self._baseline = Baseline(reference_sigma, settings.settle_frames)
        self.state = State.ACQUIRING
        self._since_jump = 0
        self._still = 0
        self._still_shift: Array = np.zeros(6)
        self._drift_alerted = False
        self._bad_since_s: float | None = None
        self._in_a_row = 0
        self._told: set[AlertKind] = set()
        self._drift_cause = Cause.UNKNOWN

    def measured(self, evidence: Evidence) -> Judgement:
        """A frame from which a transform could be measured."""
        settings = self._settings
        alerts = self._recovered()
        self._since_jump = 1 if evidence.jumped else self._since_jump + 1
        self._count_still(evidence)
        if evidence.jumped and self.state not in (State.ACQUIRING, State.LOST):
            alerts.append(_jump_alert(evidence))
        confirmed = self._since_jump >= settings.confirm_frames
        since_start = self._baseline.subtract(evidence.shift)
        drifting = since_start is not None and self.test.add(since_start, evidence.sigma)
        past_limit = evidence.d_m > settings.limit_m or evidence.delta_rad > settings.limit_rad
        recalibrate = False
        if not confirmed and self.state in (State.ACQUIRING, State.LOST, State.OCCLUDED):
            state: State = State.ACQUIRING if self.state is State.LOST else self.state
        elif past_limit and settings.recalibrate and self._drift_cause not in GRIPPER_CAUSES:
            state = State.RECALIBRATING
            recalibrate = self._still >= settings.settle_frames
        elif drifting:
            state = State.DRIFTING
        else:
            state = State.TRACKING
        if drifting and not self._drift_alerted:
            self._drift_cause = evidence.cause
            alerts.append(_drift_alert(evidence, past_limit))
        elif self._drift_alerted and not drifting:
            alerts.append(
                Alert(AlertKind.RECOVERED, evidence.cause, Severity.INFO, "the drift against the reference is gone")
            )
        self._drift_alerted = drifting
        if not drifting:
            self._drift_cause = Cause.UNKNOWN
        self.state = state
        sure = float(evidence.sigma[:3].max()) <= settings.suspect_sigma_m and not evidence.gripper_astray
        # The gripper is not what its model says: the transform follows the finger or the jaw, not the camera.
        sure = sure and self._drift_cause not in GRIPPER_CAUSES
        return Judgement(state, Verdict.VALID if confirmed and sure else Verdict.SUSPECT, tuple(alerts), recalibrate)

    def recalibrated(self, text: str) -> Alert:
        """The reference was replaced: drift is reckoned from zero."""
        self.test.reset()
        self._baseline = Baseline(None, 0)
        self._drift_alerted = False
        cause, self._drift_cause = self._drift_cause, Cause.UNKNOWN
        return Alert(AlertKind.RECALIBRATED, cause, Severity.WARNING, text)

    def not_recalibrated(self, why: str) -> Alert | None:
        """The reference could not be measured anew: try again when the camera has stood still for as long again."""
        self._still = 0
        if not self._news(AlertKind.RECALIBRATED):
            return None
        text = f"past the limit, but not calibrated anew: {why}"
        return Alert(AlertKind.DRIFT, self._drift_cause, Severity.ERROR, text)

    @property
    def still_frames(self) -> int:
        """Frames since the transform last left the place where it came to rest."""
        return self._still

    @property
    def wants_cause(self) -> bool:
        """Whether the next judgement may have to name the cause of a drift."""
        return not self._drift_alerted and self.test.suspicious

    def unmeasured(self, now_s: float, refusal: str | None, measured_s: float | None) -> Judgement:
        """A frame from which nothing could be measured: refused as an image (``refusal`` says why), or the gripper
        isn't seen in it.  ``measured_s`` is when a transform was last measured, None for never.
        """
        settings = self._settings
        self._since_jump = self._still = self._in_a_row = 0
        if self._bad_since_s is None:
            self._bad_since_s = now_s
        lasted_s = now_s - self._bad_since_s
        held = measured_s is not None and now_s - measured_s <= settings.hold_s
        if held:
            # A bad image says nothing about the gripper: only time makes it lost.
            known = refusal is not None and self.state is not State.LOST
            self.state = self.state if known else State.OCCLUDED
        elif measured_s is not None or lasted_s > settings.hold_s:
            self.state = State.LOST
        alerts = []
        if self.state is State.LOST and self._news(AlertKind.LOST):
            what = f"frames refused ({refusal})" if refusal else "the gripper was not found"
            cause = Cause.IMAGE_BAD if refusal else Cause.UNKNOWN if measured_s is None else Cause.VIEW_BLOCKED
            text = f"{what} for {lasted_s:.1f} s; no transform is given"
            alerts.append(Alert(AlertKind.LOST, cause, Severity.ERROR, text))
        elif self.state is State.OCCLUDED and self._news(AlertKind.OCCLUDED):
            text = "too few edges of the gripper are seen; the last transform is held"
            alerts.append(Alert(AlertKind.OCCLUDED, Cause.VIEW_BLOCKED, Severity.WARNING, text))
        if refusal and lasted_s >= settings.image_alert_after_s and self._news(AlertKind.IMAGE):
            text = f"frames are refused for {lasted_s:.1f} s: {refusal}"
            alerts.append(Alert(AlertKind.IMAGE, Cause.IMAGE_BAD, Severity.ERROR, text))
        return Judgement(self.state, Verdict.SUSPECT if held else Verdict.UNKNOWN, tuple(alerts))

    def hold_variance(self, held_s: float) -> Array:
        """(6,) what a held transform's variances have grown by after ``held_s`` seconds."""
        settings = self._settings
        rates = [settings.hold_m_per_sqrt_s] * 3 + [settings.hold_rad_per_sqrt_s] * 3
        return np.square(rates) * held_s

    def _count_still(self, evidence: Evidence) -> None:
        """Frames since the transform last left the place where it came to rest: by half the smallest drift, and
        beyond its noise.
        """
        leeway = np.maximum(0.5 * self.test.smallest, 5.0 * evidence.sigma)
        if evidence.jumped or self._still == 0 or (np.abs(evidence.shift - self._still_shift) > leeway).any():
            self._still, self._still_shift = 1, evidence.shift
        else:
            self._still += 1

    def _news(self, kind: AlertKind) -> bool:
        """Whether this kind of trouble hasn't been told yet; it may be told again once the gripper is back for good."""
        told = kind in self._told
        self._told.add(kind)
        return not told

    def _recovered(self) -> list[Alert]:
        """Frames that are measured one after the other end the trouble that was told of."""
        self._bad_since_s = None
        self._in_a_row += 1
        if not self._told or self._in_a_row < self._settings.settle_frames:
            return []
        self._told.clear()
        return [Alert(AlertKind.RECOVERED, Cause.UNKNOWN, Severity.INFO, "the gripper is measured again")]


def _jump_alert(evidence: Evidence) -> Alert:
    return Alert(AlertKind.STEP, evidence.cause, Severity.WARNING, f"the transform jumped; {_shift_text(evidence)}")


def _drift_alert(evidence: Evidence, past_limit: bool) -> Alert:
    text = f"drift against the reference: {_shift_text(evidence)}" + ("; past the limit" if past_limit else "")
    return Alert(AlertKind.DRIFT, evidence.cause, Severity.ERROR if past_limit else Severity.WARNING, text)


def _shift_text(evidence: Evidence) -> str:
    x, y, z = (1e3 * evidence.shift[:3]).tolist()
    turned = f"turned by {math.degrees(evidence.delta_rad):.3f} degrees"
    return f"TCP now {x:+.3f} {y:+.3f} {z:+.3f} mm, {turned} against the reference"
