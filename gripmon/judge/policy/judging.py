"""Judging what was measured: states, verdicts, alerts, and when to recalibrate.

A function of the frames so far: time is the frames' own.  Whether the camera has moved is decided in ``drift``, what
moved in ``causes``; here it is decided what follows.

What a verdict means to a controller: ``valid``, use the transform; ``suspect``, finish or stop a motion by it, don't
begin one; ``unknown``, don't move by it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gripmon.judge.causes import NOT_THE_CAMERA
from gripmon.judge.policy.alerts import AlertBook, Topic
from gripmon.judge.policy.settings import PolicySettings, time_left_s
from gripmon.judge.policy.words import creep_text, frequency_text, motion_text, unproven_text
from gripmon.judge.repeats import TEXT as REPEATED
from gripmon.model.records import (
    NOTHING_WRONG,
    Alert,
    AlertKind,
    Array,
    Cause,
    Explanation,
    Motion,
    Protection,
    Severity,
    State,
    Verdict,
)
from gripmon.model.units import in_degrees, in_mm, in_time
from gripmon.track.edges import VAGUE_M, VAGUE_RAD

NO_REFERENCE = (*NOT_THE_CAMERA, Cause.CAMERA_REPLACED)
"""Causes with which nothing that is measured may be relied on, nor become a reference: with another camera the lens's
calibration doesn't hold either.
"""

HIDES_NOTHING = (Cause.CAMERA_MOUNT, Cause.JAW_OPENING)
"""Causes that are found by where the gripper is seen: none of them is why it is not."""

NO_EXPLANATION = Explanation()

VIBRATION_SIGMAS = 3.0
"""Standard deviations of a vibrating camera's way that are no drift."""

RELEASE_RATIO = 0.8
"""Part of a limit below which an alert that is past it no longer is."""


class Evidence(NamedTuple):
    """What one measured frame says: ``shift`` (6,) of the transform against the reference with ``sigma`` (6,), the
    motion ``d_m`` and ``delta_rad`` of equation (14), what the frames so far make of the ``motion``, whether the pose
    jumped against the previous frame, what would explain it, and whether the gripper contradicts its model (a finger or
    the jaw is not where it should be), and whether the stream of frames is at fault (so that stamps or the camera's
    calibration may not hold).  ``protection``: bounds on the transform's error; None where there are none.
    ``where_it_was``: the gripper is where it proved to be before, so that no second frame has to say so.
    ``swing`` (6,): variance of the way between one proven pose and the next, m² and rad²; None where that isn't known.
    ``believed``: the gripper may be taken to be there.
    ``since_first``: ``motion`` counts from where the first frames had the camera, which the reference allows, not
    from the reference.  ``unproven``: nothing in the frame proves where the gripper is, though a frame before did.
    ``cut_off``: most of the gripper's edges lie beside white or black that is cut off.  ``old``: beside an edge there
    are only pixels of an earlier frame.
    """

    shift: Array
    sigma: Array
    d_m: float
    delta_rad: float
    motion: Motion
    jumped: bool = False
    explanation: Explanation = NO_EXPLANATION
    gripper_astray: bool = False
    stream_at_fault: bool = False
    protection: Protection | None = None
    where_it_was: bool = False
    swing: Array | None = None
    believed: bool = True
    since_first: bool = False
    unproven: bool = False
    cut_off: bool = False
    old: bool = False

    @property
    def elsewhere(self) -> bool:
        """Whether the gripper is seen where it wasn't, and may not be taken to be there; not in an old image."""
        return not (self.believed or self.where_it_was or self.old)

    @property
    def moved(self) -> bool:
        """Whether the camera has moved, by more than it swings to and fro anyway."""
        if not self.motion.present or self.swing is None:
            return self.motion.present
        # Of whole vectors: a slow beat along one axis belongs to the vibration along another.
        way, swing = np.square(self.motion.shift), VIBRATION_SIGMAS**2 * self.swing
        return bool(way[:3].sum() > swing[:3].sum() or way[3:].sum() > swing[3:].sum())


class Judgement(NamedTuple):
    state: State
    verdict: Verdict
    alerts: tuple[Alert, ...]
    recalibrate: bool = False
    reason: str | None = None
    """Why the verdict isn't ``valid``; None when it is."""


