"""The per-frame method: predict, measure, update, judge, and past the limit recalibrate.

A pure function of the frames so far: no clock, no I/O, no threads.  Time is the frames' own.
"""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np

from gripmon.judge.causes import CauseJudge, Watches
from gripmon.judge.drift import Baseline, Lasting, MotionWatch
from gripmon.judge.inspection import inspect
from gripmon.judge.policy import Evidence, Policy
from gripmon.judge.recalibrate import Proposal
from gripmon.judge.recalibrate import Refusal as Refused
from gripmon.judge.references import CommandRefused, Keep
from gripmon.judge.smoothing import PoseAverage
from gripmon.judge.stream import StreamFault, StreamWatch
from gripmon.model.camera import Camera
from gripmon.model.geometry import from_record
from gripmon.model.gripper import Gripper
from gripmon.model.pixels import in_full_scale
from gripmon.model.poses import perturbation_between, to_record
from gripmon.model.records import (
    Alert,
    Array,
    Command,
    CommandName,
    CommandReply,
    CornerFault,
    Drift,
    EdgeEvidence,
    Explanation,
    Frame,
    FrameRecord,
    MeasurementTrace,
    MonitorNotes,
    MonitorState,
    Motion,
    Origin,
    ReferenceRecord,
    Refusal,
    State,
    Verdict,
    unmeasured_record,
)
from gripmon.monitor.analysis import CauseAnalysis
from gripmon.monitor.answers import (
    NoteTaker,
    after_restart,
    drift_between,
    flat,
    frozen,
    gripper_astray,
    measured_record,
    of_stream,
    smoothed_record,
    unmeasured_corners,
)
from gripmon.monitor.renewal import Renewal
from gripmon.monitor.settings import MonitorSettings
from gripmon.monitor.standing import Standing
from gripmon.monitor.tracker import Tracker
from gripmon.monitor.trust import Integrity
from gripmon.track.edges import Effort, Measurement, TaughtEdges, agreeing_fingers, edge_residuals_px, trace_of

RESTARTED = "restarted, and too few frames since to say whether the picture fits the reference"

DOUBTED_FRAMES = 5
"""Frames in a row in which the gripper contradicts its model, after which they tell of the camera all the same."""