class Policy:
    """The states ``acquiring -> tracking <-> drifting -> recalibrating -> tracking``, ``occluded`` and ``lost``."""

    def __init__(self, settings: PolicySettings, may_recalibrate: bool = True):
        self._settings = settings
        self._may_recalibrate = may_recalibrate
        self._worth_a_warning = np.array([settings.warn_m] * 3 + [settings.warn_rad] * 3)
        self.alerts = AlertBook(settings.update_alert_s, settings.clear_alert_s)
        self.state = State.ACQUIRING
        self._since_jump = 0
        self._still = 0
        self._still_shift: Array = np.zeros(6)
        self._bad_since: tuple[float, int] | None = None  # by the frames' time, s, and by their stamps, ns
        self._unproven_since: tuple[float, int] | None = None  # likewise
        self._unproven_text = ""  # as it was first told: figures in it change with every frame

    def measured(self, evidence: Evidence, now_s: float, stamp_ns: int) -> Judgement:
        """A frame from which a transform could be measured."""
        settings, probable = self._settings, evidence.explanation.probable
        self._bad_since = None
        self._since_jump = 1 if evidence.jumped else self._since_jump + 1
        self._count_still(evidence)
        confirmed = evidence.where_it_was or self._since_jump >= settings.confirm_frames
        past_limit = evidence.d_m > settings.limit_m or evidence.delta_rad > settings.limit_rad
        past_limit = past_limit and evidence.believed
        unreliable = probable.cause in NO_REFERENCE
        recalibrate, moved = False, evidence.moved
        if not confirmed and self.state in (State.ACQUIRING, State.LOST, State.OCCLUDED):
            state: State = State.ACQUIRING if self.state is State.LOST else self.state
        elif past_limit and self._may_recalibrate and not unreliable:
            state = State.RECALIBRATING
            recalibrate = self._still >= settings.settle_frames
        elif moved:
            state = State.DRIFTING
        else:
            state = State.TRACKING
        self.state = state
        beyond = past_alert_limit(evidence.protection, settings)
        reason = self._doubt(evidence, confirmed, beyond)
        # A fault of the gripper or the lens has an alert of its own, and nothing proves a place with it.
        faulty = evidence.explanation.confirmed_cause.cause in NOT_THE_CAMERA
        if faulty or not (evidence.elsewhere or (evidence.unproven and beyond is not None)):
            self._unproven_since = None
        elif self._unproven_since is None:
            self._unproven_since, self._unproven_text = (now_s, stamp_ns), ""
        verdict = Verdict.VALID if reason is None else Verdict.SUSPECT
        return Judgement(state, verdict, self._alerts_of(evidence, moved, now_s, stamp_ns), recalibrate, reason)

    @staticmethod
    def _doubt(evidence: Evidence, confirmed: bool, beyond: str | None) -> str | None:
        """Why a measured transform isn't valid, its bound being ``beyond`` a limit or not; None where it is."""
        if not confirmed:
            return "not yet confirmed by a second frame"
        if evidence.old:
            return REPEATED
        if evidence.stream_at_fault:
            return "the stream of frames is at fault"
        if evidence.explanation.probable.cause in NO_REFERENCE:
            return evidence.explanation.text or str(evidence.explanation.probable.cause)
        if beyond is not None and evidence.cut_off:
            return f"{beyond}; white or black beside the edges is cut off, which shifts them: change the exposure"
        return beyond

    def unmeasured(
        self,
        now_s: float,
        stamp_ns: int,
        refusal: str | None,
        measured_s: float | None,
        explanation: Explanation | None = None,
    ) -> Judgement:
        """A frame from which nothing could be measured: refused as an image (``refusal`` says why), or the gripper
        isn't seen in it (``explanation`` may know why).  ``measured_s`` is when a transform was last measured, None for
        never.
        """
        settings, book = self._settings, self.alerts
        self._since_jump = self._still = 0
        if self._bad_since is None:
            self._bad_since = now_s, stamp_ns
        lasted_s, begun = now_s - self._bad_since[0], in_time(self._bad_since[1])
        held = measured_s is not None and now_s - measured_s <= settings.hold_s
        if held:
            # A bad image says nothing about the gripper: only time makes it lost.
            known = refusal is not None and self.state is not State.LOST
            self.state = self.state if known else State.OCCLUDED
        elif measured_s is not None or lasted_s > settings.hold_s:
            self.state = State.LOST
        alerts: tuple[Alert, ...] = ()
        explanation = explanation or NO_EXPLANATION
        if explanation.probable.cause in HIDES_NOTHING:
            explanation = NO_EXPLANATION  # of a motion before
        probable = explanation.confirmed_cause
        if self.state is State.LOST:
            what = f"frames have been refused ({refusal})" if refusal else "the gripper has not been found"
            cause = self._bad(explanation) if refusal else probable.cause
            why = "" if refusal else explanation.text
            text = f"{what} since {begun}; no transform is given" + (f"; {why}" if why else "")
            lost = Alert(AlertKind.LOST, cause, Severity.ERROR, text, part=probable.part, causes=explanation.causes)
            alerts += book.present(Topic.VIEW, lost, now_s, stamp_ns)
        elif self.state is State.OCCLUDED:
            text = "too few edges of the gripper are seen; the last transform is held"
            text += f"; {explanation.text}" if explanation.text else ""
            cause, causes = probable.cause, explanation.causes
            occluded = Alert(AlertKind.OCCLUDED, cause, Severity.WARNING, text, part=probable.part, causes=causes)
            before = book.about(Topic.VIEW)
            # Lost isn't taken back for one frame, nor is it over while frames in between show nothing; and a place that
            # nothing proves is not proven by them.
            since = self._unproven_since
            lasts = since is not None and now_s - since[0] >= settings.hold_s
            told = occluded if before is None or (before.kind is AlertKind.OCCLUDED and not lasts) else before
            alerts += book.present(Topic.VIEW, told, now_s, stamp_ns)
        if refusal and lasted_s >= settings.image_alert_after_s:
            text = f"frames have been refused since {begun}: {refusal}"
            bad = Alert(AlertKind.IMAGE, self._bad(explanation), Severity.ERROR, text)
            alerts += book.present(Topic.IMAGE, bad, now_s, stamp_ns)
        elif not refusal:
            alerts += book.absent(Topic.IMAGE, "images are good again", now_s)
        return Judgement(self.state, Verdict.SUSPECT if held else Verdict.UNKNOWN, alerts)

    def stream(self, faults: tuple[tuple[str, Cause, str], ...], now_s: float, stamp_ns: int) -> tuple[Alert, ...]:
        """What is wrong with the stream of frames just now: kind of fault, cause, and what there is to say of it."""
        book = self.alerts
        alerts: tuple[Alert, ...] = ()
        if not (faults or book.any):
            return alerts
        wrong = {
            Topic.STREAM + kind: Alert(AlertKind.STREAM, cause, Severity.ERROR, text) for kind, cause, text in faults
        }
        for topic, alert in wrong.items():
            alerts += book.present(topic, alert, now_s, stamp_ns)
        for each in book.open:
            if each.topic.startswith(Topic.STREAM) and each.topic not in wrong:
                alerts += book.absent(each.topic, "the stream of frames is as it should be", now_s)
        return alerts

    @staticmethod
    def _bad(explanation: Explanation) -> Cause:
        """Why images are refused: by themselves, unless the stream says otherwise."""
        return explanation.confirmed_cause.cause if explanation.text else Cause.IMAGE_BAD

    def recalibrated(self, now_s: float) -> tuple[Alert, ...]:
        """The reference was replaced: drift counts from zero, and its alerts are cleared."""
        self._still = 0
        over = self.alerts.absent(Topic.MOTION, "there is a new reference", now_s, at_once=True)
        return over + self.decided("there is a new reference", now_s)

    def not_recalibrated(self) -> None:
        """The reference could not be measured again: try again when the camera has stood still for as long again."""
        self._still = 0

    def refused(self, why: str, explanation: Explanation, now_s: float, stamp_ns: int) -> tuple[Alert, ...]:
        """There is no new reference, though one is needed or wanted."""
        return self._about_renewal(AlertKind.REFUSED, Severity.ERROR, why, explanation, now_s, stamp_ns)

    def proposed(self, text: str, explanation: Explanation, now_s: float, stamp_ns: int) -> tuple[Alert, ...]:
        """A new reference waits for an operator."""
        return self._about_renewal(AlertKind.PROPOSED, Severity.WARNING, text, explanation, now_s, stamp_ns)

    def decided(self, text: str, now_s: float) -> tuple[Alert, ...]:
        """Nothing waits for an operator any more."""
        return self.alerts.absent(Topic.RENEWAL, text, now_s, at_once=True)

    def _about_renewal(
        self, kind: AlertKind, severity: Severity, text: str, explanation: Explanation, now_s: float, stamp_ns: int
    ) -> tuple[Alert, ...]:
        probable, before = explanation.confirmed_cause, self.alerts.about(Topic.RENEWAL)
        alert = Alert(kind, probable.cause, severity, text, part=probable.part, causes=explanation.causes)
        over: tuple[Alert, ...] = ()
        if before is not None and (before.kind is not kind or (kind is AlertKind.PROPOSED and before.text != text)):
            # A new alert, not an update, which may be too soon or of something that was acknowledged.
            over = self.decided("overtaken by what follows", now_s)
        return over + self.alerts.present(Topic.RENEWAL, alert, now_s, stamp_ns)

    @property
    def drifting(self) -> bool:
        """Whether an alert about the camera's motion is open."""
        return self.alerts.about(Topic.MOTION) is not None

    def hold_variance(self, held_s: float) -> Array:
        """(6,) what a held transform's variances have grown by after ``held_s`` seconds."""
        settings = self._settings
        rates = [settings.hold_m_per_sqrt_s] * 3 + [settings.hold_rad_per_sqrt_s] * 3
        return np.square(rates) * held_s

    @property
    def worth_a_warning(self) -> Array:
        """(6,) shifts of the TCP and turns from which a drift is a warning, m and rad."""
        return self._worth_a_warning

    @property
    def still_frames(self) -> int:
        """For how many frames the transform has not left its place."""
        return self._still

    def _count_still(self, evidence: Evidence) -> None:
        """Frames since the transform last left the place where it came to rest: by half of what is worth a warning, and
        beyond its noise.
        """
        leeway = np.maximum(0.5 * self._worth_a_warning, 5.0 * evidence.sigma)
        if evidence.jumped or self._still == 0 or (np.abs(evidence.shift - self._still_shift) > leeway).any():
            self._still, self._still_shift = 1, evidence.shift
        else:
            self._still += 1

    def _alerts_of(self, evidence: Evidence, moved: bool, now_s: float, stamp_ns: int) -> tuple[Alert, ...]:
        book, motion, probable = self.alerts, evidence.motion, evidence.explanation.confirmed_cause
        not_the_camera = probable.cause in NOT_THE_CAMERA
        since = self._unproven_since
        if not (book.any or moved or not_the_camera or motion.vibration or since):
            return ()  # usually: nothing to raise, to update or to clear
        if since is not None and now_s - since[0] >= self._settings.hold_s:
            # As long as a transform is held of which nothing is seen.
            if not self._unproven_text:
                there = evidence.shift if evidence.elsewhere else None
                self._unproven_text = unproven_text(since[1], there, stamp_ns)
            text = self._unproven_text
            unproven = Alert(AlertKind.OCCLUDED, Cause.UNKNOWN, Severity.WARNING, text)
            before = book.about(Topic.VIEW)
            alerts = book.present(
                Topic.VIEW, unproven, now_s, stamp_ns, news=before is not None and before.text != text
            )
        else:
            alerts = book.absent(Topic.VIEW, "the gripper is measured again", now_s)
        alerts += book.absent(Topic.IMAGE, "images are good again", now_s)
        # A fault of the gripper or the lens has one alert, about that.
        if moved and (not not_the_camera or book.about(Topic.MOTION) is not None):
            alert = self._motion_alert(evidence)
            alerts += book.present(
                Topic.MOTION, alert, now_s, stamp_ns, text=lambda: _motion_text(alert, evidence, stamp_ns)
            )
        else:
            alerts += book.absent(Topic.MOTION, "the camera is where the reference has it", now_s)
        vibration = motion.vibration
        if vibration is not None:
            size_mm, hertz = 1e3 * vibration.rms_m, vibration.frequency_hz
            text = f"the camera vibrates: TCP {size_mm:.3f} mm rms{frequency_text(hertz)}"
            severity = _severity(vibration.rms_m / self._settings.warn_m, 0.0, book.about(Topic.VIBRATION))
            vibrates = Alert(AlertKind.VIBRATION, Cause.CAMERA_MOUNT, severity, text)
            alerts += book.present(Topic.VIBRATION, vibrates, now_s, stamp_ns)
        else:
            alerts += book.absent(Topic.VIBRATION, "the camera no longer vibrates", now_s)
        if evidence.d_m <= self._settings.limit_m and evidence.delta_rad <= self._settings.limit_rad:
            refused = book.about(Topic.RENEWAL)
            if refused is not None and refused.kind is AlertKind.REFUSED:
                alerts += book.absent(Topic.RENEWAL, "no longer past the limit", now_s)
        if not_the_camera:
            alerts += book.present(Topic.GRIPPER, _gripper_alert(evidence.explanation), now_s, stamp_ns)
        elif probable.cause is Cause.CAMERA_MOUNT:
            # The same edges, seen better: the alert about the gripper was wrong.
            alerts += book.absent(Topic.GRIPPER, "the camera moved, not the gripper or the lens", now_s, at_once=True)
        elif evidence.explanation.confirmed:
            alerts += book.absent(Topic.GRIPPER, "fingers, jaw and lens are as they should be", now_s)
        return alerts

    def _motion_alert(self, evidence: Evidence) -> Alert:
        """All of it but the text, which is composed where it is published: a motion lasts for many frames."""
        settings, motion, explanation = self._settings, evidence.motion, evidence.explanation
        shift_m, turn_rad = float(np.linalg.norm(motion.shift[:3])), float(np.linalg.norm(motion.shift[3:]))
        past_warning = max(shift_m / settings.warn_m, turn_rad / settings.warn_rad)
        past_limit = max(shift_m / settings.limit_m, turn_rad / settings.limit_rad)
        rate, left_s = None, None
        if motion.creep is not None:
            rate = motion.creep.rate_m_per_min
            left_s = time_left_s(motion.shift, motion.creep.velocity, settings.limit_m, settings.limit_rad)
        x, y, z = motion.shift[:3].tolist()
        return Alert(
            kind=motion.kind,
            cause=explanation.confirmed_cause.cause,
            severity=_severity(past_warning, past_limit, self.alerts.about(Topic.MOTION)),
            text="",
            part=explanation.confirmed_cause.part,
            causes=explanation.causes,
            tcp_shift_m=(x, y, z),
            rotation_rad=turn_rad,
            rate_m_per_min=rate,
            time_left_s=left_s,
        )