class Monitor:
    """Watches one camera on one gripper, starting from a reference calibration."""

    def __init__(
        self,
        camera: Camera,
        gripper: Gripper,
        settings: MonitorSettings,
        reference: ReferenceRecord,
        taught: TaughtEdges | None = None,
        state: MonitorState | None = None,
        keep: Keep = lambda _: "",
    ):
        """``state``, where given, is what :meth:`state` said before a restart: its newest reference counts then.
        ``keep`` is asked before any other gets into force: what can't be kept is only proposed, or refused.

        Raises ValueError for a state that doesn't hold together.
        """
        self._camera, self._gripper, self._settings = camera, gripper, settings
        # What was taught belongs to the gripper's edges: a new reference doesn't change it.
        self._tracker = Tracker(camera, gripper, settings, taught)
        self._policy = Policy(settings.policy, settings.recalibration.mode != "off")
        self._watch = MotionWatch(settings.drift)
        self._stream = StreamWatch(settings.stream)
        judge = CauseJudge(
            camera, gripper, settings.causes, np.zeros(6), settings.jaw_sigma_m, settings.jaw_offset_sigma_m
        )
        self._analysis = CauseAnalysis(judge)
        self._watches = Watches(len(gripper.finger_ids))
        self._average = PoseAverage(settings.smoothing)
        self._notes = NoteTaker(settings)
        self._due: list[Alert] = []  # of commands, for the next record
        self._covariance: Array | None = None
        self._trust = Integrity(camera, self._tracker, gripper, settings, reference)
        self._standing: Standing | None = None
        self._now_s = 0.0  # time that has passed since the first frame
        self._measured_s: float | None = None
        self._stamp_s: float | None = None
        self._newest: Measurement | None = None
        self._astray = 0
        self._jumped = False  # since the last frame that was believed
        self._baseline_weighed = False
        self._restarted = state is not None  # and not yet said whether the picture fits
        self._renewal = Renewal(settings, gripper, self._tracker.floor, reference, self._policy, state, keep)
        error = None if state is None or state.reference_error is None else np.array(state.reference_error)
        sigma = np.sqrt(np.reshape(self._renewal.book.configured.covariance, (6, 6)).diagonal())
        self._configured_baseline = Baseline(sigma, settings.policy.settle_frames, error)
        self._begin()
        last = None if state is None else state.cam_T_grip
        self._located = last is not None  # here, or before a restart
        self._cam_T_grip = self._ref_cam_T_grip if last is None else from_record(last)
        self._trust.resume(None if last is None else self._cam_T_grip, self.reference, state)
        if state is not None:
            self._policy.alerts.restore(state.alerts, state.alerts_raised, self._now_s)
            self._watch.resume(moved=self._policy.drifting)

    @property
    def reference(self) -> ReferenceRecord:
        """The calibration that drift is measured against now."""
        return self._renewal.book.current

    @property
    def look_refused(self) -> str | None:
        """Why the look that was kept over a restart isn't used; None where it is, or none was kept."""
        return self._trust.look_refused

    @property
    def proposal(self) -> ReferenceRecord | None:
        """A new reference that waits for an operator."""
        return self._renewal.book.proposal

    @property
    def recalibration(self) -> Proposal | Refused | None:
        """What came of the newest attempt at a new reference; None before the first one."""
        return self._renewal.outcome

    @property
    def state_revision(self) -> int:
        """Grows with each change of what :meth:`state` gives, the last transform aside."""
        return (
            self._renewal.book.changes + self._policy.alerts.changes + int(self._configured_baseline.error is not None)
        )

    def state(self) -> MonitorState:
        """What has to survive a restart."""
        error = self._configured_baseline.error
        return MonitorState(
            self._renewal.book.history,
            self._renewal.book.proposal,
            alerts=self._policy.alerts.open,
            alerts_raised=self._policy.alerts.raised,
            cam_T_grip=to_record(self._trust.last_known(self._cam_T_grip)) if self._located else None,
            reference_error=None if error is None else tuple(error.tolist()),
            look=self._trust.look_state(self.reference),
        )

    def process(self, frame: Frame) -> FrameRecord:
        """One frame in, one decision out.  Never raises for a bad frame: that is a record with a reason.  The image is
        not looked at after that.
        """
        self.learn()
        self._due += self._trust.told()
        if self._settings.bit_depth < 16:
            frame = in_full_scale(frame, self._settings.bit_depth)
        self._tick(frame)
        self._analysis.catch_up(self._now_s)
        faults = self._look_at_stream(frame)
        refusal = inspect(frame, self._camera, self._gripper, self._stream.pixels) or frozen(faults)
        if refusal is not None:
            self._newest = None
            return self._unmeasured(
                frame,
                f"{refusal[0]}: {refusal[1]}",
                CornerFault.FRAME_REFUSED,
                refusal=refusal[0],
                explanation=of_stream(faults),
            )
        before_T = self._cam_T_grip
        rivals = self._trust.rivals(self._ref_cam_T_grip)
        measurement = self._newest = self._tracker.measure(frame, before_T, self._now_s, rivals)
        standing = self._trust.judge(frame, measurement, self._now_s)
        if standing is None:
            explanation = self._explain(frame, measurement, wrong=True, usual=False)
            return self._unmeasured(
                frame, "too few edges of the gripper agree", CornerFault.NO_FIT, explanation=explanation
            )
        self._standing = standing
        measurement = self._newest = standing.measurement
        self._cam_T_grip, self._covariance = standing.cam_T_grip, standing.covariance
        self._measured_s, self._located = self._now_s, True
        drift = self._drift()
        evidence = self._evidence(frame, measurement, before_T, drift, doubtful=bool(faults))
        self._jumped = self._jumped or evidence.jumped
        if standing.believed:
            self._follow(standing, evidence.motion)
        judgement = self._policy.measured(evidence, self._now_s, frame.stamp_ns)
        alerts = judgement.alerts
        if self._restarted and judgement.state is not State.ACQUIRING:
            if evidence.motion.frames == 0 or not standing.believed:
                judgement = replace(judgement, verdict=Verdict.SUSPECT, reason=RESTARTED)
            else:
                self._restarted = False
                alerts = (after_restart(self.reference, evidence, self._settings.policy.warn_m), *alerts)
        origin = Origin.UPDATE
        if self._renewal.collect(frame, standing, judgement):
            before = self.reference
            alerts += self._renew(drift, evidence.explanation, frame.stamp_ns)
            if self.reference is not before:
                drift, origin = self._drift(), Origin.RECALIBRATION
        taken = self._tracker.taken(standing.measurement)
        smoothed, alerts = smoothed_record(self._average, self._tracker.floor), (*self._noted(), *alerts)
        return measured_record(
            frame, self.reference, judgement, standing, self._gripper, taken, origin, smoothed, drift, alerts
        )

    def _follow(self, standing: Standing, motion: Motion) -> None:
        """The gripper is where it was measured: averages and what is learnt follow."""
        assert self._covariance is not None
        self._tracker.learn(standing.measurement, opening=not standing.grasped)
        jumped, self._jumped = self._jumped, False
        if jumped:
            self._average.forget()
        quiet = self._policy.state is State.TRACKING and not motion.stepped and not self._watch.vibrates_anew
        self._average.add(self._cam_T_grip, self._covariance, quiet)
        if motion.stepped and not jumped:
            self._average.step(motion.step_frames)

    def _renew(self, drift: Drift, explanation: Explanation, stamp_ns: int) -> tuple[Alert, ...]:
        """Past the limit, or when an operator wants it: the still frames become a new reference."""
        before = self.reference
        alerts = self._renewal.recalibrate(drift, self._cam_T_grip, explanation, self._now_s, stamp_ns)
        if self.reference is not before:
            self._begin()
        return alerts

    def learn(self) -> None:
        """Learn from the newest frame what nothing waits for, in some 2 ms; :meth:`process` does it first if no one
        has.
        """
        self._trust.learn()
        self._watch.learn()

    @property
    def pending(self) -> bool:
        """Whether there is something to do for :meth:`run_pending`."""
        return self._tracker.searching.pending or self._analysis.pending

    def run_pending(self) -> None:
        """Search for a lost gripper and work out what moved, which takes the time of some frames, in another thread
        than :meth:`process` if need be.  Without it :meth:`process` does that; the records are the same.
        """
        self._tracker.searching.run_pending()
        self._analysis.run_pending()

    def trace(self) -> MeasurementTrace | None:
        """The pixels behind the newest record; None if its frame was refused."""
        if self._newest is None:
            return None
        return trace_of(self._newest, self._camera, self._gripper)

    def notes(self) -> MonitorNotes:
        """What the newest record was judged by; costs some microseconds."""
        measured = self._newest is not None and self._newest.trusted
        return self._notes.take(self._watch, self._baseline, self._average, measured)

    def _tick(self, frame: Frame) -> None:
        """Time passes to the frame's stamp; a clock that was set back stops it for this one frame only."""
        stamp_s = 1e-9 * frame.stamp_ns
        elapsed_s = max(stamp_s - self._stamp_s, 0.0) if self._stamp_s is not None else 0.0
        self._stamp_s = stamp_s
        self._now_s += elapsed_s
        self._average.wander(elapsed_s)

    def _look_at_stream(self, frame: Frame) -> tuple[StreamFault, ...]:
        """What is wrong with the stream, told of in the next record; its rate, for the drift test."""
        faults = self._stream.add(frame)
        for fault in faults:
            if fault.kind == "gap":
                self._analysis.interrupted()
        self._due += self._policy.stream(faults, self._now_s, frame.stamp_ns)
        frames_per_s = self._stream.frames_per_s
        if frames_per_s is not None:
            self._watch.set_frames_per_s(frames_per_s)
        return faults

    def _evidence(
        self, frame: Frame, measurement: Measurement, before_T: Array, drift: Drift, doubtful: bool
    ) -> Evidence:
        assert self._covariance is not None and self._standing is not None
        # Motion that the profiles can follow from frame to frame is not a jump.
        looked_far = measurement.effort is not Effort.NARROW
        reach_px = self._settings.corners.sampling.reach_px
        jumped = looked_far and measurement.moved_px(before_T) > reach_px
        shift = perturbation_between(self._ref_cam_T_grip, self._cam_T_grip)
        sigma = np.sqrt(self._covariance.diagonal())
        shares = agreeing_fingers(measurement, self._gripper)
        astray = gripper_astray(measurement, shares)
        self._astray = self._astray + 1 if astray else 0
        # Few doubtful frames tell nothing; many are how it is now.
        if 0 < self._astray < DOUBTED_FRAMES or not self._standing.believed:
            motion = self._watch.skip()
        else:
            covariance, bias, finer = self._covariance, None, self._standing.finer
            if finer is not None:
                covariance, bias = finer.of_change, Lasting(finer.of_bias, finer.renewed)
            motion = self._watch.add(self._since_start(shift), covariance, self._now_s, bias)
        if motion.stepped:
            self._analysis.moved_again()
        reported_m = frame.jaw_opening_m if self._gripper.has_jaw else None
        residual_px = edge_residuals_px(measurement, self._gripper)
        odd = self._watches.add(measurement.blur_px, shares, residual_px, reported_m, measurement.jaw_opening_m)
        if self._standing.knocked:
            self._analysis.knocked()
        wrong = astray or motion.present or motion.suspicious or odd
        explanation = self._explain(frame, measurement, wrong, usual=self._standing.believed)
        return Evidence(
            shift,
            sigma,
            drift.translation_m,
            drift.rotation_rad,
            motion,
            jumped,
            explanation,
            astray,
            doubtful,
            self._standing.protection,
            self._standing.where_it_was,
            self._trust.swing,
            self._standing.believed,
            since_first=self._baseline.error is not None and bool(self._baseline.error.any()),
            unproven=self._standing.unproven,
        )

    def _since_start(self, shift: Array) -> Array | None:
        """The shift (6,) less the reference's error; None while that isn't known yet."""
        assert self._covariance is not None
        since_start = self._baseline.subtract(shift)
        if since_start is not None and not self._baseline_weighed:
            self._baseline_weighed = True
            if self._baseline.error is not None and self._baseline.error.any():
                # It was measured before one background: what such a frame claims, it is uncertain by.
                self._watch.set_reference_covariance(self._covariance)
        return since_start

    def _explain(self, frame: Frame, measurement: Measurement, wrong: bool, usual: bool) -> Explanation:
        if self._stream.repeats:
            return self._analysis.known  # the image is an old one, what the robot reports is not
        here = self._ref_cam_T_grip

        def gather(kept: Frame) -> EdgeEvidence:
            return self._tracker.evidence(kept, measurement, here)

        return self._analysis.ask(wrong, usual, frame, gather, here, self._now_s)

    def _drift(self) -> Drift:
        return drift_between(self._ref_cam_T_grip, self._cam_T_grip)

    def command(self, command: Command, stamp_ns: int) -> CommandReply:
        """Do what an operator asks, between two frames; what can't be done is refused and changes nothing."""
        before, done = self.reference, True
        try:
            measurable = self._newest is not None and self._newest.trusted
            text, alerts = self._renewal.obey(command, self._cam_T_grip, measurable, self._now_s, stamp_ns)
            self._due += alerts
        except CommandRefused as refusal:
            done, text = False, str(refusal)
        if self.reference is not before:
            self._begin()
        wanted = command.name in (CommandName.STATE, CommandName.SNAPSHOT)
        state = msgspec.structs.replace(self.state(), look=None) if wanted else None  # no one reads a look
        return CommandReply(command.name, done, text, self.reference.reference_id, self.reference.revision, state)

    def _begin(self) -> None:
        """Drift is reckoned from the reference in force."""
        book = self._renewal.book
        covariance = np.reshape(self.reference.covariance, (6, 6))
        self._ref_cam_T_grip = self._renewal.ref_cam_T_grip
        if book.in_force == book.configured:
            self._baseline, covariance = self._configured_baseline, np.zeros((6, 6))
        else:
            self._baseline = Baseline(np.zeros(6), 0, error=np.zeros(6))
        self._baseline_weighed = False
        self._watch.reset(covariance)
        self._trust.refer(self.reference)
        if book.in_force != book.configured:
            self._trust.rebase(self.reference)
        self._analysis.rebase(np.sqrt(np.reshape(self.reference.covariance, (6, 6)).diagonal()))
        if self.reference.restores is None:
            # How edges look from where the camera is now; an undo doesn't move it.
            self._watches = Watches(len(self._gripper.finger_ids))

    def _unmeasured(
        self,
        frame: Frame,
        reason: str,
        fault: CornerFault,
        refusal: Refusal | None = None,
        explanation: Explanation | None = None,
    ) -> FrameRecord:
        """The last transform held with a covariance that grows, or none when it is too old."""
        judgement = self._policy.unmeasured(self._now_s, frame.stamp_ns, refusal, self._measured_s, explanation)
        self._renewal.moved()
        blank = unmeasured_record(
            frame,
            self.reference,
            reason,
            verdict=judgement.verdict,
            state=judgement.state,
            corners=unmeasured_corners(self._gripper.corner_ids, fault),
            alerts=(*self._noted(), *judgement.alerts),
        )
        if judgement.verdict is Verdict.UNKNOWN or self._covariance is None or self._measured_s is None:
            return blank
        unseen_s = self._now_s - self._measured_s
        growth = np.diag(self._policy.hold_variance(unseen_s))
        standing, hidden = self._standing, refusal is None
        return msgspec.structs.replace(
            blank,
            cam_T_grip=to_record(self._cam_T_grip),
            covariance=flat(self._covariance + growth),
            smoothed=smoothed_record(self._average, self._tracker.floor + growth),
            drift=self._drift(),
            protection=None if standing is None else self._trust.held(standing, growth, unseen_s, hidden),
        )

    def _noted(self) -> list[Alert]:
        noted, self._due = self._due, []
        return noted