def _motion_text(alert: Alert, evidence: Evidence, stamp_ns: int) -> str:
    moved = motion_text(evidence.motion, evidence.since_first, stamp_ns)
    parts = [moved, creep_text(alert.rate_m_per_min, alert.time_left_s), evidence.explanation.text]
    return "; ".join(part for part in parts if part)


def past_alert_limit(protection: Protection | None, settings: PolicySettings) -> str | None:
    """Which bound is not within its alert limit, in words; None where both are.  One that is NaN bounds nothing.

    What makes a bound as large is a hypothesis: it can't be excluded, which doesn't say that it is so.
    """
    if protection is None:
        return "no bound on the error is known"
    position_m, rotation_rad = protection.position_m, protection.rotation_rad
    if not position_m <= settings.alert_limit_m:
        what, limit = "TCP", f"{1e3 * settings.alert_limit_m:g} mm"
        may = f"{in_mm(position_m)} mm" if position_m <= VAGUE_M else None
    elif not rotation_rad <= settings.alert_limit_rad:
        what, limit = "rotation", f"{in_degrees(settings.alert_limit_rad)} degrees"
        may = f"{in_degrees(rotation_rad)} degrees" if rotation_rad <= VAGUE_RAD else None
    else:
        return None
    if protection.hypothesis == NOTHING_WRONG:
        why = "; too little of the gripper is seen"
    else:
        why = f"; it can't be excluded that {protection.hypothesis}" if protection.hypothesis else ""
    off = f"the {what} may be {may} off" if may else f"it isn't determined how far the {what} is off"
    return f"{off}, alert limit {limit}{why}"


def _severity(past_warning: float, past_limit: float, before: Alert | None) -> Severity:
    """Severity of a size, given over the warning's threshold and over the limit.  An open alert (``before``) keeps its
    severity until the size is clearly less: near a threshold noise would change it again and again.
    """
    said = None if before is None else before.severity
    if past_limit >= (RELEASE_RATIO if said is Severity.ERROR else 1.0):
        return Severity.ERROR
    warned = said in (Severity.WARNING, Severity.ERROR)
    return Severity.WARNING if past_warning >= (RELEASE_RATIO if warned else 1.0) else Severity.INFO


def _gripper_alert(explanation: Explanation) -> Alert:
    probable = explanation.probable
    kind = AlertKind.LENS if probable.cause is Cause.LENS else AlertKind.GRIPPER
    return Alert(kind, probable.cause, Severity.ERROR, explanation.text, part=probable.part, causes=explanation.causes)
